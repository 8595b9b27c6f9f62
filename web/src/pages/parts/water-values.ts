// What the panel of the water says: the water parameters with their errors, and the colours that it makes.

import type { Vec3 } from '../../viewer/vector.ts';
import { type WaterRecord, coefficients, decoded, encoded, openWater, seenLight } from '../../viewer/water.ts';
import { brief } from './format.ts';

export type MaybeVec3 = readonly [number | null, number | null, number | null];

/** One standard error of each number; null where nothing determines it. */
export interface WaterErrors {
    readonly beta_d?: MaybeVec3 | null;
    readonly beta_b?: MaybeVec3 | null;
    readonly b_inf?: MaybeVec3 | null;
}

/** The content of water.json. */
export interface WaterContent extends WaterRecord {
    readonly standard_error?: WaterErrors | null;
    readonly source?: string;
    readonly shows_open_water?: boolean;
    readonly beta_d_per_m?: Vec3 | null;
    readonly beta_b_per_m?: Vec3 | null;
    readonly partitions?: readonly PartitionWater[] | null;
}

/** What one partition found, before all agreed on one water. */
export interface PartitionWater {
    readonly partition: number;
    readonly beta_d: Vec3;
    readonly beta_b: Vec3;
    readonly b_inf: Vec3;
    /** Parameters that were far from those of the others, such as "beta_d[0]". */
    readonly far_off: readonly string[];
}

export type Parameter = 'beta_d' | 'beta_b' | 'b_inf';
export const CHANNELS = ['Red', 'Green', 'Blue'] as const;

export interface ParameterWords {
    readonly title: string;
    readonly meaning: string;
    /** null for linear light, which has no unit. */
    readonly perLength: boolean;
}

export const PARAMETERS: Readonly<Record<Parameter, ParameterWords>> = {
    beta_d: {
        title: 'Attenuation of direct light',
        meaning:
            'How fast the water takes away the light that comes from the scene: the larger, the sooner this colour is gone.',
        perLength: true,
    },
    beta_b: {
        title: 'Backscatter',
        meaning: 'How fast the water adds light of its own over the distance, which veils the scene.',
        perLength: true,
    },
    b_inf: {
        title: 'Open water colour',
        meaning: 'The light of water so deep that nothing shines through, in linear light from 0 to 1.',
        perLength: false,
    },
};

const SOURCES: Readonly<Record<string, string>> = {
    sparse: 'Estimated from sparse points seen at several distances, from open water and from the darkest pixels.',
    fixed: 'Given in the settings of the job.',
    network: 'Estimated by the network WaterParamPredict: its mean over the training photographs.',
    descended: 'Estimated before the training, then trained together with the scene.',
    consensus: 'Agreed on by the partitions, each of which trained the water of its own part.',
};

/** One number of the water. */
export interface WaterValue {
    readonly channel: (typeof CHANNELS)[number];
    readonly value: number;
    /** One standard error; null where the data do not determine it or it is not known. */
    readonly error: number | null;
    /** In 1/m; null where the length of a scene unit is not known. */
    readonly perMetre: number | null;
    readonly isFarOff: boolean;
}

/** The three numbers of a parameter: of one partition, or of the whole scene. */
export function valuesOf(water: WaterContent, parameter: Parameter, partition: PartitionWater | null): WaterValue[] {
    const values = (partition ?? water)[parameter];
    const errors = partition === null ? water.standard_error?.[parameter] : null;
    const metres = water.metres_per_unit ?? null;
    const isPerLength = PARAMETERS[parameter].perLength;
    return CHANNELS.map((channel, i) => ({
        channel,
        value: values[i]!,
        error: errors?.[i] ?? null,
        perMetre: isPerLength && metres !== null && metres > 0 ? values[i]! / metres : null,
        isFarOff: partition?.far_off.includes(`${parameter}[${i}]`) ?? false,
    }));
}

/**
 * How much of an error above a value is drawn. Errors much larger than all values, of which `top` is the
 * largest, would leave no room for the values.
 */
