// One model of several, while partitions train: the Gaussians of each finished partition within its cell, and
// those of the coarse model in the other cells. Cells are those of the merge (partitions.ts). Unlike it,
// nothing is removed as a duplicate or to stay within a limit.

import { ViewerError } from './errors.ts';
import { Cells } from './partitions.ts';
import { readHeader } from './ply.ts';
import type { Plan } from './scene.ts';

/** Rows of a PLY whose properties are all 32-bit floats, as Fathom writes them. */
export interface Rows {
    readonly comments: readonly string[];
    readonly properties: readonly string[];
    /** Row after row. */
    readonly values: Float32Array;
}

type CutPlan = Pick<Plan, 'alignment' | 'partitions'>;

/** Reads the rows of a model. `name` is used in messages. */
export function readRows(bytes: Uint8Array, name: string): Rows {
    const { comments, elements, bytes: start } = readHeader(bytes, name);
    const vertex = elements[0]!;
    const { properties, rowBytes, count } = vertex;
    if (vertex.name !== 'vertex' || rowBytes !== 4 * properties.length) {
        throw new ViewerError(
            `${name} is not a model as Fathom writes it: not all of its values are 32-bit floats.`,
            'Wait until the job has succeeded, then open the finished model.',
        );
    }
    // A copy, because the rows begin at any byte.
    const { buffer } = new Uint8Array(bytes.subarray(start, start + count * rowBytes));
    return { comments, properties, values: new Float32Array(buffer) };
}

/** The rows whose centres lie in cells for which `isKept` holds. It gets indices in `plan.partitions`. */
export function keptRows(rows: Rows, plan: CutPlan, isKept: (index: number) => boolean): Rows {
    const { properties, values } = rows;
    const width = properties.length;
    const [x, y, z, opacity] = ['x', 'y', 'z', 'opacity'].map((name) => properties.indexOf(name));
    const cells = new Cells(plan);
    const kept = new Float32Array(values.length);
    let filled = 0;
    for (let at = 0; at < values.length; at += width) {
        const index = cells.at(values[at + x!]!, values[at + y!]!, values[at + z!]!);
        // As in the merge, nobody owns a Gaussian without a finite centre and opacity.
        if (index >= 0 && Number.isFinite(values[at + opacity!]!) && isKept(index)) {
            kept.set(values.subarray(at, at + width), filled);
            filled += width;
        }
    }
    return { ...rows, values: kept.slice(0, filled) };
}

/** Coefficients of harmonics beyond the constant one, by channel. */
const harmonics = (properties: readonly string[]): number =>
    properties.filter((name) => name.startsWith('f_rest_')).length / 3;

/** Where each property of `to` is among those of `from`; -1 for a harmonic of a higher degree. */
function columnsOf(from: readonly string[], to: readonly string[]): readonly number[] {
    const [have, want] = [harmonics(from), harmonics(to)];
    return to.map((name) => {
        if (!name.startsWith('f_rest_')) {
            return from.indexOf(name);
        }
        // All of red, then all of green, then all of blue.
        const number = Number(name.slice('f_rest_'.length));
        const [channel, k] = [Math.floor(number / want), number % want];
        return k < have ? from.indexOf(`f_rest_${channel * have + k}`) : -1;
    });
}

/** One PLY of all rows, with the comments of the first part that has rows of its own. */
export function joinedPly(parts: readonly Rows[]): Uint8Array<ArrayBuffer> {
    const widest = parts.reduce((a, b) => (b.properties.length > a.properties.length ? b : a));
    const { properties } = widest;
    const counts = parts.map((part) => part.values.length / part.properties.length);
    const header = [
        'ply',
        'format binary_little_endian 1.0',
        ...parts[0]!.comments.map((comment) => `comment ${comment}`),
        `element vertex ${counts.reduce((a, b) => a + b, 0)}`,
        ...properties.map((name) => `property float ${name}`),
        'end_header',
        '',
    ].join('\n');
    const pieces = parts.map((part, i) => {
        if (part.properties.join() === properties.join()) {
            return part.values;
        }
        const columns = columnsOf(part.properties, properties);
        const [from, to] = [part.properties.length, properties.length];
        const values = new Float32Array(counts[i]! * to);
        for (let row = 0; row < counts[i]!; row++) {
            columns.forEach((column, j) => {
                values[row * to + j] = column < 0 ? 0 : part.values[row * from + column]!;
            });
        }
        return values;
    });
    const head = new TextEncoder().encode(header);
    const whole = new Uint8Array(head.length + pieces.reduce((sum, { byteLength }) => sum + byteLength, 0));
    whole.set(head);
    let at = head.length;
    for (const { buffer, byteOffset, byteLength } of pieces) {
        whole.set(new Uint8Array(buffer, byteOffset, byteLength), at);
        at += byteLength;
    }
    return whole;
}

/**
 * A PLY of the coarse model and of partitions that have finished, by their index in `plan.partitions`; of
 * each partition at least the rows of its own cell. The water among its comments is that of the coarse
 * model, or of the first partition.
 */
export function compositeOf(
    plan: CutPlan,
    coarse: Rows | null,
    finished: ReadonlyMap<number, Rows>,
): Uint8Array<ArrayBuffer> {
    const inCells = [...finished].map(([index, rows]) => keptRows(rows, plan, (cell) => cell === index));
    const elsewhere = coarse === null ? [] : [keptRows(coarse, plan, (cell) => !finished.has(cell))];
    return joinedPly([...elsewhere, ...inCells]);
}
