// The water of a scene, as water.json states it, and the formula in double precision.
//
//     I = J exp(-beta_d r) + b_inf (1 - exp(-beta_b r))      per channel, linear light, r along the ray
//
// The shaders in shaders.ts compute the same. `seenPixel` is their reference in the tests, and does what
// `fathom render` does to a pixel.

import { ViewerError } from './errors.ts';
import { type Vec3, dot, sub } from './vector.ts';

/** The content of water.json; keys that the viewer does not read are left out. */
export interface WaterRecord {
    readonly format: number;
    readonly medium: 'per_pixel' | 'per_gaussian';
    readonly blend: 'srgb' | 'linear' | 'over_black';
    /** 1/scene unit; red, green, blue. */
    readonly beta_d: Vec3;
    readonly beta_b: Vec3;
    /** Linear light. */
    readonly b_inf: Vec3;
    readonly metres_per_unit?: number | null;
    readonly by_direction?: {
        /** Unit direction with the colour `b_inf`, scene axes. */
        readonly middle: Vec3;
        readonly slopes: readonly [Vec3, Vec3, Vec3];
        readonly most: number;
    } | null;
    readonly refinement?: {
        readonly scale: number;
        readonly unit: number;
        readonly attenuation: readonly [number, number];
        readonly backscatter: readonly [number, number];
    } | null;
}

/** Where the water acts and how Gaussians are blended. The numbers are those of the shaders. */
export const Composition = {
    none: 0,
    gaussiansSrgb: 1,
    gaussiansLinear: 2,
    pixelsSrgb: 3,
    pixelsLinear: 4,
    pixelsOverBlack: 5,
} as const;
export type Composition = (typeof Composition)[keyof typeof Composition];

/** What a picture shows of a scene under water. */
export type WaterOutput = 'clear' | 'water' | 'veil';

/** Below this alpha a pixel is open water, where the water acts on pixels. */
export const LEAST_ALPHA = 1e-3;
/** The format of water.json that this program reads. */
const FORMAT = 2;

export function compositionOf(water: WaterRecord | null): Composition {
    if (water === null) {
        return Composition.none;
    }
    if (water.medium === 'per_gaussian') {
        return water.blend === 'linear' ? Composition.gaussiansLinear : Composition.gaussiansSrgb;
    }
    const onPixels = {
        srgb: Composition.pixelsSrgb,
        linear: Composition.pixelsLinear,
        over_black: Composition.pixelsOverBlack,
    };
    return onPixels[water.blend];
}

export const blendsInLinearLight = (composition: Composition): boolean =>
    composition === Composition.gaussiansLinear || composition === Composition.pixelsLinear;
export const actsOnGaussians = (composition: Composition): boolean =>
    composition === Composition.gaussiansSrgb || composition === Composition.gaussiansLinear;

/** Linear light of an sRGB value (IEC 61966-2-1). The curve continues above 1. */
export const decoded = (value: number): number =>
    value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
/** The sRGB value of linear light. */
export const encoded = (light: number): number =>
    light <= 0.0031308 ? light * 12.92 : 1.055 * light ** (1 / 2.4) - 0.055;

const map3 = (f: (channel: 0 | 1 | 2) => number): Vec3 => [f(0), f(1), f(2)];

/** The colour of open water along the unit direction `d`, scene axes, in linear light. */
export function openWater(water: WaterRecord, d: Vec3): Vec3 {
    const by = water.by_direction;
    if (!by) {
        return water.b_inf;
    }
    const offset = sub(d, by.middle);
    const change = (c: 0 | 1 | 2): number => Math.min(by.most, Math.max(-by.most, dot(by.slopes[c], offset)));
    return map3((c) => water.b_inf[c] * Math.exp(change(c)));
}

/** `beta_d` and `beta_b` at a range in scene units. */
export function coefficients(water: WaterRecord, range: number): { beta_d: Vec3; beta_b: Vec3 } {
    const refinement = water.refinement;
    if (!refinement) {
        return { beta_d: water.beta_d, beta_b: water.beta_b };
    }
    const factor = ([weight, bias]: readonly [number, number]): number => {
        // Clamped as in the trainer, so that infinities never meet.
        const x = Math.min(30, Math.max(-30, (weight * range) / refinement.unit + bias));
        return refinement.scale / (1 + Math.exp(-x));
    };
    const [onD, onB] = [factor(refinement.attenuation), factor(refinement.backscatter)];
    return { beta_d: map3((c) => water.beta_d[c] * onD), beta_b: map3((c) => water.beta_b[c] * onB) };
}

