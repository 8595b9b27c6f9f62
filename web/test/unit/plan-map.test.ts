import assert from 'node:assert/strict';
import { test } from 'node:test';

import { type TaskInfo, shownPsnr } from '../../src/pages/parts/part.ts';
import {
    type PlanContent,
    type PlanPartition,
    areaOf,
    cameraAt,
    camerasOf,
    cellStates,
    clampView,
    countStates,
    isCrowded,
    nextPartition,
    partitionAt,
    pixelsPerCamera,
    placeCameras,
    project,
    quietPlace,
    seenBy,
} from '../../src/pages/parts/plan-layout.ts';
import type { CameraEntry } from '../../src/viewer/scene.ts';
import {
    type Mat3,
    type Quat,
    mulMat,
    quatInverse,
    quatOfAxis,
    quatOfMat,
    rotate,
    scale,
} from '../../src/viewer/vector.ts';

type Interval = readonly [number | null, number | null];

function partition(
    id: number,
    [x0, x1]: Interval,
    [z0, z1]: Interval,
    change: Partial<PlanPartition> = {},
): PlanPartition {
    return {
        id,
        cell: { x: { lo: x0, hi: x1 }, z: { lo: z0, hi: z1 } },
        extended_box: { min: [x0 ?? -6, -1, z0 ?? -4], max: [x1 ?? 6, 1, z1 ?? 4] },
        base_views: [],
        chosen_views: [],
        filled_views: 0,
        cell_points: 0,
        iterations: 300,
        max_gaussians: 2000,
        ...change,
    };
}

/** Four cells about the origin: 0 and 1 on the left from low to high z, 2 and 3 on the right. */
const PLAN: PlanContent = {
    columns: 2,
    rows: 2,
    alignment: { world_to_aligned_quat_wxyz: [1, 0, 0, 0] },
    extent: { viewing_distance: 2, cameras: { min: [-5, 0, -3], max: [5, 0, 3] } },
    views: 4,
    held_out: [0],
    partitions: [
        partition(0, [null, 0], [null, 0], { base_views: [1], chosen_views: [1, 2, 3], filled_views: 2 }),
        partition(1, [null, 0], [0, null]),
        partition(2, [0, null], [null, 0], { base_views: [2, 3] }),
        partition(3, [0, null], [0, null]),
    ],
};
const TASK: TaskInfo = {
    task: 'partition-0000',
    stage: 'partition',
    partition: 0,
    state: 'running',
    worker: 'w',
    iteration: 75,
    iterations: 300,
    attempts: 1,
    psnr: null,
};

function camera(id: number, x: number, z: number, turn = 0): CameraEntry {
    const [s, c] = [Math.sin(turn), Math.cos(turn)];
    const rotation: Mat3 = [
        [c, 0, s],
        [0, 1, 0],
        [-s, 0, c],
    ];
    return { id, img_name: `${id}.jpg`, width: 4, height: 3, position: [x, -1, z], rotation, fx: 4, fy: 4 };
}

test('cameras are placed with the direction they look, their partition, and whether they are held out', () => {
    const placed = placeCameras(PLAN, [camera(0, -2, 1), camera(2, 3, -1, Math.PI / 2)]);
    assert.deepEqual([placed[0]!.x, placed[0]!.z, placed[0]!.dx, placed[0]!.dz], [-2, 1, 0, 1]);
    assert.deepEqual([placed[0]!.isHeldOut, placed[0]!.owner], [true, null]);
    assert.ok(Math.abs(placed[1]!.dx - 1) < 1e-12 && Math.abs(placed[1]!.dz) < 1e-12);
    assert.deepEqual([placed[1]!.isHeldOut, placed[1]!.owner], [false, 2]);
    assert.deepEqual(placeCameras(PLAN, null), []);
});

