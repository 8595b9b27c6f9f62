// The water of a picture, found again from the picture without it: least squares over all pixels, per channel.

import { readFileSync } from 'node:fs';

import { decoded, encoded } from '../../src/viewer/water.ts';
import type { Picture } from './pictures.ts';

export interface Fitted {
    /** 1/scene unit. */
    readonly beta_d: number;
    readonly beta_b: number;
    /** Linear light. */
    readonly b_inf: number;
    /** Pixels that were used. */
    readonly pixels: number;
    /** Root of the mean square of what is left, in levels of 255. */
    readonly left: number;
}

/** What is known of a pixel: the light of the scene, alpha and range, and the sRGB value under water. */
interface Sample {
    readonly own: number;
    readonly alpha: number;
    readonly range: number;
    /** How many times `b_inf` open water is along the ray. */
    readonly open: number;
    readonly shown: number;
}
type Three = readonly [number, number, number];

/**
 * Less opaque pixels are left out. With opaque pixels alone, at ranges of 4 to 6, `beta_b` and `b_inf` are not
 * determined apart from each other: 8 bits of alpha then move them by a tenth.
 */
const LEAST_ALPHA = 0.5;
const ROUNDS = 100;

/** The numbers of a `.npy` with floats. */
export function readNpy(path: string): Float32Array {
    const bytes = readFileSync(path);
    const header = bytes.readUInt16LE(8);
    const text = bytes.toString('latin1', 10, 10 + header);
    if (!text.includes("'<f4'")) {
        throw new Error(`${path} has no floats: ${text}`);
    }
    return new Float32Array(bytes.buffer.slice(bytes.byteOffset + 10 + header, bytes.byteOffset + bytes.length));
}

/** Solves a symmetric system of three equations, by Cramer's rule. */
function solved(m: readonly Three[], v: Three): Three {
    const det = (a: Three, b: Three, c: Three): number =>
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0]);
    const [a, b, c] = m as [Three, Three, Three];
    const whole = det(a, b, c);
    return [det(v, b, c) / whole, det(a, v, c) / whole, det(a, b, v) / whole];
}

/** The light of a pixel under water with these parameters, and its slopes along them. */
function seen([d, b, infinity]: Three, { own, alpha, range, open }: Sample): { light: number; slopes: Three } {
    const direct = own * Math.exp(-d * range);
    const through = alpha * Math.exp(-b * range);
    return {
        light: direct + infinity * open * (1 - through),
        slopes: [-range * direct, infinity * open * range * through, open * (1 - through)],
    };
}

/** Levenberg and Marquardt, on sRGB values, since those are what is rounded. */
function leastSquares(samples: readonly Sample[]): { found: Three; mean: number } {
    const errorOf = (p: Three): number =>
        samples.reduce((sum, one) => sum + (one.shown - encoded(seen(p, one).light)) ** 2, 0);
    let found: Three = [0.1, 0.1, 0.1];
    let error = errorOf(found);
    let damping = 1e-3;
    for (let round = 0; round < ROUNDS && damping < 1e6; round += 1) {
        const matrix = [[0, 0, 0], [0, 0, 0], [0, 0, 0]];
        const vector = [0, 0, 0];
        for (const one of samples) {
            const { light, slopes } = seen(found, one);
            const steep = light <= 0.0031308 ? 12.92 : (1.055 / 2.4) * light ** (1 / 2.4 - 1);
            const apart = one.shown - encoded(light);
            for (let i = 0; i < 3; i++) {
                vector[i]! += steep * slopes[i]! * apart;
                for (let j = 0; j < 3; j++) {
                    matrix[i]![j]! += steep * steep * slopes[i]! * slopes[j]!;
                }
            }
        }
        for (let i = 0; i < 3; i++) {
            matrix[i]![i]! *= 1 + damping;
        }
        const step = solved(matrix as unknown as Three[], vector as unknown as Three);
        const next = found.map((value, i) => Math.abs(value + step[i]!)) as unknown as Three;
        const nextError = errorOf(next);
        if (nextError < error) {
            const isDone = error - nextError < 1e-9 * error;
            [found, error, damping] = [next, nextError, damping / 5];
            if (isDone) {
                break;
            }
        } else {
            damping *= 4;
        }
    }
    return { found, mean: error / samples.length };
}

/**
 * Fits `beta_d`, `beta_b` and `b_inf` of each channel to a picture under water, from the picture without water,
 * alpha and range. The water must act on pixels that are blended in sRGB. `openAt` tells how many times `b_inf`
 * open water is at a pixel.
 */
export function fitWater(
    clear: Picture,
    water: Picture,
    alpha: Picture,
    range: Float32Array,
    openAt: (x: number, y: number) => readonly number[],
): Fitted[] {
    return [0, 1, 2].map((channel) => {
        const samples: Sample[] = [];
        for (let i = 0; i < range.length; i++) {
            const [own, shown, opaque] = [clear.data[4 * i + channel]!, water.data[4 * i + channel]!, alpha.data[4 * i]! / 255];
            // 0 and 255 may be anything beyond.
            if (opaque >= LEAST_ALPHA && own > 0 && own < 255 && shown > 0 && shown < 255) {
                const light = opaque * decoded(own / 255 / opaque);
                const open = openAt(i % clear.width, Math.floor(i / clear.width))[channel]!;
                samples.push({ own: light, alpha: opaque, range: range[i]!, open, shown: shown / 255 });
            }
        }
        const { found, mean } = leastSquares(samples);
        const [beta_d, beta_b, b_inf] = found;
        return { beta_d, beta_b, b_inf, pixels: samples.length, left: 255 * Math.sqrt(mean) };
    });
}
