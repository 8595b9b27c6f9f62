// By what the map of a plan shades its cells: scales, legends, and whether words on them are legible.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { join } from 'node:path';
import { test } from 'node:test';

import type { TaskInfo } from '../../src/pages/parts/part.ts';
import { type PlanContent, cellStates } from '../../src/pages/parts/plan-layout.ts';
import {
    MOST_WORKERS,
    WorkerShades,
    contrast,
    inkOn,
    luminance,
    mixed,
    orderedColour,
    psnrScale,
    shadingOf,
    stepOf,
} from '../../src/pages/parts/plan-shades.ts';

const planOf = (count: number): PlanContent => ({
    alignment: { world_to_aligned_quat_wxyz: [1, 0, 0, 0] },
    extent: { viewing_distance: 2, cameras: { min: [0, 0, 0], max: [1, 1, 1] } },
    views: 4,
    held_out: [],
    partitions: Array.from({ length: count }, (_, id) => ({
        id,
        cell: { x: { lo: id, hi: id + 1 }, z: { lo: null, hi: null } },
        extended_box: { min: [0, 0, 0], max: [1, 1, 1] },
        base_views: [],
        chosen_views: Array.from({ length: 10 * id }, (__, view) => view),
        filled_views: id === 1 ? 4 : 0,
        cell_points: 0,
        iterations: 100,
        max_gaussians: 100,
    })),
});
const task = (partition: number, worker: string | null, change: Partial<TaskInfo> = {}): TaskInfo => ({
    task: `partition-${partition}`,
    stage: 'partition',
    partition,
    state: 'running',
    worker,
    iteration: 1,
    iterations: 100,
    attempts: 1,
    psnr: null,
    ...change,
});
/** The colours of the pages as #rrggbb, in light and in dark. */
const [LIGHT, DARK] = ((): [Map<string, string>, Map<string, string>] => {
    const css = readFileSync(join(import.meta.dirname, '../../src/pages/parts/parts.css'), 'utf8');
    const [light = '', dark = ''] = css.split('@media (prefers-color-scheme: dark)');
    const read = (text: string): Map<string, string> =>
        new Map([...text.matchAll(/(--[\w-]+): (#[\da-f]{6});/g)].map(([, name, value]) => [name!, value!]));
    return [read(light), new Map([...read(light), ...read(dark)])];
})();

test('a scale of PSNR has round steps, few of them, and holds all values', () => {
    assert.equal(psnrScale([]), null);
    assert.equal(psnrScale([Number.NaN]), null);
    assert.deepEqual(psnrScale([24.3]), { from: [24], width: 0.5 });
    assert.deepEqual(psnrScale([21.2, 25.9]), { from: [21, 22, 23, 24, 25], width: 1 });
    for (const values of [[3, 70], [24, 24.01], [-4, 2], [19.99, 20], [0, 1e6]]) {
        const scale = psnrScale(values)!;
        assert.ok(scale.from.length <= 6);
        assert.equal(stepOf(scale, values[0]!), 0);
        assert.equal(stepOf(scale, values[1]!), scale.from.length - 1);
    }
    const scale = psnrScale([21.2, 25.9])!;
    assert.deepEqual([20, 21, 21.99, 22, 99].map((value) => stepOf(scale, value)), [0, 0, 0, 1, 4]);
});

test('the scale is ordered: each step is lighter than the one below', () => {
    for (const count of [2, 3, 6]) {
        const lights = Array.from({ length: count }, (_, step) => luminance(orderedColour(step, count)));
        assert.ok(lights.every((light, i) => i === 0 || light > lights[i - 1]! + 0.01), String(lights));
    }
    assert.equal(orderedColour(0, 6), '#440154');
    assert.equal(orderedColour(5, 6), '#fde725');
    assert.match(orderedColour(0, 1), /^#[\da-f]{6}$/);
});

test('words are legible on every shade, in light and dark', () => {
    const steps = Array.from({ length: 6 }, (_, step) => orderedColour(step, 6));
    for (const colours of [LIGHT, DARK]) {
        const workers = Array.from({ length: 8 }, (_, i) => colours.get(`--worker-${i + 1}`)!);
        const cameras = [0.1, 0.35, 0.6].map((share) => mixed(colours.get('--panel')!, colours.get('--accent')!, share));
        for (const fill of [...steps, ...workers, ...cameras, colours.get('--waiting-fill')!]) {
            assert.ok(contrast(fill, inkOn(fill)) >= 4.5, fill);
        }
        workers.forEach((fill) => assert.ok(contrast(fill, colours.get('--ink')!) >= 4.5, fill));
    }
});

test('colours of workers differ from each other and from cells without one, in light and dark', () => {
    const parts = (hex: string): number[] => [1, 3, 5].map((at) => Number.parseInt(hex.slice(at, at + 2), 16));
    const apart = (a: string, b: string): number => Math.hypot(...parts(a).map((value, i) => value - parts(b)[i]!));
    for (const colours of [LIGHT, DARK]) {
        const names = [...Array.from({ length: 8 }, (_, i) => `--worker-${i + 1}`), '--waiting-fill'];
        for (const [i, a] of names.entries()) {
            for (const b of names.slice(i + 1)) {
                assert.ok(apart(colours.get(a)!, colours.get(b)!) > 38, `${a} and ${b}`);
            }
        }
    }
});

test('workers have a legend, and those that cannot be told apart share a shade', () => {
    const plan = planOf(4);
    const tasks = [task(0, 'gpu-2'), task(1, 'gpu-10', { state: 'done' }), task(2, 'gpu-2', { state: 'ready' })];
    const shades = new WorkerShades();
    const few = shadingOf('worker', plan, cellStates(plan, tasks), shades)!;
    assert.deepEqual(
        few.legend.map(({ text, shade }) => [text, shade.fill, shade.pattern]),
        [
            ['gpu-2: 1 cell', '--worker-1', 'plain'],
            ['gpu-10: 1 cell', '--worker-2', 'plain'],
            ['plain: no worker, 2 cells', '--waiting-fill', 'plain'],
        ],
    );
    assert.deepEqual(plan.partitions.map((one) => few.of(one).words), ['gpu-2', 'gpu-10', 'no worker', 'no worker']);
    const many = planOf(MOST_WORKERS + 3);
    const all = many.partitions.map(({ id }) => task(id, `w${id}`));
    const crowd = shadingOf('worker', many, cellStates(many, all), new WorkerShades())!;
    assert.equal(crowd.legend.length, MOST_WORKERS + 1);
    assert.equal(crowd.legend.at(-1)?.text, '3 other workers: 3 cells');
    assert.equal(new Set(crowd.legend.map(({ shade }) => JSON.stringify(shade))).size, MOST_WORKERS + 1);
});

test('a worker keeps its shade while others come and go', () => {
    const shades = new WorkerShades();
    shades.keep(new Set(['a', 'b']));
    const before = shades.of('b');
    shades.keep(new Set(['b', 'c']));
    assert.deepEqual(shades.of('b'), before);
    assert.equal(shades.of('c')?.fill, '--worker-1', 'that of a, which is gone');
    assert.equal(shades.of('a'), null);
});

test('PSNR has a legend with numbers, and cells without one are hatched', () => {
    const plan = planOf(4);
    const tasks = [task(0, 'w', { psnr: 24.5 }), task(1, 'w', { previewPsnr: 27.1 }), task(2, 'w')];
    const { legend, of } = shadingOf('psnr', plan, cellStates(plan, tasks), new WorkerShades())!;
    assert.deepEqual(legend.map(({ text }) => text), [
        '24.5 to 25.0 dB', '25.0 to 25.5 dB', '25.5 to 26.0 dB', '26.0 to 26.5 dB', '26.5 to 27.0 dB', '27.0 to 27.5 dB',
        'hatched: no PSNR yet, 2 cells',
    ]);
    const cells = plan.partitions.map(of);
    assert.deepEqual(cells.map(({ words }) => words), ['24.50 dB', '27.10 dB', 'no PSNR', 'no PSNR']);
    assert.deepEqual(cells.map(({ number }) => number), ['25', '27', '', '']);
    assert.equal(cells[0]!.shade.fill, legend[0]!.shade.fill);
    assert.equal(cells[2]!.shade.pattern, 'hatched');
    const none = shadingOf('psnr', plan, cellStates(plan, []), new WorkerShades())!;
    assert.deepEqual(none.legend.map(({ text }) => text), ['hatched: no PSNR yet, 4 cells']);
});

test('cells that too few cameras see are hatched', () => {
    const plan = planOf(3);
    const { legend, of } = shadingOf('cameras', plan, cellStates(plan, []), new WorkerShades())!;
    assert.deepEqual(legend.map(({ text }) => text), [
        '0 cameras', '10 cameras', '20 cameras', 'hatched: seen by too few, 1 cell',
    ]);
    assert.deepEqual(plan.partitions.map((one) => [of(one).words, of(one).shade.pattern]), [
        ['0 cameras', 'plain'], ['6 cameras', 'hatched'], ['20 cameras', 'plain'],
    ]);
    assert.equal(shadingOf('state', plan, cellStates(plan, []), new WorkerShades()), null);
});
