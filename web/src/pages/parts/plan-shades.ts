// By what the map of a plan shades its cells besides their states: workers, PSNR, and the cameras that see
// them. Each way has a legend.

import { counted, decibels, grouped } from './format.ts';
import { shownPsnr } from './part.ts';
import { type CellState, type PlanContent, type PlanPartition, seenBy } from './plan-layout.ts';

export type ShadeBy = 'state' | 'worker' | 'psnr' | 'cameras';
export const SHADE_WORDS: readonly (readonly [ShadeBy, string])[] = [
    ['state', 'State'],
    ['worker', 'Worker'],
    ['psnr', 'PSNR'],
    ['cameras', 'Seen by few cameras'],
];

export type Pattern = 'plain' | 'hatched' | 'crossed';

/** How a cell is filled. */
export interface Shade {
    /** A colour as #rrggbb, or the name of a CSS variable that has one. */
    readonly fill: string;
    /** How much of the fill there is on the ground of the map, 0 to 1. */
    readonly share: number;
    readonly pattern: Pattern;
    /** The CSS variable of the lines of the pattern. */
    readonly stroke: string;
}

export interface LegendEntry {
    readonly shade: Shade;
    readonly text: string;
}

/** What the map shows of a cell. */
export interface ShadedCell {
    readonly shade: Shade;
    /** In a cell with room for words. */
    readonly words: string;
    /** In a cell with room for a few digits. */
    readonly number: string;
}

export interface Shading {
    of(partition: PlanPartition): ShadedCell;
    readonly legend: readonly LegendEntry[];
}

const shade = (fill: string, change: Partial<Shade> = {}): Shade => ({
    fill,
    share: 1,
    pattern: 'plain',
    stroke: '--ink',
    ...change,
});
const NO_WORKER = shade('--waiting-fill');
const NO_PSNR = shade('--panel', { pattern: 'hatched', stroke: '--line' });

// Workers

const WORKER_COLOURS = 8;
const PATTERNS: readonly Pattern[] = ['plain', 'hatched', 'crossed'];
export const MOST_WORKERS = WORKER_COLOURS * PATTERNS.length;
/** Of all workers beyond those that can be distinguished. */
const OTHER_WORKERS = shade('--cancelled-fill', { pattern: 'crossed', stroke: '--soft' });

/** The shade of each worker; what it has it keeps while it has cells. */
export class WorkerShades {
    readonly #taken = new Map<string, number>();

