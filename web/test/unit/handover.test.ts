// The parts of a page in one file: its files in base64, and the views that it suggests.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { decodeBase64 } from '../../src/base64.ts';
import { spreadOver } from '../../src/viewer/presets.ts';
import type { CameraEntry } from '../../src/viewer/scene.ts';

const cameraAt = (x: number, y: number): CameraEntry => ({
    id: 0,
    img_name: `${x} ${y}`,
    width: 4,
    height: 3,
    position: [x, y, 0],
    rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    fx: 1,
    fy: 1,
});

test('base64 of any length is decoded to the last byte', () => {
    for (const length of [0, 1, 2, 3, 4, 5, 1000, 800_001]) {
        const bytes = Buffer.from(Uint8Array.from({ length }, (_, i) => (i * 7) % 256));
        assert.ok(bytes.equals(decodeBase64(bytes.toString('base64'))), `${length} bytes`);
    }
    assert.throws(() => decodeBase64('a*bc'));
});

test('suggested views begin in the middle and go to the ends', () => {
    const row = [0, 1, 2, 3, 4, 5, 6].map((x) => cameraAt(x, 0));
    const names = (count: number): string[] => spreadOver(row, count).map(({ img_name }) => img_name);
    assert.deepEqual(names(3), ['3 0', '0 0', '6 0']);
    assert.deepEqual(names(20).toSorted(), row.map(({ img_name }) => img_name));
    assert.deepEqual(spreadOver([], 6), []);
});

test('cameras at one place are suggested once', () => {
    const cameras = [cameraAt(1, 1), cameraAt(1, 1), cameraAt(2, 1), cameraAt(1, 1)];
    assert.deepEqual(spreadOver(cameras, 6).map(({ position }) => position), [[1, 1, 0], [2, 1, 0]]);
});