export const drawnError = (value: number, error: number, top: number): number =>
    Math.min(error, value + 0.25 * top);

/** The largest value with its error, for the length of bars. */
export function longest(values: readonly WaterValue[]): number {
    const top = Math.max(...values.map(({ value }) => value), 1e-9);
    const reach = values.map(({ value, error }) => value + drawnError(value, error ?? 0, top));
    return Math.max(...reach, top);
}

/** Surfaces that readers know, in sRGB as they look in air. */
export const SURFACES: readonly { readonly name: string; readonly srgb: Vec3 }[] = [
    { name: 'White', srgb: [0.95, 0.95, 0.95] },
    { name: 'Grey', srgb: [0.5, 0.5, 0.5] },
    { name: 'Sand', srgb: [0.85, 0.75, 0.56] },
    { name: 'Red', srgb: [0.8, 0.1, 0.1] },
    { name: 'Yellow', srgb: [0.95, 0.83, 0.15] },
    { name: 'Coral', srgb: [1, 0.5, 0.42] },
];
/** Distances of the patches, in scene scales. */
export const DISTANCES = [0, 1, 3, 10] as const;

/** The water that the patches are seen through: that of the scene, or the numbers of one partition. */
export const waterOf = (water: WaterContent, partition: PartitionWater | null): WaterContent =>
    partition === null
        ? water
        : { ...water, beta_d: partition.beta_d, beta_b: partition.beta_b, b_inf: partition.b_inf };

/** The colour of open water in the direction where it is `b_inf`. */
export const openColour = (water: WaterContent): Vec3 => openWater(water, water.by_direction?.middle ?? [0, 0, 1]);

/** A surface in sRGB, 0 to 1, seen through the water at a range in scene units. */
export function patch(water: WaterContent, srgb: Vec3, range: number): Vec3 {
    const light: Vec3 = [decoded(srgb[0]), decoded(srgb[1]), decoded(srgb[2])];
    const seen = seenLight(water, light, range, openColour(water));
    return [shown(seen[0]), shown(seen[1]), shown(seen[2])];
}

const shown = (light: number): number => encoded(Math.min(1, Math.max(0, light)));

/** A colour in sRGB as CSS. */
export const cssColour = (srgb: Vec3): string => `rgb(${srgb.map((value) => Math.round(255 * value)).join(' ')})`;

/** The share of the light of each channel that is left after a range. */
export function lightLeft(water: WaterContent, range: number): Vec3 {
    const { beta_d } = coefficients(water, range);
    return [Math.exp(-beta_d[0] * range), Math.exp(-beta_d[1] * range), Math.exp(-beta_d[2] * range)];
}

/** A length in scene units, and in metres where they are known. */
export function lengthText(range: number, metresPerUnit: number | null | undefined): string {
    const units = `${brief(range)} ${range === 1 ? 'unit' : 'units'}`;
    return metresPerUnit ? `${brief(range * metresPerUnit)} m` : units;
}

/** Where this water differs from the plain formula, in sentences. */
export function remarksOf(water: WaterContent): string[] {
    const remarks: string[] = [];
    const source = SOURCES[water.source ?? ''];
    if (source !== undefined) {
        remarks.push(source);
    }
    if (water.refinement) {
        remarks.push(
            'The coefficients change with the distance (maps). The table shows them before this factor; the colours below use it.',
        );
    }
    if (water.medium === 'per_gaussian') {
        remarks.push(
            'The water acts on each Gaussian before they are blended. Where Gaussians at several distances overlap, a pixel ' +
                'differs a little from the colours below.',
        );
    }
    if (water.by_direction) {
        remarks.push(
            'Open water changes its colour with the direction. The numbers and colours are those of its middle.',
        );
    }
    if (water.blend === 'over_black') {
        remarks.push(
            'The water is clear. Pixels without any surface are black, since the colour of open water cannot be estimated.',
        );
    }
    if (water.shows_open_water) {
        remarks.push('Some photographs show open water, which determines its colour well.');
    }
    return remarks;
}
