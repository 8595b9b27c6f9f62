// One model of several while partitions train: which rows are kept, and what the file holds.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { create } from '@bufbuild/protobuf';

import { camerasOf } from '../../src/pages/job/live-model.ts';
import { liveBytes, liveOf, liveText, nothingText } from '../../src/pages/job/live-state.ts';
import { JobSchema, JobState, Stage, TaskState } from '../../src/rpc/fathom/v1/job_pb.ts';
import { compositeOf, joinedPly, keptRows, readRows } from '../../src/viewer/composite.ts';
import { Cells } from '../../src/viewer/partitions.ts';
import { readHeader } from '../../src/viewer/ply.ts';

type Quat = readonly [number, number, number, number];
const IDENTITY: Quat = [1, 0, 0, 0];
/** A quarter turn about the vertical: scene x is aligned -z. */
const QUARTER: Quat = [Math.SQRT1_2, 0, Math.SQRT1_2, 0];

const bounds = (lo: number | null, hi: number | null) => ({ lo, hi });
const planOf = (quat: Quat, ...cells: readonly (readonly [number | null, number | null])[]) => ({
    alignment: { down: [0, 1, 0] as const, world_to_aligned_quat_wxyz: quat },
    partitions: cells.map(([lo, hi], id) => ({ id, cell: { x: bounds(lo, hi), z: bounds(null, null) } })),
});
const HALVES = planOf(IDENTITY, [null, 0.5], [0.5, null]);

const DEGREE_0 = ['x', 'y', 'z', 'opacity', 'scale_0', 'rot_0', 'f_dc_0'];

/** A PLY with these rows; what is left out of a row is 0. */
function ply(
    rows: readonly (readonly number[])[],
    properties = DEGREE_0,
    comments: readonly string[] = [],
): Uint8Array {
    const lines = [
        'ply',
        'format binary_little_endian 1.0',
        ...comments.map((comment) => `comment ${comment}`),
        `element vertex ${rows.length}`,
        ...properties.map((name) => `property float ${name}`),
        'end_header\n',
    ];
    const values = new Float32Array(rows.length * properties.length);
    rows.forEach((row, i) => values.set(row, i * properties.length));
    return new Uint8Array(Buffer.concat([Buffer.from(lines.join('\n')), Buffer.from(values.buffer)]));
}

/** The values of a property, row after row. */
function column(bytes: Uint8Array, name: string): number[] {
    const { properties, values } = readRows(bytes, 'm');
    return [...values].filter((_, i) => i % properties.length === properties.indexOf(name));
}

test('a point on a border belongs to the lower cell, as in the merge', () => {
    const cells = new Cells(HALVES);
    assert.equal(cells.at(0.5, 9, 9), 0);
    // The next number after 0.5.
    assert.equal(cells.at(0.5 + 2 ** -53, 9, 9), 1);
    assert.equal(cells.at(Math.fround(0.5 - 1e-7), 9, 9), 0);
    assert.equal(cells.at(-Infinity, 0, 0), -1);
    assert.equal(cells.at(0, NaN, 0), -1);
});

test('a turned plan owns points to the last bit, computed as glam does', () => {
    const quat: Quat = [0.9999874746806712, 0.0028249519566724275, -0.0, 0.004131601168602218];
    const [x, y, z] = [-1.340000033378601, -0.3125, 2.75];
    // Of w, b and v as glam multiplies them: v (w w - b.b) + b (v.b) 2 + (b x v) w 2, in double precision.
    // The rotation matrix gives the number below.
    const border = -1.3373078733855501;
    const next = -1.3373078733855503;
    const below = new Cells(planOf(quat, [null, border], [border, null]));
    const above = new Cells(planOf(quat, [null, next], [next, null]));
    assert.deepEqual([below.at(x, y, z), above.at(x, y, z)], [0, 1]);
    // A quarter turn takes scene x to aligned -z.
    const turned = new Cells(planOf(QUARTER, [null, 0.5], [0.5, null]));
    assert.deepEqual([turned.at(0, 0, 0.6), turned.at(0, 0, 0.4)], [1, 0]);
});

