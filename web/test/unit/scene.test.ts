import assert from 'node:assert/strict';
import { test } from 'node:test';

import { type SavedView, fragmentOf, readFragment } from '../../src/viewer/link.ts';
import { partitionsOf } from '../../src/viewer/partitions.ts';
import { type Plan, checkScene } from '../../src/viewer/scene.ts';
import { sortByDepth } from '../../src/viewer/sort-worker.ts';

const VIEW: SavedView = {
    pose: { position: [1.25, -2, 1e-3], rotation: [0, 0.6, 0, 0.8] },
    fov: 1,
    photograph: null,
    left: 'clear',
    right: 'water',
    split: 0.25,
    amount: 2.5,
};
const PLAN: Plan = {
    alignment: { down: [0, 1, 0], world_to_aligned_quat_wxyz: [1, 0, 0, 0] },
    partitions: [
        { id: 0, cell: { x: { lo: null, hi: 1 }, z: { lo: null, hi: null } } },
        { id: 1, cell: { x: { lo: 1, hi: null }, z: { lo: null, hi: 5 } } },
        { id: 2, cell: { x: { lo: 1, hi: null }, z: { lo: 5, hi: null } } },
    ],
};

test('a link holds the view and the bookmarks', () => {
    const named = { name: 'bow & stern ~ 50 %', view: { ...VIEW, photograph: 'left/a b.jpg', fov: null } };
    const { view, bookmarks } = readFragment(`#${fragmentOf(VIEW, [named, { name: 'two', view: VIEW }])}`);
    assert.ok(Math.abs(view!.fov! - 1) < 1e-6);
    assert.deepEqual({ ...view, fov: 1 }, VIEW);
    assert.equal(bookmarks.length, 2);
    assert.deepEqual(bookmarks[0], named);
});

test('a damaged link shows the first view, and wrong parts are left out', () => {
    for (const fragment of ['', '#', '#c=1,2', '#c=1,2,3,0,0,0,0', '#c=a,b,c,d,e,f,g', '#b=x~c=1']) {
        assert.deepEqual(readFragment(fragment), { view: null, bookmarks: [] }, fragment);
    }
    const { view } = readFragment('#c=1,2,3,0,0,0,2&m=nothing,script&s=7&w=-3&f=1e9');
    assert.deepEqual([view?.left, view?.right, view?.split, view?.amount], ['clear', 'none', 1, 0]);
    assert.deepEqual(view?.pose.rotation, [0, 0, 0, 1]);
});

test('a Gaussian belongs to the cell of its centre; lo is excluded, hi included', () => {
    const centres = new Float32Array([0, 0, 0, 1, 0, 9, 1.5, 0, 5, 1.5, 0, 5.1]);
    assert.deepEqual([...partitionsOf(PLAN, centres)], [0, 0, 1, 2]);
    // Turned by 90 degrees about y: x of the cells is z of the scene.
    const half = Math.SQRT1_2;
    const turned = { ...PLAN, alignment: { ...PLAN.alignment, world_to_aligned_quat_wxyz: [half, 0, half, 0] as const } };
    assert.deepEqual([...partitionsOf(turned, new Float32Array([0, 0, 2]))], [1]);
});

test('the sort is exact, farthest first, and leaves out what is behind or not a number', () => {
    const count = 5000;
    const centres = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) {
        // Depths that differ by little, so that classes of depth would mix them.
        centres[3 * i + 2] = i % 7 === 0 ? -1 : 10 + ((i * 7919) % count) * 1e-5;
    }
    centres[2] = Number.NaN;
    const [keys, spare, order] = [new Uint32Array(count), new Uint32Array(count), new Uint32Array(count)];
    const sorted = sortByDepth(centres, [0, 0, 1, 0], keys, spare, order);
    assert.equal(sorted, count - Math.ceil(count / 7));
    for (let i = 1; i < sorted; i++) {
        assert.ok(centres[3 * order[i - 1]! + 2]! >= centres[3 * order[i]! + 2]!, `at ${i}`);
    }
});

test('a scene is checked, and what is absent has a default', () => {
    const scene = checkScene({ model: 'model.ply' });
    assert.deepEqual(scene, { name: 'Scene', model: 'model.ply', water: null, cameras: null, plan: null, photographs: {}, credits: '' });
    const refused = (value: unknown, why: RegExp): void => assert.throws(() => checkScene(value), why);
    refused(null, /not an object/);
    refused({}, /model must be/);
    refused({ model: 'm', cameras: {} }, /cameras must be a list/);
    refused({ model: 'm', cameras: [{ img_name: 'a.jpg', width: 0 }] }, /camera 0 \("a.jpg"\)/);
    refused({ model: 'm', photographs: { a: 1 } }, /photographs must map/);
    refused({ model: 'm', plan: { alignment: {} } }, /plan.alignment/);
    refused({ model: 'm', water: {} }, /The water cannot be used/);
});