test('a manifest gives the same places as cameras.json, also in a turned plan', () => {
    const [w, y] = [Math.cos(0.4), Math.sin(0.4)];
    const plan: PlanContent = { ...PLAN, alignment: { world_to_aligned_quat_wxyz: [w, 0, y, 0] } };
    const entry = camera(0, 1.5, 2.5, 0.7);
    const toCamera: Quat = quatInverse(quatOfMat(entry.rotation));
    const view = {
        name: '0.jpg',
        pose: { rotation: toCamera, translation: scale(rotate(toCamera, entry.position), -1) },
    };
    const [[a], [b]] = [placeCameras(plan, [entry]), placeCameras(plan, { views: [view] })];
    for (const key of ['x', 'z', 'dx', 'dz'] as const) {
        assert.ok(Math.abs(a![key] - b![key]) < 1e-12, `${key}: ${a![key]} and ${b![key]}`);
    }
    const turned = rotate(quatOfAxis([0, 1, 0], 0.8), entry.position);
    assert.ok(Math.abs(a!.x - turned[0]) < 1e-12 && Math.abs(a!.z - turned[2]) < 1e-12);
    assert.ok(Math.abs(a!.dx - mulMat(entry.rotation, [0, 0, 1])[0]) > 0.1, 'the direction is turned too');
});

test('a cell has the state and the share of its task', () => {
    const states = cellStates(PLAN, [
        TASK,
        { ...TASK, partition: 1, state: 'done' },
        { ...TASK, partition: 2, state: 'blocked', iteration: 0 },
        { ...TASK, partition: 9, state: 'failed' },
        { ...TASK, stage: 'global', partition: null, state: 'failed' },
    ]);
    assert.deepEqual(
        [0, 1, 2, 3].map((id) => states.get(id)!.state),
        ['running', 'done', 'waiting', 'waiting'],
    );
    assert.deepEqual(
        [0, 1, 2].map((id) => states.get(id)!.share),
        [0.25, 1, 0],
    );
    assert.deepEqual(countStates(states.values()), { waiting: 2, running: 1, done: 1, failed: 0, cancelled: 0 });
});

test('with an exchange the first part counts until the rest begins', () => {
    const of = (first: string, rest: string) => {
        const tasks = [
            { ...TASK, state: rest },
            { ...TASK, stage: 'first_part', task: 'first_part-0000', state: first },
        ];
        const { state, isFirstPart } = cellStates(PLAN, tasks).get(0)!;
        return [state, isFirstPart];
    };
    assert.deepEqual(of('running', 'blocked'), ['running', true]);
    assert.deepEqual(of('done', 'blocked'), ['waiting', true]);
    assert.deepEqual(of('ready', 'blocked'), ['waiting', true]);
    assert.deepEqual(of('done', 'running'), ['running', false]);
    assert.deepEqual(of('failed', 'cancelled'), ['failed', true]);
    assert.deepEqual(of('done', 'done'), ['done', false]);
});

test('a measured PSNR counts before that of previews', () => {
    assert.deepEqual(shownPsnr({ psnr: 24, previewPsnr: 20 }), { value: 24, isOfPreviews: false });
    assert.deepEqual(shownPsnr({ psnr: null, previewPsnr: 20 }), { value: 20, isOfPreviews: true });
    assert.equal(shownPsnr({ psnr: null }), null);
    assert.equal(shownPsnr({ psnr: Number.NaN, previewPsnr: null }), null);
    assert.equal(shownPsnr(null), null);
});

test('x is to the right and z up, and pixels lead back to the plane', () => {
    const area = areaOf(PLAN, []);
    const projection = project(area, 600, 400, { zoom: 1, x: 0, z: 0 });
    assert.deepEqual([projection.x(0), projection.y(0)], [300, 200]);
    assert.ok(projection.x(1) > 300 && projection.y(1) < 200);
    const at = projection.at(projection.x(1.5), projection.y(-2.5));
    assert.ok(Math.abs(at.x - 1.5) < 1e-9 && Math.abs(at.z + 2.5) < 1e-9);
});

