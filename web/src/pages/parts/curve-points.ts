// From the history of tasks to the columns that a chart draws.

import { brief, duration, grouped, memory } from './format.ts';

/** When something was measured. */
export interface Moment {
    readonly timeMs: number;
    readonly attempt: number;
    readonly iteration: number;
}

/** A point of the curves of a task. */
export interface CurvePoint extends Moment {
    readonly loss: number;
    /** On held-out views, dB; null before the first measurement. */
    readonly psnr: number | null;
    readonly gaussians: number;
    /** Iterations per second. */
    readonly rate: number;
    /** GPU memory; 0 where the driver does not report it. */
    readonly memoryBytes: number;
}

/** The curves of one task. */
export interface CurveSeries {
    readonly task: string;
    /** What readers call it: "Partition 3". */
    readonly label: string;
    /** In the order in which they were reported. */
    readonly points: readonly CurvePoint[];
    /** Mean PSNR of the previews after some iterations, dB, by ascending iteration. */
    readonly previews?: readonly { readonly iteration: number; readonly psnr: number }[];
}

export interface CurvesData {
    readonly series: readonly CurveSeries[];
}

export type Quantity = 'loss' | 'psnr' | 'gaussians' | 'rate' | 'memory';
export type Along = 'iteration' | 'time';

/** What a chart shows, and how it writes values. */
export interface ChartWords {
    readonly title: string;
    readonly isLog: boolean;
    text(value: number): string;
    /** A value beside the axis. */
    axisText(value: number): string;
    /** What is said in place of a chart without values. */
    readonly nothing: string;
    /** Whether each value is a point of its own, since there are few. */
    readonly hasPoints?: boolean;
    /** Steps between marks of the axis, if not those of decimal numbers. */
    readonly steps?: readonly number[];
}

const plain = (value: number, digits: number): string => String(Number(value.toPrecision(digits)));
const NOTHING = 'No values yet.';
/** From 1 MiB to 16 GiB. */
const MEMORY_STEPS = Array.from({ length: 15 }, (_, power) => 2 ** (20 + power));

export const QUANTITIES: Readonly<Record<Quantity, ChartWords>> = {
    loss: {
        title: 'Loss, logarithmic',
        isLog: true,
        text: (value) => brief(value),
        axisText: (value) => plain(value, 2),
        nothing: NOTHING,
    },
    psnr: {
        title: 'PSNR on held-out photographs, dB',
        isLog: false,
        text: (value) => value.toFixed(2),
        axisText: (value) => String(Number(value.toFixed(2))),
        nothing:
            'Not measured yet. Previews bring values from time to time, and train.eval_every measures all ' +
            'held-out photographs.',
        hasPoints: true,
    },
    gaussians: {
        title: 'Gaussians',
        isLog: false,
        text: grouped,
        axisText: (value) => (value >= 1e6 ? `${Number((value / 1e6).toFixed(2))} M` : grouped(value)),
        nothing: NOTHING,
    },
    rate: {
        title: 'Iterations per second',
        isLog: false,
        text: (value) => brief(value),
        axisText: (value) => plain(value, 3),
        nothing: NOTHING,
    },
    memory: {
        title: 'GPU memory',
        isLog: false,
        text: memory,
        // Marks lie at whole MiB, so that the digits after the point are zeros.
        axisText: (value) => memory(value).replace(/\.0+ |(\.\d*[1-9])0+ /, '$1 '),
        nothing: 'The drivers of these workers do not report their memory.',
        steps: MEMORY_STEPS,
    },
};

/** The value of a point; null where it is not known, and where a logarithm does not exist. */
export function valueOf(point: CurvePoint, quantity: Quantity): number | null {
    const values: Record<Quantity, number | null> = {
        loss: point.loss > 0 ? point.loss : null,
        psnr: point.psnr,
        gaussians: point.gaussians,
        rate: point.rate > 0 ? point.rate : null,
        memory: point.memoryBytes > 0 ? point.memoryBytes : null,
    };
    const value = values[quantity];
    return value !== null && Number.isFinite(value) ? value : null;
}

/** The points that still hold: an attempt that resumed earlier replaces those after its beginning. */
export function currentPoints<P extends Moment>(points: readonly P[]): P[] {
    const kept: P[] = [];
    for (const point of points) {
        while (kept.length > 0 && kept.at(-1)!.iteration >= point.iteration) {
            kept.pop();
        }
        kept.push(point);
    }
    return kept;
}

/** One line of a chart: places along x, and values, where null is a gap. */
export interface Line {
    readonly xs: number[];
    readonly ys: (number | null)[];
}

/** The line of a quantity. Of a PSNR, which is reported until the next measurement, only the changes are kept. */
export function lineOf(points: readonly CurvePoint[], quantity: Quantity, along: Along, startMs: number): Line {
    let last: number | null = null;
    const value = (point: CurvePoint): number | null => {
        const known = valueOf(point, quantity);
        const isRepeated = quantity === 'psnr' && known === last;
        last = known ?? last;
        return isRepeated ? null : known;
    };
    return lineBy(points, value, along, startMs);
}

/** Whether the PSNR of a task is that of its previews: nothing else measured its held-out photographs. */
export const isOfPreviews = ({ points, previews }: CurveSeries): boolean =>
    (previews ?? []).length > 0 && points.every((point) => valueOf(point, 'psnr') === null);

/** The previews of current points: those of an attempt that resumed earlier are to come. */
export function currentPreviews({ points, previews }: CurveSeries): readonly { iteration: number; psnr: number }[] {
    const last = points.at(-1)?.iteration ?? -Infinity;
    return (previews ?? []).filter(({ iteration }) => iteration <= last);
}

