import assert from 'node:assert/strict';
import { test } from 'node:test';

import {
    type WaterContent,
    cssColour,
    lengthText,
    lightLeft,
    longest,
    openColour,
    patch,
    remarksOf,
    valuesOf,
    waterOf,
} from '../../src/pages/parts/water-values.ts';
import type { Vec3 } from '../../src/viewer/vector.ts';
import { encoded, seenPixel } from '../../src/viewer/water.ts';

const WATER: WaterContent = {
    format: 2,
    medium: 'per_pixel',
    blend: 'srgb',
    beta_d: [Math.LN2, 0.2, 0.1],
    beta_b: [0.3, 0.2, 0.1],
    b_inf: [0.1, 0.2, 0.4],
    standard_error: { beta_d: [0.01, null, 0.03], beta_b: null, b_inf: [0.01, 0.01, 0.01] },
    source: 'sparse',
    metres_per_unit: 0.5,
};
const near = (actual: readonly number[], expected: readonly number[]): void =>
    actual.forEach((value, i) =>
        assert.ok(Math.abs(value - expected[i]!) < 1e-9, `[${i}]: ${value}, expected ${expected[i]}`),
    );

test('a patch is what the viewer shows of an opaque surface at that range', () => {
    const refinement = { scale: 2, unit: 3, attenuation: [0.5, 0] as const, backscatter: [0, -1] as const };
    const by = {
        middle: [0, 0, 1] as Vec3,
        slopes: [
            [0, 1, 0],
            [0, 1, 0],
            [0, 1, 0],
        ] as [Vec3, Vec3, Vec3],
        most: 1,
    };
    const surface: Vec3 = [0.8, 0.4, 0.1];
    for (const water of [WATER, { ...WATER, refinement }, { ...WATER, by_direction: by }]) {
        for (const range of [0, 0.5, 3, 30]) {
            near(patch(water, surface, range), seenPixel(water, 'water', surface, 1, range, [0, 0, 1]));
        }
    }
    near(patch(WATER, surface, 0), surface);
    near(patch(WATER, surface, 1e9), WATER.b_inf.map(encoded));
});

test('the open water colour is that of the middle direction', () => {
    const by = {
        middle: [0, 1, 0] as Vec3,
        slopes: [
            [0, 1, 0],
            [0, 1, 0],
            [0, 1, 0],
        ] as [Vec3, Vec3, Vec3],
        most: 1,
    };
    near(openColour({ ...WATER, by_direction: by }), WATER.b_inf);
});

test('the light that is left is the first factor of the formula', () => {
    near([lightLeft(WATER, 1)[0], lightLeft(WATER, 3)[0], lightLeft(WATER, 0)[0]], [0.5, 0.125, 1]);
});

test('values come with their errors and in metres, where these are known', () => {
    const values = valuesOf(WATER, 'beta_d', null);
    assert.deepEqual(
        values.map(({ error }) => error),
        [0.01, null, 0.03],
    );
    near([values[1]!.perMetre!], [0.4]);
    assert.deepEqual(
        valuesOf(WATER, 'beta_b', null).map(({ error }) => error),
        [null, null, null],
    );
    assert.equal(valuesOf(WATER, 'b_inf', null)[0]!.perMetre, null, 'light has no length');
    assert.equal(valuesOf({ ...WATER, metres_per_unit: null }, 'beta_d', null)[0]!.perMetre, null);
});

test('a partition has its own values, without errors, and those far from the others are marked', () => {
    const own = {
        partition: 3,
        beta_d: [1, 2, 3],
        beta_b: [4, 5, 6],
        b_inf: [0.1, 0.2, 0.3],
        far_off: ['beta_b[1]'],
    } as const;
    const values = valuesOf(WATER, 'beta_b', own);
    assert.deepEqual(
        values.map(({ value, error, isFarOff }) => [value, error, isFarOff]),
        [
            [4, null, false],
            [5, null, true],
            [6, null, false],
        ],
    );
    assert.deepEqual(waterOf(WATER, own).beta_d, [1, 2, 3]);
    assert.equal(waterOf(WATER, null), WATER);
});

test('a huge error does not shrink all bars to nothing', () => {
    const values = valuesOf({ ...WATER, standard_error: { beta_d: [0.01, 0.01, 1e6] } }, 'beta_d', null);
    assert.ok(longest(values) <= 2 * Math.LN2, String(longest(values)));
});

test('what differs from the plain formula is said', () => {
    assert.deepEqual(remarksOf({ ...WATER, source: 'unheard' }), []);
    const refinement = { scale: 1, unit: 1, attenuation: [0, 0] as const, backscatter: [0, 0] as const };
    assert.match(remarksOf({ ...WATER, refinement }).join(' '), /change with the distance/);
    assert.match(remarksOf({ ...WATER, medium: 'per_gaussian' }).join(' '), /each Gaussian/);
    assert.match(remarksOf({ ...WATER, blend: 'over_black' }).join(' '), /clear/);
});

test('colours and lengths are written as readers expect them', () => {
    assert.equal(cssColour([0, 0.5, 1]), 'rgb(0 128 255)');
    assert.equal(lengthText(3.2, null), '3.20 units');
    assert.equal(lengthText(3.2, 0.5), '1.60 m');
});
