// The logic around a new job: its settings, its previews, what the service says about wrong fields.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { create } from '@bufbuild/protobuf';
import { Code, ConnectError } from '@connectrpc/connect';

import { faultOf, wrongFieldsOf } from '../../src/pages/faults.ts';
import {
    digestsOf,
    firstSeries,
    frameAt,
    latestPsnr,
    newestFrame,
    roundsOf,
    seriesOf,
    withPreviews,
} from '../../src/pages/job/preview-series.ts';
import { type JobForm, WrongForm, configOf, freshUuid, wrongField } from '../../src/pages/job-settings.ts';
import { picturesIn } from '../../src/pages/thumbnails.ts';
import { type TaskHistory, TaskHistorySchema } from '../../src/rpc/fathom/v1/job_pb.ts';
import { BadRequestSchema, ErrorInfoSchema } from '../../src/rpc/google/rpc/error_details_pb.ts';

const FORM: JobForm = {
    preset: 'fathom',
    partitions: 'auto',
    columns: 3,
    rows: 2,
    iterations: 500,
    maxGaussians: 1000,
    hasPreviews: true,
    advanced: '',
};
const config = (change: Partial<JobForm>): unknown => JSON.parse(configOf({ ...FORM, ...change }));

test('the settings of a job are those of its form and the advanced ones', () => {
    const train = { iterations: 500, max_gaussians: 1000 };
    assert.deepEqual(config({}), { preset: 'fathom', partition: { auto: true }, train });
    assert.deepEqual(config({ partitions: 'grid', preset: '3dgs' }), {
        preset: '3dgs',
        partition: { auto: false, columns: 3, rows: 2 },
        train,
    });
    assert.deepEqual(config({ hasPreviews: false }), {
        preset: 'fathom',
        partition: { auto: true },
        train: { ...train, preview_seconds: 0 },
    });
    const advanced = '{"train": {"preview_seconds": 5}, "water": {"lr": 0.1}, "partition": {"weight_terms": {"beta": 1}}}';
    assert.deepEqual(config({ advanced }), {
        preset: 'fathom',
        partition: { auto: true, weight_terms: { beta: 1 } },
        train: { ...train, preview_seconds: 5 },
        water: { lr: 0.1 },
    });
});

test('advanced settings that cannot be used are refused with the reason', () => {
    const refusal = (advanced: string, change: Partial<JobForm> = {}): string => {
        try {
            config({ advanced, ...change });
        } catch (error) {
            assert.ok(error instanceof WrongForm);
            assert.equal(error.field, 'advanced');
            return error.message;
        }
        return '';
    };
    assert.match(refusal('{"train"'), /^This is not JSON\. /);
    for (const text of ['[1]', '5', 'null', '"train"']) {
        assert.match(refusal(text), /^Write an object/, text);
    }
    assert.match(refusal('{"train": {"iterations": 5}}'), /^train\.iterations has a field above/);
    assert.match(refusal('{"preset": "paper"}'), /^preset has a field above/);
    assert.match(refusal('{"train": {"preview_seconds": 5}}', { hasPreviews: false }), /^train\.preview_seconds has a field above/);
    assert.equal(refusal(' \n'), '');
});

test('what the service finds wrong is said at its field', () => {
    const advanced = '{"train": {"iterationz": 5}, "trian": {}}';
    const at = (field: string, message: string): readonly [string, string] => {
        const wrong = wrongField(field, message, advanced);
        return [wrong.field, wrong.message];
    };
    assert.deepEqual(at('config_json', 'configuration: train.iterations must be at least 1'), ['iterations', 'train.iterations must be at least 1.']);
    assert.deepEqual(at('config_json', 'configuration: partition.columns must be at most 64'), ['partitions', 'partition.columns must be at most 64.']);
    assert.deepEqual(at('config_json', 'configuration: train.ssim_weight must be at most 1'), ['advanced', 'train.ssim_weight must be at most 1.']);
    assert.deepEqual(at('config_json', 'unknown field `iterationz`, expected one of `seed`'), [
        'advanced',
        'train.iterationz: unknown field `iterationz`, expected one of `seed`',
    ]);
    assert.deepEqual(at('config_json', 'unknown field `trian`, expected one of `train`'), ['advanced', 'Unknown field `trian`, expected one of `train`.']);
    assert.deepEqual(at('priority', 'is 5000, it must lie between -1000 and 1000'), ['priority', 'Priority is 5000, it must lie between -1000 and 1000.']);
    const refused = new ConnectError('x', Code.InvalidArgument, undefined, [
        { desc: ErrorInfoSchema, value: create(ErrorInfoSchema, { reason: 'BAD_ARGUMENT', domain: 'fathom' }) },
        { desc: BadRequestSchema, value: create(BadRequestSchema, { fieldViolations: [{ field: 'name', description: 'is too long' }] }) },
    ]);
    assert.deepEqual(wrongFieldsOf(faultOf(refused)), [{ field: 'name', message: 'is too long' }]);
    assert.deepEqual(wrongFieldsOf(faultOf(new Error('x'))), []);
});

