// The numbers are worked out from docs/using/water.md, not from the code.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import type { Vec3 } from '../../src/viewer/vector.ts';
import {
    Composition,
    type WaterRecord,
    checkWater,
    coefficients,
    compositionOf,
    decoded,
    encoded,
    openWater,
    seenLight,
    seenPixel,
} from '../../src/viewer/water.ts';

const WATER: WaterRecord = {
    format: 2,
    medium: 'per_pixel',
    blend: 'srgb',
    beta_d: [Math.LN2, Math.LN2 / 2, 0],
    beta_b: [Math.LN2 / 2, Math.LN2, 0],
    b_inf: [0.1, 0.2, 0.4],
};
const AHEAD: Vec3 = [0, 0, 1];

function near(actual: readonly number[], expected: readonly number[], tolerance = 1e-12): void {
    assert.equal(actual.length, expected.length);
    actual.forEach((value, i) =>
        assert.ok(Math.abs(value - expected[i]!) < tolerance, `[${i}]: ${value}, expected ${expected[i]}`),
    );
}

test('water halves the light of red at a range of 1 and of green at 2', () => {
    // Red at range 2: 0.8 / 4 + 0.1 (1 - 1/2). Green: 0.8 / 2 + 0.2 (1 - 1/4). Blue has no water.
    near(seenLight(WATER, [0.8, 0.8, 0.8], 2, WATER.b_inf), [0.25, 0.55, 0.8]);
    near(seenLight(WATER, [0.8, 0.8, 0.8], 0, WATER.b_inf), [0.8, 0.8, 0.8]);
});

test('the sRGB curve passes through its known points and back', () => {
    near([decoded(1), decoded(0), encoded(1), encoded(0)], [1, 0, 1, 0]);
    // IEC 61966-2-1: 0.5 in sRGB is 0.21404 in linear light; the line ends at 0.04045.
    near([decoded(0.5)], [0.214041140482233], 1e-12);
    near([decoded(0.04045)], [0.04045 / 12.92]);
    for (const value of [0.001, 0.02, 0.3, 0.9, 1.4]) {
        near([encoded(decoded(value))], [value], 1e-9);
    }
});

test('an opaque pixel is the formula, and its veil is the second term', () => {
    const shown = encoded(0.8);
    const seen = seenPixel(WATER, 'water', [shown, shown, shown], 1, 2, AHEAD);
    near(seen.map(decoded), [0.25, 0.55, 0.8], 1e-9);
    const veil = seenPixel(WATER, 'veil', [shown, shown, shown], 1, 2, AHEAD);
    near(veil.map(decoded), [0.05, 0.15, 0], 1e-9);
    near(seenPixel(WATER, 'clear', [shown, 0.1, 0.2], 1, 2, AHEAD), [shown, 0.1, 0.2]);
});

test('a half transparent pixel shows its own colour and open water behind', () => {
    // Alpha 1/2, blended range 1: its surface is at range 2. Own light is half of 0.8.
    const half = encoded(0.8) / 2;
    const seen = seenPixel(WATER, 'water', [half, half, half], 0.5, 1, AHEAD);
    // Red: 0.4 / 4 + 0.1 (1 - 0.5 / 2); green: 0.4 / 2 + 0.2 (1 - 0.5 / 4); blue: 0.4 + 0.4 (1 - 0.5).
    near(seen.map(decoded), [0.175, 0.375, 0.6], 1e-9);
});

test('in linear light the blended colour is not divided by alpha', () => {
    const water: WaterRecord = { ...WATER, blend: 'linear' };
    near(seenPixel(water, 'water', [0.4, 0.4, 0.4], 0.5, 1, AHEAD).map(decoded), [0.175, 0.375, 0.6], 1e-9);
    near(seenPixel(water, 'clear', [0.4, 0.4, 0.4], 0.5, 1, AHEAD).map(decoded), [0.4, 0.4, 0.4], 1e-9);
});