test('everything with a place is on the whole map, and open cells end at its frame', () => {
    const area = areaOf(PLAN, placeCameras(PLAN, [camera(0, 20, 0)]));
    const projection = project(area, 500, 500, clampView(area, 500, 500, { zoom: 1, x: 99, z: 99 }));
    assert.ok(projection.x(20) < 500 && projection.x(-6) > 0 && projection.y(4) > 0 && projection.y(-4) < 500);
    const [left, top, right, bottom] = projection.rect(PLAN.partitions[1]!.cell);
    const near = [left, top, right - projection.x(0), bottom - projection.y(0)];
    assert.ok(
        near.every((value) => Math.abs(value) < 1e-6),
        String(near),
    );
});

test('a zoomed map cannot be moved beyond its frame', () => {
    const area = { x0: -10, x1: 10, z0: -10, z1: 10 };
    const view = clampView(area, 400, 400, { zoom: 2, x: 50, z: -50 });
    assert.deepEqual(view, { zoom: 2, x: 5, z: -5 });
    assert.deepEqual(clampView(area, 400, 400, { zoom: 0.1, x: 3, z: 3 }), { zoom: 1, x: 0, z: 0 });
});

test('a place belongs to the cell that contains it; lo is excluded, hi included', () => {
    assert.equal(partitionAt(PLAN, 0, 0)?.id, 0);
    assert.equal(partitionAt(PLAN, 0.1, 0)?.id, 2);
    assert.equal(partitionAt(PLAN, 1e6, 1e6)?.id, 3);
});

test('arrow keys go to the neighbour in their direction and stop at the edge', () => {
    const area = areaOf(PLAN, []);
    const go = (from: number, dx: number, dz: number) => nextPartition(PLAN, area, PLAN.partitions[from]!, dx, dz).id;
    assert.deepEqual([go(0, 1, 0), go(0, 0, 1), go(0, -1, 0), go(3, 0, -1), go(3, -1, 0)], [2, 1, 0, 2, 1]);
});

test('the nearest camera within reach is found, and crowds are recognised', () => {
    const area = { x0: 0, x1: 10, z0: 0, z1: 10 };
    const projection = project(area, 100, 100, { zoom: 1, x: 5, z: 5 });
    const cameras = placeCameras(PLAN, [camera(1, 2, 2), camera(2, 3, 2)]);
    assert.equal(cameraAt(cameras, projection, 28, 80, 12)?.index, 2);
    assert.equal(cameraAt(cameras, projection, 60, 20, 12), null);
    assert.equal(isCrowded(pixelsPerCamera(area, projection, cameras)), false);
    assert.equal(
        isCrowded(
            pixelsPerCamera(
                area,
                projection,
                Array.from({ length: 500 }, () => cameras[0]!),
            ),
        ),
        true,
    );
});

test('a label moves away from cameras', () => {
    const cell = [0, 0, 200, 200] as const;
    assert.deepEqual(quietPlace(cell, 20, 10, []), [100, 100]);
    const [x, y] = quietPlace(cell, 20, 10, [
        [100, 100],
        [95, 104],
    ]);
    assert.ok(Math.abs(x - 100) >= 24 || Math.abs(y - 100) >= 14, `${x}, ${y}`);
});

test('cameras that were added below the threshold do not count as seeing a cell', () => {
    assert.equal(seenBy(PLAN.partitions[0]!), 1);
});

test('the photographs of a partition are its own and the held-out ones in its cell', () => {
    const cameras = placeCameras(PLAN, [camera(0, -2, -1), camera(1, -1, -1), camera(2, -3, -1)]);
    assert.deepEqual(
        camerasOf(PLAN.partitions[0]!, cameras).map(({ index }) => index),
        [0, 1],
    );
    assert.deepEqual(
        camerasOf(PLAN.partitions[2]!, cameras).map(({ index }) => index),
        [2],
        'its own, wherever it stands',
    );
});