test('ids of forms are random UUIDs', () => {
    const ids = Array.from({ length: 20 }, freshUuid);
    assert.equal(new Set(ids).size, ids.length);
    assert.ok(ids.every((id) => /^[\da-f]{8}-[\da-f]{4}-4[\da-f]{3}-[89ab][\da-f]{3}-[\da-f]{12}$/.test(id)));
});

const blob = (digest: string) => ({ digest, sizeBytes: 1n });
const history = (taskId: string, ...previews: readonly (readonly [view: string, iteration: number])[]): TaskHistory =>
    create(TaskHistorySchema, {
        taskId,
        points: [{ progress: { iteration: 1, iterations: 900 } }],
        previews: previews.map(([view, iteration]) => ({ view, iteration, render: blob(`${taskId} ${view} ${iteration}`) })),
    });

test('previews are grouped by task and view, and by iteration', () => {
    const tasks = [
        history('global', ['b10', 5]),
        history('partition-0000', ['b10', 20], ['b9', 20], ['b10', 10], ['b9', 10]),
        history('partition-0001'),
    ];
    const series = seriesOf(tasks);
    assert.deepEqual(series.map(({ task, view, iterations }) => [task, view, iterations]), [
        ['global', 'b10', 900],
        ['partition-0000', 'b9', 900],
        ['partition-0000', 'b10', 900],
    ]);
    assert.equal(new Set(series.map(({ key }) => key)).size, 3);
    const last = series[2]!;
    assert.deepEqual(last.frames.map(({ iteration }) => iteration), [10, 20]);
    assert.deepEqual([null, 5, 10, 15, 99].map((at) => frameAt(last, at).iteration), [20, 10, 10, 10, 20]);
    assert.equal(newestFrame(tasks)?.render, 'partition-0000 b10 20');
    assert.equal(newestFrame([history('global')]), null);
    assert.equal(firstSeries(series, new Set())?.key, series[1]!.key, 'the first view of the last task');
    assert.equal(firstSeries(series, new Set(['global']))?.key, series[0]!.key, 'a task that runs');
    assert.equal(firstSeries([], new Set()), null);
});

test('the PSNR of a round of previews is the mean over its views', () => {
    const previews = [
        { view: 'a', iteration: 20, psnrDb: 24 },
        { view: 'b', iteration: 20, psnrDb: 26 },
        { view: 'a', iteration: 10, psnrDb: 20 },
        { view: 'b', iteration: 10 },
        { view: 'a', iteration: 30, psnrDb: Number.NaN },
        // Trained again after a loss.
        { view: 'b', iteration: 20, psnrDb: 28 },
    ].map((one) => Object.assign(one, { render: blob('x') }));
    const task = create(TaskHistorySchema, { taskId: 'global', previews });
    assert.deepEqual(roundsOf(task), [
        { iteration: 10, psnr: 20 },
        { iteration: 20, psnr: 26 },
    ]);
    const [a, b] = seriesOf([task]);
    assert.deepEqual(a!.frames.map(({ psnr }) => psnr), [20, 24, null]);
    assert.deepEqual([latestPsnr(a!), latestPsnr(b!)], [24, 28]);
    const info = { task: 'global', stage: 'global', partition: null, state: 'running', worker: null };
    const counts = { iteration: 0, iterations: 0, attempts: 1, psnr: null };
    const tasks = withPreviews([{ ...info, ...counts }, { ...info, ...counts, task: 'other' }], [task]);
    assert.deepEqual(tasks.map(({ previewPsnr }) => previewPsnr), [26, null]);
});

test('a preview without a picture is left out', () => {
    const task = create(TaskHistorySchema, { taskId: 'global', previews: [{ view: 'a', iteration: 1 }] });
    assert.deepEqual(seriesOf([task]), []);
    assert.deepEqual([...digestsOf([task])], []);
});

test('pictures that are named are those with and without water', () => {
    const task = create(TaskHistorySchema, {
        taskId: 'global',
        previews: [{ view: 'a', iteration: 1, render: blob('render'), clear: blob('clear') }],
    });
    assert.deepEqual([...digestsOf([history('global', ['a', 5]), task])], ['global a 5', 'render', 'clear']);
});

test('a row of pictures has two more of them in water', () => {
    assert.equal(picturesIn('{"water": {"medium": "none"}}'), 3);
    assert.equal(picturesIn('{"water": {"medium": "learned"}}'), 5);
    assert.equal(picturesIn('no settings'), 5);
});
