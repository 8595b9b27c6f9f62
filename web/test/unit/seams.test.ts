// Seams: where borders are, and what the numbers say.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import type { PlanContent } from '../../src/pages/parts/index.ts';
import { borders, middles } from '../../src/pages/parts/seam-lines.ts';
import { type SeamContent, seamRows, seamVerdict, stepText } from '../../src/pages/parts/seam-report.ts';

const bounds = (lo: number | null, hi: number | null) => ({ lo, hi });
/** The same cells as in the test of coordinator/plan/src/seam_lines.rs. */
const CELLS = [
    { x: bounds(null, 2), z: bounds(null, 1) },
    { x: bounds(null, 2), z: bounds(1, null) },
    { x: bounds(2, null), z: bounds(null, -3) },
    { x: bounds(2, null), z: bounds(-3, null) },
];

test('a grid has lines between columns and pieces between rows', () => {
    const expected = [
        { axis: 'x', at: 2, from: -Infinity, to: Infinity },
        { axis: 'z', at: -3, from: 2, to: Infinity },
        { axis: 'z', at: 1, from: -Infinity, to: 2 },
    ];
    assert.deepEqual(borders(CELLS), expected);
    assert.deepEqual(borders(CELLS.toReversed()), expected);
    const plan = {
        extent: { viewing_distance: 1, cameras: { min: [-10, -10, -10], max: [10, 10, 10] } },
        partitions: CELLS.map((cell, id) => ({ id, cell })),
    } as unknown as PlanContent;
    const at = (axis: string): number[] =>
        middles(plan, 0.1 / 4)
            .filter((line) => line.axis === axis)
            .map((line) => line.at);
    assert.deepEqual(at('x'), [-4, 6]);
    assert.deepEqual(at('z'), [-6.5, -4.5, 3.5, 5.5]);
});

test('one cell has no borders, and narrow cells have no middle', () => {
    const whole = { x: bounds(null, null), z: bounds(null, null) };
    assert.deepEqual(borders([whole]), []);
    const plan = {
        extent: { viewing_distance: 1, cameras: { min: [-10, -10, -10], max: [10, 10, 10] } },
        partitions: [
            { cell: { ...whole, x: bounds(null, 9.5) } },
            { cell: { ...whole, x: bounds(9.5, null) } },
        ],
    } as unknown as PlanContent;
    assert.equal(middles(plan, 0.3 / 4).length, 1);
    assert.equal(middles(plan, 0.2 / 4).length, 2);
});

const band = (loss_db: number | null, loss_db_error: number | null) => ({
    views: 3,
    psnr: 26,
    ssim: 0.7,
    flank_psnr: 26.5,
    flank_ssim: 0.71,
    loss_db,
    loss_db_error,
    interior_psnr: 25,
    pixels: 1000,
});
const STEPS = { pairs: 400, median: 0.018, beside_median: 0.012, ratio: 1.5 };
const report = (border: SeamContent['border'], control: SeamContent['control']): SeamContent => ({
    band: 0.2,
    border,
    control,
    range_step: { border: STEPS, control: { ...STEPS, ratio: 1.1 } },
});

test('borders show where they lose more than the content explains', () => {
    const { shows, text } = seamVerdict(report(band(0.5, 0.1), band(0.1, 0.1)));
    assert.equal(shows, true);
    assert.equal(
        text,
        'Borders show. Along borders the model is 0.50 dB worse than right beside them; ' +
            'along lines where nothing was cut it is 0.10 dB worse than right beside them.',
    );
    // 0.4 dB more with an error of 0.22 may be chance.
    assert.equal(seamVerdict(report(band(0.5, 0.2), band(0.1, 0.1))).shows, false);
    assert.match(
        seamVerdict(report(band(-1.45, 0.2), band(-0.7, 0.6))).text,
        /^Borders do not show\. .*1\.45 dB better/,
    );
});

test('without enough views there is no verdict on borders', () => {
    assert.match(seamVerdict(report(band(null, null), band(null, null))).text, /seams\.least_share/);
    const single = seamVerdict(report(band(0.5, null), band(0.1, null)));
    assert.equal(single.shows, null);
    assert.match(single.text, /too few views/);
    assert.match(seamVerdict(report(band(0.5, 0.1), band(null, null))).text, /nothing to compare that with/);
});

test('the step of the surface is told as a share of its depth', () => {
    assert.equal(
        stepText(report(band(0, 0), band(0, 0)).range_step),
        'The surface steps by 1.8 % of its depth across borders, 1.50 times as much as beside them. ' +
            'Where nothing was cut it is 1.10 times.',
    );
    const none = { ...STEPS, median: null };
    assert.equal(stepText({ border: none, control: STEPS }), '');
});

test('every measure is told of borders and of lines where nothing was cut', () => {
    const rows = seamRows(report(band(0.5, 0.1), band(null, null)));
    const loss = rows.find(({ title }) => title.startsWith('Loss'));
    assert.deepEqual([loss?.border, loss?.control], ['0.50 ± 0.10', '–']);
    assert.equal(rows.find(({ title }) => title.startsWith('Ratio'))?.control, '1.10');
});
