// The water of tasks while it is trained.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { create } from '@bufbuild/protobuf';
import { timestampFromMs } from '@bufbuild/protobuf/wkt';

import { isInAir, waterSeriesOf } from '../../src/pages/job/water-history.ts';
import {
    type WaterSeries,
    bandOf,
    errorBandOf,
    firstShown,
    spreadOfPartitions,
    waterAt,
} from '../../src/pages/parts/water-points.ts';
import { drawnError, patch, valuesOf } from '../../src/pages/parts/water-values.ts';
import { checkWater } from '../../src/viewer/water.ts';
import { Stage, TaskHistorySchema, TaskSchema } from '../../src/rpc/fathom/v1/job_pb.ts';

const series = (task: string, stage: string, ...scales: readonly number[]): WaterSeries => ({
    task,
    label: task,
    stage,
    points: scales.map((by, at) => ({
        timeMs: at,
        attempt: 1,
        iteration: 100 * at,
        beta_d: [4 * by, 2 * by, 1 * by],
        beta_b: [3 * by, 2 * by, 1 * by],
        b_inf: [0, 0.1, 0.2],
    })),
});

test('only points with all nine numbers are kept, by task in the order of the job', () => {
    const rgb = { red: 1, green: 2, blue: 3 };
    const time = timestampFromMs(7000);
    const task = (taskId: string, stage: Stage) => create(TaskSchema, { taskId, stage });
    const points = [
        { time, attempt: 2, progress: { iteration: 5, water: { betaD: rgb, betaB: rgb, bInf: rgb } } },
        { time, attempt: 2, progress: { iteration: 6, water: { betaD: rgb, betaB: rgb } } },
        { time, attempt: 2, progress: { iteration: 7 } },
        {
            time,
            attempt: 2,
            progress: { iteration: 8, water: { betaD: rgb, betaB: rgb, bInf: { ...rgb, red: NaN } } },
        },
    ];
    const found = waterSeriesOf(
        [task('global', Stage.GLOBAL), task('merge', Stage.MERGE), task('partition-0001', Stage.PARTITION)],
        [
            create(TaskHistorySchema, { taskId: 'partition-0001', points }),
            create(TaskHistorySchema, { taskId: 'global', points: points.slice(0, 1) }),
            create(TaskHistorySchema, { taskId: 'merge' }),
        ],
    );
    const three = [1, 2, 3];
    const point = { timeMs: 7000, attempt: 2, iteration: 5, beta_d: three, beta_b: three, b_inf: three };
    assert.deepEqual(found, [
        { task: 'global', label: 'Coarse model', stage: 'global', points: [point] },
        { task: 'partition-0001', label: 'Partition 1', stage: 'partition', points: [point] },
    ]);
});

test('points keep their standard errors, where reported', () => {
    const rgb = { red: 1, green: 2, blue: 3 };
    const time = timestampFromMs(7000);
    const water = { betaD: rgb, betaB: rgb, bInf: rgb };
    const standardError = { betaD: { red: 0.5, blue: 0.25 }, bInf: { red: NaN, green: -1, blue: 0 } };
    const [found] = waterSeriesOf(
        [create(TaskSchema, { taskId: 'global', stage: Stage.GLOBAL })],
        [
            create(TaskHistorySchema, {
                taskId: 'global',
                points: [
                    { time, attempt: 1, progress: { iteration: 5, water } },
                    { time, attempt: 1, progress: { iteration: 6, water: { ...water, standardError } } },
                ],
            }),
        ],
    );
    const [before, after] = found!.points;
    assert.ok(!('standard_error' in before!), 'a worker that reports none');
    assert.ok(!('standard_error' in waterAt(before!)));
    assert.deepEqual(after!.standard_error, {
        beta_d: [0.5, null, 0.25],
        beta_b: null,
        b_inf: [null, null, 0],
    });
    const shown = valuesOf(waterAt(after!), 'beta_d', null);
    assert.deepEqual(
        shown.map(({ value, error }) => [value, error]),
        [
            [1, 0.5],
            [2, null],
            [3, 0.25],
        ],
    );
});