test('over black nothing lies behind the Gaussians', () => {
    const water: WaterRecord = { ...WATER, blend: 'over_black' };
    const shown = encoded(0.4);
    // Red: 0.4 / 4 + 0.1 (0.5 - 0.5 / 2).
    const seen = seenPixel(water, 'water', [shown, shown, shown], 0.5, 1, AHEAD);
    near(seen.map(decoded), [0.125, 0.275, 0.4], 1e-9);
    assert.deepEqual(seenPixel(water, 'water', [0, 0, 0], 0, 0, AHEAD), [0, 0, 0]);
});

test('a pixel without Gaussians is open water', () => {
    near(seenPixel(WATER, 'water', [0, 0, 0], 0, 0, AHEAD).map(decoded), [0.1, 0.2, 0.4], 1e-9);
    const onGaussians: WaterRecord = { ...WATER, medium: 'per_gaussian' };
    near(seenPixel(onGaussians, 'water', [0, 0, 0], 0, 0, AHEAD).map(decoded), [0.1, 0.2, 0.4], 1e-9);
    // Blended colours are under water already; the rest of the light is open water, added in sRGB.
    near(seenPixel(onGaussians, 'water', [0.2, 0.2, 0.2], 0.75, 1, AHEAD), [
        0.2 + encoded(0.1) / 4,
        0.2 + encoded(0.2) / 4,
        0.2 + encoded(0.4) / 4,
    ]);
});

test('open water changes with direction up to its limit', () => {
    const water: WaterRecord = {
        ...WATER,
        by_direction: { middle: AHEAD, slopes: [[0, -1, 0], [0, -2, 0], [0, -8, 0]], most: 1.2 },
    };
    near(openWater(water, AHEAD), [0.1, 0.2, 0.4]);
    near(openWater(water, [0, -0.1, 0.995]), [0.1 * Math.exp(0.1), 0.2 * Math.exp(0.2), 0.4 * Math.exp(0.8)]);
    near(openWater(water, [0, -1, 0]), [0.1 * Math.exp(1), 0.2 * Math.exp(1.2), 0.4 * Math.exp(1.2)]);
});

test('coefficients follow the range where the water has a refinement', () => {
    const refinement = { scale: 2, unit: 4, attenuation: [0, 0] as const, backscatter: [1, -1] as const };
    // 2 sigmoid(0) = 1; at range 4: 2 sigmoid(1 - 1) = 1; at range 0: 2 sigmoid(-1).
    const water: WaterRecord = { ...WATER, refinement };
    near(coefficients(water, 4).beta_d, WATER.beta_d);
    near(coefficients(water, 4).beta_b, WATER.beta_b);
    near([coefficients(water, 0).beta_b[1]], [(Math.LN2 * 2) / (1 + Math.E)]);
});

test('a wrong water is refused with the reason', () => {
    assert.equal(checkWater(WATER), WATER);
    const refused = (change: object, why: RegExp): void => {
        assert.throws(() => checkWater({ ...WATER, ...change }), why);
    };
    refused({ format: 1 }, /format 1/);
    refused({ medium: 'none' }, /medium "none"/);
    refused({ medium: 'per_gaussian', blend: 'over_black' }, /over_black/);
    refused({ beta_d: [1, 2] }, /beta_d/);
    refused({ b_inf: [1, -1, 0] }, /b_inf/);
    refused({ refinement: { scale: 1, unit: 0, attenuation: [0, 0], backscatter: [0, 0] } }, /refinement/);
    assert.throws(() => checkWater(7), /not an object/);
});

test('every pair of medium and blend has its composition', () => {
    assert.equal(compositionOf(null), Composition.none);
    assert.equal(compositionOf(WATER), Composition.pixelsSrgb);
    assert.equal(compositionOf({ ...WATER, blend: 'over_black' }), Composition.pixelsOverBlack);
    assert.equal(compositionOf({ ...WATER, medium: 'per_gaussian' }), Composition.gaussiansSrgb);
    assert.equal(compositionOf({ ...WATER, medium: 'per_gaussian', blend: 'linear' }), Composition.gaussiansLinear);
});
