import assert from 'node:assert/strict';
import { test } from 'node:test';

import {
    type CurvePoint,
    type CurveSeries,
    Looks,
    MOST_DRAWN,
    currentPoints,
    firstDrawn,
    isOfPreviews,
    joined,
    lineOf,
    placeText,
    previewLine,
    psnrTitle,
    spanOf,
    startOf,
    valueAt,
} from '../../src/pages/parts/curve-points.ts';

const point = (iteration: number, change: Partial<CurvePoint> = {}): CurvePoint => ({
    timeMs: 1000 * iteration,
    attempt: 1,
    iteration,
    loss: 1 / iteration,
    psnr: null,
    gaussians: 10 * iteration,
    rate: 5,
    memoryBytes: 0,
    ...change,
});
const series = (task: string, points: CurvePoint[]): CurveSeries => ({ task, label: task, points });

test('an attempt that resumed earlier replaces the points after its beginning', () => {
    const points = [point(1), point(2), point(3), point(2, { attempt: 2, loss: 9 }), point(4, { attempt: 2 })];
    assert.deepEqual(
        currentPoints(points).map(({ iteration, attempt }) => [iteration, attempt]),
        [
            [1, 1],
            [2, 2],
            [4, 2],
        ],
    );
});

test('a line runs along iterations, or along seconds with a gap between attempts', () => {
    const points = [point(1), point(2), point(5, { attempt: 2 })];
    assert.deepEqual(lineOf(points, 'gaussians', 'iteration', 0), { xs: [1, 2, 5], ys: [10, 20, 50] });
    assert.deepEqual(lineOf(points, 'gaussians', 'time', 1000), { xs: [0, 1, 2.5, 4], ys: [10, 20, null, 50] });
});

test('values that are not known are left out, and so are those without a logarithm', () => {
    const points = [
        point(1, { loss: 0 }),
        point(2, { loss: 0.5 }),
        point(3, { loss: Number.NaN }),
        point(4, { loss: -1 }),
    ];
    assert.deepEqual(lineOf(points, 'loss', 'iteration', 0), { xs: [2], ys: [0.5] });
    assert.deepEqual(lineOf(points, 'memory', 'iteration', 0), { xs: [], ys: [] }, 'the driver does not report it');
});

test('a PSNR is drawn where it was measured, not where it was repeated', () => {
    const psnrs = [null, 20, 20, 20, 22, 22];
    const points = psnrs.map((psnr, i) => point(i + 1, { psnr }));
    assert.deepEqual(lineOf(points, 'psnr', 'iteration', 0), { xs: [2, 5], ys: [20, 22] });
});

test('a clock that goes back draws no line back', () => {
    const points = [point(1), point(2, { timeMs: 500 }), point(3)];
    assert.deepEqual(lineOf(points, 'rate', 'time', 1000).xs, [0, 2]);
});

test('lines share their places, and an absent point is no gap', () => {
    const { xs, columns } = joined([
        { xs: [1, 3], ys: [10, 30] },
        { xs: [2, 3], ys: [null, 5] },
    ]);
    assert.deepEqual(xs, [1, 2, 3]);
    assert.deepEqual(columns, [
        [10, undefined, 30],
        [undefined, null, 5],
    ]);
});

test('the value at a place is the latest before it', () => {
    const line = { xs: [1, 3, 5], ys: [10, null, 50] };
    assert.deepEqual(
        [0, 1, 4, 5, Infinity].map((x) => valueAt(line, x)),
        [null, 10, 10, 50, 50],
    );
});

test('all charts span the points of all series', () => {
    const all = [series('a', [point(3), point(9)]), series('b', [point(1)]), series('c', [])];
    assert.deepEqual(spanOf(all, 'iteration', 0), { min: 1, max: 9 });
    assert.deepEqual(spanOf(all, 'time', startOf(all)), { min: 0, max: 8 }, 'seconds from the first point of all');
    assert.deepEqual(spanOf([series('b', [point(4)])], 'iteration', 0), { min: 3, max: 5 });
});

test('at first the tasks that reported last are drawn, twelve at most, in their order', () => {
    const many = Array.from({ length: 30 }, (_, i) => series(`t${i}`, [point(i + 1)]));
    const drawn = firstDrawn([series('none', []), ...many]);
    assert.equal(drawn.length, MOST_DRAWN);
    assert.deepEqual([drawn[0], drawn.at(-1)], ['t18', 't29']);
});

test('a series keeps its colour while others come and go', () => {
    const looks = new Looks();
    looks.keep(new Set(['a', 'b']));
    const before = looks.of('b');
    looks.keep(new Set(['b']));
    looks.keep(new Set(['b', 'c']));
    assert.deepEqual(looks.of('b'), before);
    assert.equal(looks.of('c').colour, '--curve-1', 'that of a, which is gone');
    const twelve = Array.from({ length: 12 }, (_, i) => `t${i}`);
    looks.keep(new Set(twelve));
    assert.equal(new Set(twelve.map((task) => JSON.stringify(looks.of(task)))).size, 12, 'twelve that differ');
});

test('the PSNR of a task that measures nothing is that of its previews', () => {
    const previews = [
        { iteration: 2, psnr: 20 },
        { iteration: 3, psnr: 22 },
        // After the last point: of an attempt that resumed earlier.
        { iteration: 9, psnr: 30 },
    ];
    const one = { ...series('partition-0000', [point(1), point(2), point(4)]), previews };
    assert.ok(isOfPreviews(one));
    assert.deepEqual(previewLine(one, 'iteration', 0), { xs: [2, 3], ys: [20, 22] });
    assert.deepEqual(previewLine(one, 'time', 1000), { xs: [1, 2], ys: [20, 22] }, 'between the points around them');
    assert.deepEqual(previewLine({ ...one, points: [] }, 'time', 1000), { xs: [], ys: [] });
    const measured = { ...one, points: [point(1), point(2, { psnr: 21 })] };
    assert.ok(!isOfPreviews(measured));
    assert.ok(!isOfPreviews({ ...one, previews: [] }));
    assert.equal(psnrTitle([one]), 'PSNR of previews, dB');
    assert.equal(psnrTitle([measured]), 'PSNR on held-out photographs, dB');
    assert.equal(psnrTitle([measured, one]), 'PSNR on held-out photographs or of previews, dB');
    assert.equal(psnrTitle([]), 'PSNR on held-out photographs, dB');
});

test('places read as words', () => {
    assert.equal(placeText(12_000, 'iteration'), 'iteration 12,000');
    assert.equal(placeText(3_700, 'time'), 'after 1 h 1 min');
});