/** The line of the PSNR of previews. Their times are between those of the points around them. */
export function previewLine(series: CurveSeries, along: Along, startMs: number): Line {
    const { points } = series;
    const rounds = currentPreviews(series).map(({ iteration, psnr }) => {
        const next = points.findIndex((point) => point.iteration >= iteration);
        const [before, after] = [points[Math.max(0, next - 1)]!, points[next]!];
        const span = after.iteration - before.iteration;
        const share = span > 0 ? Math.max(0, (iteration - before.iteration) / span) : 0;
        const timeMs = before.timeMs + share * (after.timeMs - before.timeMs);
        return { timeMs, attempt: after.attempt, iteration, psnr };
    });
    return lineBy(rounds, ({ psnr }) => psnr, along, startMs);
}

/** What the chart of the PSNR is called, by the tasks that it shows. */
export function psnrTitle(drawn: readonly CurveSeries[]): string {
    const ofPreviews = drawn.filter(isOfPreviews).length;
    if (ofPreviews === 0) {
        return QUANTITIES.psnr.title;
    }
    return ofPreviews === drawn.length ? 'PSNR of previews, dB' : 'PSNR on held-out photographs or of previews, dB';
}

/**
 * The line of a value of each point, where null is no point. Along time, which is counted in seconds from
 * `startMs`, there is a gap between attempts.
 */
export function lineBy<P extends Moment>(
    points: readonly P[],
    valueOfPoint: (point: P) => number | null,
    along: Along,
    startMs: number,
): Line {
    const line: Line = { xs: [], ys: [] };
    let before: P | null = null;
    for (const point of points) {
        const value = valueOfPoint(point);
        if (value === null) {
            continue;
        }
        const x = along === 'iteration' ? point.iteration : (point.timeMs - startMs) / 1000;
        const lastX = line.xs.at(-1);
        if (
            along === 'time' &&
            before !== null &&
            before.attempt !== point.attempt &&
            lastX !== undefined &&
            x > lastX
        ) {
            line.xs.push((x + lastX) / 2);
            line.ys.push(null);
        }
        // A clock that went back must not draw a line back.
        if (lastX === undefined || x > lastX) {
            line.xs.push(x);
            line.ys.push(value);
        }
        before = point;
    }
    return line;
}

/** Lines over common places: `undefined` where a line has no point, which is no gap. */
export function joined(lines: readonly Line[]): { xs: number[]; columns: (number | null | undefined)[][] } {
    const xs = [...new Set(lines.flatMap((line) => line.xs))].toSorted((a, b) => a - b);
    const places = new Map(xs.map((x, i) => [x, i]));
    const columns = lines.map((line) => {
        const column = Array.from<number | null | undefined>({ length: xs.length });
        line.xs.forEach((x, i) => (column[places.get(x)!] = line.ys[i]!));
        return column;
    });
    return { xs, columns };
}

/** The value of a line at a place: its latest point there or before, null before its first. */
export function valueAt(line: Line, x: number): number | null {
    const last = line.xs.findLastIndex((other, i) => other <= x && line.ys[i] !== null);
    return last < 0 ? null : line.ys[last]!;
}

/** When the first point of all was reported. */
export const startOf = (series: readonly CurveSeries[]): number =>
    series.reduce((first, { points }) => Math.min(first, points[0]?.timeMs ?? Infinity), Infinity);

/** The part of x that has points; never without length. */
export function spanOf(
    series: readonly { readonly points: readonly Moment[] }[],
    along: Along,
    startMs: number,
): { min: number; max: number } {
    const place = (point: Moment): number =>
        along === 'iteration' ? point.iteration : (point.timeMs - startMs) / 1000;
    const ends = series.flatMap(({ points }) =>
        points.length === 0 ? [] : [place(points[0]!), place(points.at(-1)!)],
    );
    const [min, max] = ends.length === 0 ? [0, 1] : [Math.min(...ends), Math.max(...ends)];
    return max > min ? { min, max } : { min: min - 1, max: max + 1 };
}

/** Most series that are drawn without being asked for. */
export const MOST_DRAWN = 12;

/** The tasks to draw at first: those that reported last, since they are the ones that run. */
export function firstDrawn(series: readonly CurveSeries[]): string[] {
    const order = series
        .map(({ task, points }, i) => ({ task, i, last: points.at(-1)?.timeMs ?? -Infinity }))
        .filter(({ last }) => last > -Infinity)
        .toSorted((a, b) => b.last - a.last || a.i - b.i)
        .slice(0, MOST_DRAWN)
        .toSorted((a, b) => a.i - b.i);
    return order.map(({ task }) => task);
}

/** What the x axis says of a place. */
export const placeText = (x: number, along: Along): string =>
    along === 'iteration' ? `iteration ${grouped(x)}` : `after ${duration(1000 * x)}`;

/** The colour and the dashes of each drawn series; what it has it keeps while it is drawn. */
export class Looks {
    readonly #taken = new Map<string, number>();

    /** Frees the looks of all others. */
    keep(tasks: ReadonlySet<string>): void {
        [...this.#taken.keys()].filter((task) => !tasks.has(task)).forEach((task) => this.#taken.delete(task));
        for (const task of tasks) {
            if (!this.#taken.has(task)) {
                const taken = new Set(this.#taken.values());
                let free = 0;
                while (taken.has(free)) {
                    free += 1;
                }
                this.#taken.set(task, free);
            }
        }
    }

    /** A CSS variable, and dashes in pixels; eight colours solid, then dashed, then dotted. */
    of(task: string): { readonly colour: string; readonly dash: readonly number[] } {
        const number = this.#taken.get(task) ?? 0;
        const dashes = [[], [7, 4], [2, 3]];
        return { colour: `--curve-${(number % 8) + 1}`, dash: dashes[Math.floor(number / 8) % 3]! };
    }
}