test('a band of errors has gaps where nothing is determined', () => {
    const one = series('a', 'partition', 1, 2, 3);
    const errors = [0.5, null, 100];
    const points = one.points.map((point, i) => ({
        ...point,
        standard_error: { beta_d: [errors[i]!, null, null] as const, beta_b: null },
    }));
    const band = errorBandOf({ ...one, points }, 'beta_d', 0, 12)!;
    assert.deepEqual(band.lower, { xs: [0, 100, 200], ys: [3.5, null, 0] });
    // The largest value is 12, so that of 100 only 12 and a quarter more are drawn.
    assert.deepEqual(band.upper, { xs: [0, 100, 200], ys: [4.5, null, 12 + drawnError(12, 100, 12)] });
    assert.equal(drawnError(12, 100, 12), 15);
    assert.ok(band.isCut);
    assert.ok(!errorBandOf({ ...one, points: points.slice(0, 2) }, 'beta_d', 0, 12)!.isCut);
    assert.equal(errorBandOf({ ...one, points }, 'beta_d', 1, 12), null);
    assert.equal(errorBandOf({ ...one, points }, 'b_inf', 0, 12), null);
    assert.equal(errorBandOf(one, 'beta_d', 0, 12), null, 'an old history');
});

test('the first task that trains its water in the last stage that does is shown first', () => {
    const coarse = series('global', 'global', 1, 2);
    const fixed = series('partition-0000', 'partition', 2, 2);
    assert.equal(firstShown([]), null);
    assert.equal(firstShown([fixed])?.task, 'partition-0000');
    assert.equal(firstShown([coarse, fixed])?.task, 'global');
    const parts = [
        series('first_part-0000', 'first_part', 2, 2),
        series('first_part-0001', 'first_part', 2, 3),
    ];
    assert.equal(firstShown([coarse, ...parts, fixed])?.task, 'first_part-0001');
});

test('the spread is that of the latest values, and of partitions that differ', () => {
    const parts = [
        series('first_part-0000', 'first_part', 9, 1),
        series('first_part-0001', 'first_part', 1.5),
    ];
    const after = [series('partition-0000', 'partition', 1), series('partition-0001', 'partition', 1)];
    const spread = spreadOfPartitions([series('global', 'global', 5), ...parts, ...after]);
    assert.equal(spread?.partitions, 2);
    assert.deepEqual(spread?.of.beta_d[0], { lowest: 4, highest: 6, share: 0.4 });
    assert.deepEqual(spread?.of.b_inf[0], { lowest: 0, highest: 0, share: null });
    assert.equal(spreadOfPartitions(after), null, 'all have one water');
    assert.equal(spreadOfPartitions(parts.slice(1)), null, 'one partition');
});

test('a band holds the lowest, the highest and the mean of the tasks that have come so far', () => {
    const red = ({ beta_d }: WaterSeries['points'][number]): number => beta_d[0];
    // Points at iterations 0, 100, 200, and of the second task at 0 and 100.
    const [a, b] = [series('a', 'partition', 1, 2, 3), series('b', 'partition', 3, 1)];
    const band = bandOf([a, b], red)!;
    assert.deepEqual(band.lowest, { xs: [0, 100], ys: [4, 4] });
    assert.deepEqual(band.highest, { xs: [0, 100], ys: [12, 8] });
    assert.deepEqual(band.mean, { xs: [0, 100], ys: [8, 6] });
    const later = { ...b, points: [{ ...b.points[0]!, iteration: 50 }, { ...b.points[1]!, iteration: 150 }] };
    const between = bandOf([a, later], red)!;
    assert.deepEqual(between.mean.xs, [50, 100, 150]);
    assert.deepEqual(between.mean.ys, [(6 + 12) / 2, (8 + 8) / 2, (10 + 4) / 2], 'between points along a line');
    assert.equal(bandOf([a], red), null);
    assert.equal(bandOf([], red), null);
    const many = Array.from({ length: 3 }, (_, i) => ({
        ...a,
        points: Array.from({ length: 500 }, (__, at) => ({ ...a.points[0]!, iteration: 3 * at + i })),
    }));
    const long = bandOf(many, red)!;
    assert.ok(long.mean.xs.length <= 200);
    assert.deepEqual([...new Set(long.mean.ys)], [4]);
});

test('the colours of a moment are those that its water makes', () => {
    const water = waterAt(series('a', 'partition', 0.1).points[0]!);
    assert.deepEqual(checkWater(water), water);
    assert.ok(patch(water, [0.5, 0.5, 0.5], 10)[0] < patch(water, [0.5, 0.5, 0.5], 1)[0], 'red goes first');
});

test('settings without a medium are known', () => {
    assert.ok(isInAir('{"water": {"medium": "none"}}'));
    assert.ok(!isInAir('{"water": {"medium": "per_pixel"}}'));
    assert.ok(!isInAir(''));
});
