import assert from 'node:assert/strict';
import { test } from 'node:test';

import { type Lens, freeLensLike, pictureArea, pinholeOf, poseOf, project, projectorOf, worldToCamera } from '../../src/viewer/camera.ts';
import { axesOf, lookingAt, moved, pivotOf, turned, zoomed } from '../../src/viewer/navigation.ts';
import type { CameraEntry } from '../../src/viewer/scene.ts';
import { type Mat3, type Vec3, dot, length, matOfQuat, mulMat, quatOfAxis, quatOfMat, sub } from '../../src/viewer/vector.ts';
import { upOf } from '../../src/viewer/viewer.ts';

// At (1, 2, 3), turned by 90 degrees about y: it looks along +x of the world, its right is -z.
const ENTRY: CameraEntry = {
    id: 0,
    img_name: 'a.jpg',
    width: 200,
    height: 100,
    position: [1, 2, 3],
    rotation: [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    fx: 100,
    fy: 110,
    cx: 90,
    cy: 60,
};

const near = (a: readonly number[], b: readonly number[], tolerance = 1e-12): void =>
    a.forEach((value, i) => assert.ok(Math.abs(value - b[i]!) < tolerance, `${a.join()} is not ${b.join()}`));

test('a camera of cameras.json sees points where its matrix says', () => {
    const { rotation, translation } = worldToCamera(poseOf(ENTRY));
    // 4 ahead, 1 to the right (-z), 2 down (+y).
    const point: Vec3 = [5, 4, 2];
    near(mulMat(rotation, point).map((value, i) => value + translation[i]!), [1, 2, 4]);
    const toPixel = projectorOf(poseOf(ENTRY), pinholeOf(ENTRY));
    const pixel = toPixel(point);
    near([pixel!.x, pixel!.y, pixel!.z], [90 + 25, 60 + 55, 4]);
    assert.equal(toPixel([-5, 4, 2]), null);
});

test('a picture of another size has a scaled camera, principal point included', () => {
    const lens: Lens = { kind: 'exact', pinhole: pinholeOf(ENTRY) };
    assert.deepEqual(project(lens, 400, 200), { width: 400, height: 200, fx: 200, fy: 220, cx: 180, cy: 120 });
    assert.deepEqual(pictureArea(lens, 1000, 700), { x: 0, y: 100, width: 1000, height: 500 });
    assert.deepEqual(pictureArea(lens, 1000, 300), { x: 200, y: 0, width: 600, height: 300 });
    const { cx: _cx, cy: _cy, ...without } = ENTRY;
    assert.deepEqual([pinholeOf(without).cx, pinholeOf(without).cy], [100, 50]);
});

test('a free lens has its field of view along the shorter side', () => {
    const lens = freeLensLike(pinholeOf(ENTRY));
    const camera = project(lens, 300, 100);
    near([camera.fx, camera.fy, camera.cx, camera.cy], [110, 110, 150, 50], 1e-9);
    near([project(lens, 100, 400).fx], [110], 1e-9);
});

test('quaternions and matrices are the same rotations', () => {
    const rotations: Mat3[] = [ENTRY.rotation];
    for (const axis of [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8]] as Vec3[]) {
        for (const angle of [0.3, 2, 3.1, -2.9]) {
            rotations.push(matOfQuat(quatOfAxis(axis, angle)));
        }
    }
    for (const rotation of rotations) {
        near(matOfQuat(quatOfMat(rotation)).flat(), rotation.flat(), 1e-12);
    }
});

test('an orbit keeps its pivot and its distance, and does not tip over', () => {
    const up: Vec3 = [0, -1, 0];
    let place = { pose: lookingAt([0, -2, -4], [0, 0, 0], up), distance: Math.hypot(2, 4) };
    near(pivotOf(place), [0, 0, 0]);
    for (let i = 0; i < 200; i++) {
        place = turned(place, 'orbit', up, 0.07, 0.05);
    }
    near(pivotOf(place), [0, 0, 0], 1e-9);
    near([length(place.pose.position)], [Math.hypot(2, 4)], 1e-9);
    const { forward, right } = axesOf(place.pose.rotation);
    assert.ok(dot(forward, up) > 0.99 && dot(forward, up) < 1, 'it looks up, and stops before the vertical');
    assert.ok(Math.abs(dot(right, up)) < 1e-6, 'the horizon stays level');
    place = zoomed(place, 'orbit', 0.5);
    near(pivotOf(place), [0, 0, 0], 1e-9);
});

test('walking stays at its height, flying does not', () => {
    const up: Vec3 = [0, -1, 0];
    const place = { pose: lookingAt([0, -2, -4], [0, 0, 0], up), distance: 4 };
    const walked = moved(place, 'walk', up, [0, 0, 3]);
    near(sub(walked.pose.position, place.pose.position), [0, 0, 3], 1e-12);
    const flown = moved(place, 'fly', up, [0, 0, 3]);
    assert.ok(flown.pose.position[1] > -2, 'down, where the camera looks');
    const down = { pose: lookingAt([0, -5, 0], [0, 0, 0], up), distance: 5 };
    near([moved(down, 'walk', up, [0, 0, 1]).pose.position[1]], [-5], 1e-9);
});

test('turning takes the roll of a photograph out', () => {
    const up: Vec3 = [0, -1, 0];
    const { position, rotation } = lookingAt([0, 0, 0], [0, 0, 1], up);
    const tilted = quatOfMat(matOfQuat(quatOfAxis([0, 0, 1], 0.4)));
    let place = { pose: { position, rotation: tilted }, distance: 1 };
    near(rotation, [0, 0, 0, 1]);
    for (let i = 0; i < 100; i++) {
        place = turned(place, 'fly', up, 0.05, 0);
    }
    assert.ok(Math.abs(dot(axesOf(place.pose.rotation).right, up)) < 1e-3);
});

test('up is that of the plan, else the mean over the cameras', () => {
    near(upOf(null, [ENTRY]), [0, -1, 0]);
    near(upOf(null, []), [0, -1, 0]);
    const alignment = { down: [0, 0, -2] as Vec3, world_to_aligned_quat_wxyz: [1, 0, 0, 0] as const };
    near(upOf({ alignment, partitions: [] }, [ENTRY]), [0, 0, 1]);
});