test('every point belongs to one cell, so that nothing is shown twice', () => {
    const quat: Quat = [0.8, 0, 0.6, 0];
    const plan = planOf(quat, [null, -1], [-1, 0.25], [0.25, 0.75], [0.75, null]);
    const rows = Array.from({ length: 500 }, (_, i) => [
        Math.sin(i) * 2,
        Math.cos(3 * i),
        Math.sin(7 * i) * 2,
        1,
    ]);
    const all = readRows(ply(rows), 'm');
    const counts = plan.partitions.map(
        (_, cell) => keptRows(all, plan, (at) => at === cell).values.length / 7,
    );
    assert.equal(
        counts.reduce((a, b) => a + b, 0),
        rows.length,
    );
    assert.ok(counts.every((count) => count > 0));
});

test('finished partitions fill their cells, and the coarse model the others', () => {
    const coarse = readRows(
        ply(
            [
                [-1, 0, 0, 1, 10],
                [0.5, 0, 0, 1, 11],
                [2, 0, 0, 1, 12],
            ],
            DEGREE_0,
            ['coarse'],
        ),
        'c',
    );
    const first = readRows(
        ply(
            [
                [0.5, 0, 0, 2, 20],
                [0.6, 0, 0, 2, 21],
            ],
            DEGREE_0,
            ['first'],
        ),
        'p',
    );
    const second = readRows(
        ply([
            [0.5, 0, 0, 3, 30],
            [0.6, 0, 0, 3, 31],
        ]),
        'p',
    );
    const scales = (bytes: Uint8Array): number[] => column(bytes, 'scale_0');
    assert.deepEqual(scales(compositeOf(HALVES, coarse, new Map())), [10, 11, 12]);
    const half = compositeOf(HALVES, coarse, new Map([[0, first]]));
    assert.deepEqual(scales(half), [12, 20]);
    assert.deepEqual(readHeader(half, 'm').comments, ['coarse']);
    assert.deepEqual(
        scales(
            compositeOf(
                HALVES,
                coarse,
                new Map([
                    [0, first],
                    [1, second],
                ]),
            ),
        ),
        [20, 31],
    );
    const alone = compositeOf(HALVES, null, new Map([[0, first]]));
    assert.deepEqual(scales(alone), [20]);
    assert.deepEqual(readHeader(alone, 'm').comments, ['first']);
});

test('Gaussians that no partition owns are left out', () => {
    const rows = readRows(
        ply([
            [0, 0, 0, 1],
            [NaN, 0, 0, 1],
            [0, 0, 0, NaN],
            [0, Infinity, 0, 1],
        ]),
        'm',
    );
    assert.equal(keptRows(rows, HALVES, () => true).values.length, DEGREE_0.length);
});

test('models of different degrees become one, with their harmonics by colour', () => {
    const rest = (count: number): string[] => Array.from({ length: count }, (_, i) => `f_rest_${i}`);
    const low = readRows(
        ply([[-1, 0, 0, 1, 0, 0, 0, ...rest(9).map((_, i) => i + 1)]], [...DEGREE_0, ...rest(9)]),
        'l',
    );
    const high = readRows(
        ply([[1, 0, 0, 1, 0, 0, 0, ...rest(24).map((_, i) => i + 1)]], [...DEGREE_0, ...rest(24)]),
        'h',
    );
    const joined = joinedPly([low, high]);
    const rows = [0, 1].map((row) => rest(24).map((name) => column(joined, name)[row]));
    // Three of eight coefficients of each colour.
    const padded = [
        [1, 2, 3],
        [4, 5, 6],
        [7, 8, 9],
    ].map((colour) => colour.concat([0, 0, 0, 0, 0]));
    assert.deepEqual(rows, [padded.flat(), rest(24).map((_, i) => i + 1)]);
});

test('a model with other types is refused', () => {
    const bytes = Buffer.from(
        Buffer.from(ply([[0]]))
            .toString('latin1')
            .replace('float rot_0', 'uchar rot_0'),
        'latin1',
    );
    assert.throws(
        () => readRows(bytes, 'The coarse model'),
        /The coarse model is not a model as Fathom writes it/,
    );
});

const blob = (digest: string) => ({ digest, sizeBytes: 5n });
const task = (taskId: string, stage: Stage, state: TaskState, digest = '', partition = 0) => ({
    taskId,
    stage,
    state,
    partition,
    ...(digest === '' ? {} : { model: blob(digest) }),
});
const { DONE, LEASED, BLOCKED } = TaskState;
const job = (state: JobState, ...tasks: readonly ReturnType<typeof task>[]) =>
    create(JobSchema, { state, partitions: 3, plan: blob('plan'), tasks: [...tasks] });

