// The water of tasks while it is trained, as plain numbers: what a chart draws, and how partitions differ.

import type { Vec3 } from '../../viewer/vector.ts';
import type { Moment } from './curve-points.ts';
import { PARAMETERS, type Parameter } from './water-values.ts';

/** The water parameters of a task at one moment. */
export interface WaterPoint extends Moment {
    readonly beta_d: Vec3;
    readonly beta_b: Vec3;
    readonly b_inf: Vec3;
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