/** A colour in linear light, seen through water at a range. */
export function seenLight(water: WaterRecord, light: Vec3, range: number, open: Vec3): Vec3 {
    const { beta_d, beta_b } = coefficients(water, range);
    return map3((c) => light[c] * Math.exp(-beta_d[c] * range) + open[c] * (1 - Math.exp(-beta_b[c] * range)));
}

/**
 * A pixel in sRGB from the blended colour over black, its alpha and the blended range (scene units), as
 * `fathom render` forms it. `direction` is the ray of the pixel, scene axes. For water on Gaussians, `blended`
 * already holds the colours under water.
 */
export function seenPixel(
    water: WaterRecord,
    output: WaterOutput,
    blended: Vec3,
    alpha: number,
    range: number,
    direction: Vec3,
): Vec3 {
    const composition = compositionOf(water);
    const linear = blendsInLinearLight(composition);
    const open = openWater(water, direction);
    if (output === 'clear') {
        return linear ? map3((c) => encoded(blended[c])) : blended;
    }
    if (composition === Composition.gaussiansSrgb) {
        return map3((c) => blended[c] + (1 - alpha) * encoded(water.b_inf[c]));
    }
    if (composition === Composition.gaussiansLinear) {
        return map3((c) => encoded(blended[c] + (1 - alpha) * water.b_inf[c]));
    }
    const overBlack = composition === Composition.pixelsOverBlack;
    if (!(alpha >= LEAST_ALPHA)) {
        return overBlack ? [0, 0, 0] : map3((c) => encoded(open[c]));
    }
    const r = range / alpha;
    const { beta_d, beta_b } = coefficients(water, r);
    return map3((c) => {
        const shown = blended[c];
        const inSrgb = overBlack ? decoded(Math.max(shown, 0)) : alpha * decoded(Math.max(shown / alpha, 0));
        const own = linear ? shown : inSrgb;
        const veil = open[c] * ((overBlack ? alpha : 1) - alpha * Math.exp(-beta_b[c] * r));
        return encoded(output === 'veil' ? veil : own * Math.exp(-beta_d[c] * r) + veil);
    });
}

function refuse(what: string): never {
    throw new ViewerError(
        `The water cannot be used: ${what}.`,
        'Use the water.json that belongs to the model, made by the same version of Fathom.',
    );
}

/** Checks a parsed water.json. Throws a `ViewerError` that names what is wrong. */
export function checkWater(value: unknown): WaterRecord {
    const water = (typeof value === 'object' && value !== null ? value : refuse('it is not an object')) as WaterRecord;
    if (water.format !== FORMAT) {
        refuse(`it has format ${String(water.format)}, and this viewer reads ${FORMAT}`);
    }
    const pairs = ['per_pixel srgb', 'per_pixel linear', 'per_pixel over_black', 'per_gaussian srgb', 'per_gaussian linear'];
    if (!pairs.includes(`${water.medium} ${water.blend}`)) {
        refuse(`medium "${water.medium}" with blend "${water.blend}" is not known`);
    }
    for (const key of ['beta_d', 'beta_b', 'b_inf'] as const) {
        const three = water[key];
        if (!Array.isArray(three) || three.length !== 3 || !three.every((v) => Number.isFinite(v) && v >= 0)) {
            refuse(`${key} must be three numbers that are not negative`);
        }
    }
    const by = water.by_direction;
    const numbers = by ? [...by.middle, ...by.slopes.flat(), by.most] : [];
    const refinement = water.refinement;
    if (refinement) {
        numbers.push(refinement.scale, 1 / refinement.unit, ...refinement.attenuation, ...refinement.backscatter);
    }
    if (!numbers.every(Number.isFinite)) {
        refuse('by_direction or refinement holds something that is not a number');
    }
    return water;
}