test('what is shown is the best that there is, and is told', () => {
    const text = (state: JobState, ...tasks: readonly ReturnType<typeof task>[]): string | null => {
        const live = liveOf(job(state, ...tasks));
        return live === null ? null : `${liveText(live)} ${liveBytes(live)}`;
    };
    const { RUNNING } = JobState;
    const global = task('global', Stage.GLOBAL, DONE, 'g');
    const parts = [0, 1, 2].map((i) => task(`partition-000${i}`, Stage.PARTITION, DONE, `p${i}`, i));
    assert.equal(text(RUNNING, task('global', Stage.GLOBAL, LEASED)), null);
    assert.equal(text(RUNNING, global), 'The coarse model. None of 3 partitions has finished. 5');
    assert.equal(text(RUNNING, global, parts[1]!), '1 of 3 partitions, the coarse model elsewhere. 10');
    assert.equal(text(RUNNING, parts[1]!, parts[2]!), '2 of 3 partitions, nothing elsewhere. 10');
    assert.equal(text(JobState.PAUSED, global, ...parts), 'All 3 partitions. They are merged next. 20');
    const merge = task('merge', Stage.MERGE, DONE, 'm');
    assert.equal(text(RUNNING, global, ...parts, merge), 'The merged model. Its evaluation follows. 5');
    assert.equal(text(JobState.SUCCEEDED, global, ...parts, merge), 'The finished model. 0');
    assert.equal(text(JobState.FAILED, global, ...parts), null);
    const borders = task('borders', Stage.BORDERS, DONE, 'b');
    assert.equal(liveOf(job(RUNNING, merge, borders))?.key, 'merged b');
    // A first part is no finished partition.
    assert.equal(text(RUNNING, task('first_part-0000', Stage.FIRST_PART, DONE, 'f')), null);
});

test('another model is another key, so that it is offered', () => {
    const parts = [0, 1].map((i) => task(`partition-000${i}`, Stage.PARTITION, DONE, `p${i}`, i));
    const [one, two] = [liveOf(job(JobState.RUNNING, parts[0]!)), liveOf(job(JobState.RUNNING, ...parts))];
    assert.notEqual(one?.key, two?.key);
    assert.equal(one?.key, liveOf(job(JobState.RUNNING, parts[0]!))?.key);
});

test('where there is nothing to see the page says what comes first', () => {
    const { RUNNING } = JobState;
    assert.match(
        nothingText(job(RUNNING, task('global', Stage.GLOBAL, BLOCKED))),
        /coarse model has been trained/,
    );
    assert.match(
        nothingText(job(RUNNING, task('partition-0000', Stage.PARTITION, LEASED))),
        /a partition has finished/,
    );
    assert.match(nothingText(job(JobState.CANCELLED)), /did not succeed/);
});

test('the cameras of a manifest are those of cameras.json', () => {
    const pose = { rotation: [0, Math.SQRT1_2, 0, Math.SQRT1_2], translation: [1, 2, 3] };
    const camera = { width: 160, height: 120 };
    const manifest = {
        cameras: [
            { ...camera, id: 1, model: 'PINHOLE', params: [100, 101, 80, 60] },
            { ...camera, id: 2, model: 'SIMPLE_RADIAL', params: [90, 81, 61, 0.1] },
            { ...camera, id: 3, model: 'EQUIRECTANGULAR', params: [160, 120] },
        ],
        views: [1, 2, 3].map((camera_id) => ({ name: `v${camera_id}.png`, camera_id, pose })),
    };
    const [first, second, ...others] = camerasOf(manifest);
    assert.deepEqual(others, []);
    assert.deepEqual([first?.fx, first?.fy, first?.cx, first?.cy], [100, 101, 80, 60]);
    assert.deepEqual([second?.fx, second?.fy, second?.cx, second?.cy], [90, 90, 81, 61]);
    assert.equal(first?.img_name, 'v1.png');
    // The inverse of a quarter turn about y takes -(1, 2, 3) to (3, -2, -1).
    first?.position.forEach((value, i) =>
        assert.ok(Math.abs(value - [3, -2, -1][i]!) < 1e-12, String(value)),
    );
    assert.deepEqual(camerasOf(null), []);
});