    /** Frees the shades of all others. */
    keep(workers: ReadonlySet<string>): void {
        [...this.#taken.keys()].filter((name) => !workers.has(name)).forEach((name) => this.#taken.delete(name));
        const used = new Set(this.#taken.values());
        let free = 0;
        for (const name of workers) {
            while (used.has(free)) {
                free += 1;
            }
            if (!this.#taken.has(name) && free < MOST_WORKERS) {
                this.#taken.set(name, free);
                used.add(free);
            }
        }
    }

    /** Null for one of those that cannot be distinguished. */
    of(worker: string): Shade | null {
        const number = this.#taken.get(worker);
        return number === undefined
            ? null
            : shade(`--worker-${(number % WORKER_COLOURS) + 1}`, {
                  pattern: PATTERNS[Math.floor(number / WORKER_COLOURS)]!,
              });
    }
}

/** The worker that trains a cell or trained it last; null where nobody has begun, or it waits again. */
const workerOf = ({ task }: CellState): string | null =>
    task === null || task.state === 'ready' || task.state === 'blocked' ? null : task.worker;

function byWorker(plan: PlanContent, states: ReadonlyMap<number, CellState>, shades: WorkerShades): Shading {
    const counts = new Map<string, number>();
    let without = 0;
    for (const { id } of plan.partitions) {
        const worker = workerOf(states.get(id)!);
        if (worker === null) {
            without += 1;
        } else {
            counts.set(worker, (counts.get(worker) ?? 0) + 1);
        }
    }
    shades.keep(new Set(counts.keys()));
    const named = [...counts].filter(([name]) => shades.of(name) !== null);
    const others = [...counts].filter(([name]) => shades.of(name) === null);
    const legend = named
        .toSorted(([a], [b]) => a.localeCompare(b, 'en', { numeric: true }))
        .map(([name, count]) => ({ shade: shades.of(name)!, text: `${name}: ${counted(count, 'cell')}` }));
    if (others.length > 0) {
        const cells = others.reduce((sum, [, count]) => sum + count, 0);
        const text = `${counted(others.length, 'other worker')}: ${counted(cells, 'cell')}`;
        legend.push({ shade: OTHER_WORKERS, text });
    }
    if (without > 0) {
        legend.push({ shade: NO_WORKER, text: `plain: no worker, ${counted(without, 'cell')}` });
    }
    return {
        legend,
        of: ({ id }) => {
            const worker = workerOf(states.get(id)!);
            const ofWorker = worker === null ? NO_WORKER : (shades.of(worker) ?? OTHER_WORKERS);
            return { shade: ofWorker, words: worker ?? 'no worker', number: String(id) };
        },
    };
}

// PSNR

/** Viridis: equal steps look equal, from dark to light, also to the colour-blind. */
const ORDERED = [
    '#440154', '#482878', '#3e4989', '#31688e', '#26828e', '#1f9e89', '#35b779', '#6ece58', '#b5de2b', '#fde725',
];
/** Widths of the steps of the scale, dB. */
const STEPS_DB = [0.5, 1, 2, 5, 10, 20, 50];
const MOST_STEPS = 6;

/** A scale with steps of equal width that holds all values. */
export interface PsnrScale {
    /** Where each step begins, ascending, dB. */
    readonly from: readonly number[];
    readonly width: number;
}

/** The scale of some values; null without any. */
export function psnrScale(values: readonly number[]): PsnrScale | null {
    const finite = values.filter(Number.isFinite);
    if (finite.length === 0) {
        return null;
    }
    const [lowest, highest] = [Math.min(...finite), Math.max(...finite)];
    const stepsOf = (width: number): number => Math.floor(highest / width) - Math.floor(lowest / width) + 1;
    const width = STEPS_DB.find((one) => stepsOf(one) <= MOST_STEPS) ?? STEPS_DB.at(-1)!;
    const first = Math.floor(lowest / width);
    const from = Array.from({ length: Math.min(MOST_STEPS, stepsOf(width)) }, (_, i) => (first + i) * width);
    return { from, width };
}

/** The number of the step that holds a value. */
export function stepOf({ from, width }: PsnrScale, value: number): number {
    const step = Math.floor((value - from[0]!) / width);
    return Math.min(from.length - 1, Math.max(0, step));
}

/** The colour of step `step` of `count`: the higher the lighter. */
export function orderedColour(step: number, count: number): string {
    const at = (count < 2 ? 0.5 : step / (count - 1)) * (ORDERED.length - 1);
    const before = Math.min(ORDERED.length - 2, Math.floor(at));
    return mixed(ORDERED[before]!, ORDERED[before + 1]!, at - before);
}

function byPsnr(plan: PlanContent, states: ReadonlyMap<number, CellState>): Shading {
    const known = plan.partitions.map(({ id }) => shownPsnr(states.get(id)!.task));
    const scale = psnrScale(known.flatMap((one) => (one === null ? [] : [one.value])));
    const legend: LegendEntry[] = [];
    if (scale !== null) {
        const { from, width } = scale;
        const digits = width < 1 ? 1 : 0;
        from.forEach((start, step) => {
            const text = `${start.toFixed(digits)} to ${(start + width).toFixed(digits)} dB`;
            legend.push({ shade: shade(orderedColour(step, from.length)), text });
        });
    }
    const without = known.filter((one) => one === null).length;
    if (without > 0) {
        legend.push({ shade: NO_PSNR, text: `hatched: no PSNR yet, ${counted(without, 'cell')}` });
    }
    return {
        legend,
        of: ({ id }) => {
            const psnr = shownPsnr(states.get(id)!.task);
            if (psnr === null || scale === null) {
                return { shade: NO_PSNR, words: 'no PSNR', number: '' };
            }
            const colour = orderedColour(stepOf(scale, psnr.value), scale.from.length);
            const number = String(Math.round(psnr.value));
            return { shade: shade(colour), words: decibels(psnr.value), number };
        },
    };
}

// Cameras

function byCameras(plan: PlanContent): Shading {
    const most = Math.max(1, ...plan.partitions.map(seenBy));
    const ofCount = (count: number, isFilled: boolean): Shade =>
        shade('--accent', {
            share: 0.1 + 0.5 * (count / most),
            ...(isFilled ? { pattern: 'hatched', stroke: '--warn' } : {}),
        });
    const marks = [...new Set([0, Math.round(most / 2), most])];
    const legend = marks.map((count) => ({ shade: ofCount(count, false), text: counted(count, 'camera') }));
    const few = plan.partitions.filter(({ filled_views }) => filled_views > 0).length;
    if (few > 0) {
        const hatched = shade('--panel', { pattern: 'hatched', stroke: '--warn' });
        legend.push({ shade: hatched, text: `hatched: seen by too few, ${counted(few, 'cell')}` });
    }
    return {
        legend,
        of: (partition) => {
            const count = seenBy(partition);
            const text = grouped(count);
            return { shade: ofCount(count, partition.filled_views > 0), words: counted(count, 'camera'), number: text };
        },
    };
}

/** How the cells of a plan are shaded; null by their states. */
export function shadingOf(
    by: ShadeBy,
    plan: PlanContent,
    states: ReadonlyMap<number, CellState>,
    workers: WorkerShades,
): Shading | null {
    switch (by) {
        case 'worker':
            return byWorker(plan, states, workers);
        case 'psnr':
            return byPsnr(plan, states);
        case 'cameras':
            return byCameras(plan);
        case 'state':
            return null;
    }
}

// Colours

type Three = readonly [number, number, number];

const parts = (hex: string): Three => [
    Number.parseInt(hex.slice(1, 3), 16),
    Number.parseInt(hex.slice(3, 5), 16),
    Number.parseInt(hex.slice(5, 7), 16),
];

/** A colour between two, as #rrggbb: 0 is the first. */
export function mixed(a: string, b: string, share: number): string {
    const [from, to] = [parts(a), parts(b)];
    const hex = from.map((value, i) =>
        Math.round(value + share * (to[i]! - value))
            .toString(16)
            .padStart(2, '0'),
    );
    return `#${hex.join('')}`;
}

/** The luminance of a colour, 0 to 1, as WCAG defines it. */
export function luminance(hex: string): number {
    const [r, g, b] = parts(hex).map((value) => {
        const share = value / 255;
        return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
    }) as [number, number, number];
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
}

/** The contrast of two colours, 1 to 21, as WCAG defines it. */
export function contrast(a: string, b: string): number {
    const [light, dark] = [luminance(a), luminance(b)].toSorted((x, y) => y - x) as [number, number];
    return (light + 0.05) / (dark + 0.05);
}

/** Black or white, whichever is more legible on a colour. The contrast is at least 4.5. */
export const inkOn = (fill: string): string =>
    contrast(fill, '#000000') >= contrast(fill, '#ffffff') ? '#000000' : '#ffffff';
