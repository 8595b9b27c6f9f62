// The water of tasks while it is trained, as plain numbers: what a chart draws, and how partitions differ.

import type { Vec3 } from '../../viewer/vector.ts';
import type { Line, Moment } from './curve-points.ts';
import {
    PARAMETERS,
    type Parameter,
    type WaterContent,
    type WaterErrors,
    drawnError,
} from './water-values.ts';

/** The water parameters of a task at one moment. */
export interface WaterPoint extends Moment {
    readonly beta_d: Vec3;
    readonly beta_b: Vec3;
    readonly b_inf: Vec3;
    /** Absent where workers do not report errors. */
    readonly standard_error?: WaterErrors;
}

/** The water of one task. */
export interface WaterSeries {
    readonly task: string;
    /** What readers call it: "Partition 3". */
    readonly label: string;
    /** "global", "first_part", "partition", ... */
    readonly stage: string;
    /** By ascending iteration, at least one. */
    readonly points: readonly WaterPoint[];
}

const NAMES = Object.keys(PARAMETERS) as Parameter[];
const isSame = (a: WaterPoint, b: WaterPoint): boolean =>
    NAMES.every((name) => a[name].every((value, channel) => value === b[name][channel]));

/** Whether the water changed during the task. Partitions may run with one that is fixed. */
export const isTrained = ({ points }: WaterSeries): boolean =>
    points.some((point) => !isSame(point, points[0]!));

/** The task to show until the reader chooses: the first of the last stage that trains its water. */
export function firstShown(series: readonly WaterSeries[]): WaterSeries | null {
    const stage = series.findLast(isTrained)?.stage;
    return series.find((one) => one.stage === stage && isTrained(one)) ?? series[0] ?? null;
}

/** A water with the numbers of one moment, as `patch` takes it; what else water.json says is not known yet. */
export const waterAt = ({ beta_d, beta_b, b_inf, standard_error }: WaterPoint): WaterContent => ({
    format: 2,
    medium: 'per_pixel',
    blend: 'srgb',
    beta_d,
    beta_b,
    b_inf,
    ...(standard_error === undefined ? {} : { standard_error }),
});

/** The lowest, the highest and the mean value of several tasks along the iterations. */
export interface Band {
    readonly lowest: Line;
    readonly highest: Line;
    readonly mean: Line;
}

/** Most places of a band: thousands of tasks may have hundreds of points each. */
const MOST_PLACES = 200;

/** Where a band has values: at the points of the tasks, or evenly where these are many. */
function placesOf(series: readonly WaterSeries[]): readonly number[] {
    const all = [...new Set(series.flatMap(({ points }) => points.map(({ iteration }) => iteration)))];
    all.sort((a, b) => a - b);
    if (all.length <= MOST_PLACES) {
        return all;
    }
    const [first, last] = [all[0]!, all.at(-1)!];
    return Array.from({ length: MOST_PLACES }, (_, i) => first + ((last - first) * i) / (MOST_PLACES - 1));
}

/** The value of a task at ascending places, between its points; null before the first and after the last. */
function valuesAt(
    { points }: WaterSeries,
    valueOf: (point: WaterPoint) => number,
    places: readonly number[],
): readonly (number | null)[] {
    let next = 0;
    return places.map((place) => {
        while (next < points.length && points[next]!.iteration < place) {
            next += 1;
        }
        const [before, after] = [points[next - 1], points[next]];
        if (after === undefined || (before === undefined && after.iteration > place)) {
            return null;
        }
        if (before === undefined || after.iteration === place) {
            return valueOf(after);
        }
        const share = (place - before.iteration) / (after.iteration - before.iteration);
        return valueOf(before) + share * (valueOf(after) - valueOf(before));
    });
}

/** The band of a value over the tasks that have reached each place; null where no two tasks share a place. */
export function bandOf(series: readonly WaterSeries[], valueOf: (point: WaterPoint) => number): Band | null {
    const places = placesOf(series);
    const all = series.map((one) => valuesAt(one, valueOf, places));
    const xs: number[] = [];
    const [lowest, highest, mean]: [number[], number[], number[]] = [[], [], []];
    places.forEach((place, i) => {
        const values = all.map((one) => one[i]!).filter((value) => value !== null);
        if (values.length > 1) {
            xs.push(place);
            lowest.push(Math.min(...values));
            highest.push(Math.max(...values));
            mean.push(values.reduce((sum, value) => sum + value, 0) / values.length);
        }
    });
    const line = (ys: number[]): Line => ({ xs, ys });
    return xs.length === 0 ? null : { lowest: line(lowest), highest: line(highest), mean: line(mean) };
}

/** One standard error to each side of a line. */
export interface ErrorBand {
    readonly lower: Line;
    readonly upper: Line;
    /** Whether an error is so large that not all of it is drawn. */
    readonly isCut: boolean;
}

/**
 * The errors of one number along the iterations, with gaps where it is not determined; null where it never
 * is. `top` is the largest value of the chart.
 */
export function errorBandOf(
    { points }: WaterSeries,
    name: Parameter,
    channel: number,
    top: number,
): ErrorBand | null {
    const xs = points.map(({ iteration }) => iteration);
    const errors = points.map(({ standard_error }) => standard_error?.[name]?.[channel] ?? null);
    if (errors.every((error) => error === null)) {
        return null;
    }
    const values = points.map((point) => point[name][channel]!);
    const edge = (at: (value: number, error: number) => number): Line => ({
        xs,
        ys: values.map((value, i) => (errors[i] === null ? null : at(value, errors[i]!))),
    });
    return {
        // No number of the water is negative.
        lower: edge((value, error) => Math.max(0, value - error)),
        upper: edge((value, error) => value + drawnError(value, error, top)),
        isCut: values.some((value, i) => drawnError(value, errors[i] ?? 0, top) < (errors[i] ?? 0)),
    };
}

/** How far the latest values of one parameter and channel lie apart. */
export interface Spread {
    readonly lowest: number;
    readonly highest: number;
    /** Their distance as a share of their mean; null for a mean of 0. */
    readonly share: number | null;
}

/** What the partitions found, each with its own water. */
export interface WaterSpread {
    /** How many partitions were compared. */
    readonly partitions: number;
    readonly of: Readonly<Record<Parameter, readonly [Spread, Spread, Spread]>>;
}

function spreadOf(values: readonly number[]): Spread {
    const [lowest, highest] = [Math.min(...values), Math.max(...values)];
    const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
    return { lowest, highest, share: mean > 0 ? (highest - lowest) / mean : null };
}

/** The spread between partitions in the last stage in which they differ; null where all have one water. */
export function spreadOfPartitions(series: readonly WaterSeries[]): WaterSpread | null {
    for (const stage of ['partition', 'first_part']) {
        const latest = series.filter((one) => one.stage === stage).map(({ points }) => points.at(-1)!);
        if (latest.length > 1 && latest.some((point) => !isSame(point, latest[0]!))) {
            const of = (name: Parameter): [Spread, Spread, Spread] => [
                spreadOf(latest.map((point) => point[name][0])),
                spreadOf(latest.map((point) => point[name][1])),
                spreadOf(latest.map((point) => point[name][2])),
            ];
            return {
                partitions: latest.length,
                of: { beta_d: of('beta_d'), beta_b: of('beta_b'), b_inf: of('b_inf') },
            };
        }
    }
    return null;
}
