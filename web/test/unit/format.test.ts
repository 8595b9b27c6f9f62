import assert from 'node:assert/strict';
import { test } from 'node:test';

import {
    brief,
    counted,
    decibels,
    duration,
    memory,
    percent,
    roundLength,
    timeStep,
} from '../../src/pages/parts/format.ts';

test('numbers are short and without exponents where possible', () => {
    assert.deepEqual(
        [0, 0.012345, 1.5, 12.345, 1234.5, 12345, 1e-7, Number.NaN].map((value) => brief(value)),
        ['0', '0.0123', '1.50', '12.3', '1,235', '12,345', '1.00e-7', 'not known'],
    );
});

test('times have at most two units', () => {
    assert.deepEqual([0, 420, 42_000, 200_000, 7_500_000, 273_600_000].map(duration), [
        '0 s',
        '420 ms',
        '42 s',
        '3 min 20 s',
        '2 h 5 min',
        '3 d 4 h',
    ]);
});

test('counts, memory, shares and decibels have their units', () => {
    assert.deepEqual([counted(1, 'camera'), counted(2000, 'camera')], ['1 camera', '2,000 cameras']);
    assert.deepEqual([0, 1536, 5.2e9, 2 ** 40].map(memory), ['0 B', '1.50 KiB', '4.84 GiB', '1.00 TiB']);
    assert.deepEqual([0, 0.0001, 0.046, 0.5, 1].map(percent), ['0 %', 'below 0.1 %', '4.6 %', '50 %', '100 %']);
    assert.deepEqual([decibels(24.305), decibels(null)], ['24.30 dB', 'not measured']);
});

test('marks of an axis lie at round times and lengths', () => {
    assert.equal(timeStep(80 * 60_000, 8), 600_000);
    assert.equal(timeStep(1, 8), 1000);
    assert.equal(timeStep(365 * 86_400_000, 4) % 604_800_000, 0);
    assert.deepEqual([0.7, 3, 19, 1000].map(roundLength), [0.5, 2, 10, 1000]);
});
