import assert from 'node:assert/strict';
import { test } from 'node:test';

import {
    type ComparedView,
    difference,
    meanDifference,
    possible,
    possibleSides,
    sidesOf,
    sidesText,
    worstFirst,
} from '../../src/pages/parts/view-difference.ts';

const picture = async (): Promise<string> => 'blob:x';
const view = (name: string, psnr: number | null, change: Partial<ComparedView> = {}): ComparedView => ({
    name,
    psnr,
    ssim: null,
    photograph: picture,
    render: picture,
    clear: null,
    ...change,
});

test('the worst view comes first, and views that were not measured last', () => {
    const views = [view('c', null), view('b10', 20), view('a', 25), view('b9', 20)];
    assert.deepEqual(
        worstFirst(views).map(({ name }) => name),
        ['b9', 'b10', 'a', 'c'],
    );
    assert.equal(views[0]!.name, 'c', 'the given list stays as it is');
});

test('a difference has no sign, is amplified and clamped', () => {
    const a = new Uint8ClampedArray([10, 20, 250, 7]);
    const b = new Uint8ClampedArray([12, 15, 50, 200]);
    const out = new Uint8ClampedArray(4);
    difference(a, b, 4, out);
    assert.deepEqual([...out], [8, 20, 255, 255]);
    difference(b, a, 1, out);
    assert.deepEqual([...out], [2, 5, 200, 255]);
    assert.equal(meanDifference(a, b), (2 + 5 + 200) / 3);
    assert.equal(meanDifference(new Uint8ClampedArray(), new Uint8ClampedArray()), 0);
});

test('the divider offers pairs that have both pictures', () => {
    const wet = view('a', 1, { clear: picture });
    assert.deepEqual(possibleSides(wet), ['photograph-render', 'photograph-clear', 'render-clear']);
    assert.deepEqual(possibleSides(view('a', 1)), ['photograph-render']);
    assert.deepEqual(possibleSides({ ...wet, photograph: null }), ['render-clear']);
    assert.deepEqual(possibleSides({ ...wet, render: null }), ['photograph-clear']);
    assert.deepEqual(possibleSides({ ...wet, render: null, clear: null }), []);
    assert.deepEqual(possibleSides(wet).map(sidesText), [
        'Photograph and render',
        'Photograph and scene without water',
        'Render and scene without water',
    ]);
    assert.deepEqual(sidesOf('render-clear'), ['render', 'clear']);
});

test('only what has its pictures can be shown', () => {
    assert.deepEqual([...possible(view('a', 1))].toSorted(), ['compare', 'difference', 'photograph', 'render']);
    const withoutPhotograph = view('a', 1, { photograph: null, clear: picture });
    assert.deepEqual([...possible(withoutPhotograph)], ['render', 'compare', 'clear']);
    assert.deepEqual([...possible(view('a', 1, { photograph: null, render: null }))], []);
});
