// The borders between cells, and the lines through the middle of cells that they are compared with. Twin of
// coordinator/plan/src/seam_lines.rs.

import type { Bounds } from '../../viewer/scene.ts';
import type { PlanContent } from './plan-layout.ts';

/** A straight line on the aligned x-z plane, along one axis. */
export interface SeamLine {
    /** The axis whose coordinate is constant along the line. */
    readonly axis: 'x' | 'z';
    readonly at: number;
    /** On the other axis; infinite for open cells. */
    readonly from: number;
    readonly to: number;
}

type Cell = PlanContent['partitions'][number]['cell'];

/** Minimum distance of a control line from the borders of its cell, in bands. */
const LEAST_BANDS = 4;
const AXES = ['x', 'z'] as const;
const OTHER = { x: 'z', z: 'x' } as const;

const line = (axis: 'x' | 'z', at: number, along: Bounds): SeamLine => ({
    axis,
    at,
    from: along.lo ?? -Infinity,
    to: along.hi ?? Infinity,
});

/** Lines that touch or overlap made one; lines without length left out. */
function joined(lines: readonly SeamLine[]): SeamLine[] {
    const sorted = lines
        .filter(({ from, to }) => from < to)
        .toSorted((a, b) => {
            // Infinities have no difference.
            const from = a.from === b.from ? 0 : a.from - b.from;
            return a.axis.localeCompare(b.axis) || a.at - b.at || from;
        });
    const result: SeamLine[] = [];
    for (const next of sorted) {
        const last = result.at(-1);
        if (last !== undefined && last.axis === next.axis && last.at === next.at && next.from <= last.to) {
            result[result.length - 1] = { ...last, to: Math.max(last.to, next.to) };
        } else {
            result.push(next);
        }
    }
    return result;
}

/** The borders between cells, in as few pieces as they are straight. */
export const borders = (cells: readonly Cell[]): SeamLine[] =>
    joined(
        // Cells are (lo, hi], so each border is the upper side of a cell.
        cells.flatMap((cell) =>
            AXES.flatMap((axis) => {
                const { hi } = cell[axis];
                return hi === null ? [] : [line(axis, hi, cell[OTHER[axis]])];
            }),
        ),
    );

/** The lines through the middle of cells, where nothing was cut; `band` in scene units. */
export function middles(plan: PlanContent, band: number): SeamLine[] {
    const { min, max } = plan.extent.cameras;
    const found = plan.partitions.flatMap(({ cell }) =>
        AXES.flatMap((axis) => {
            const index = axis === 'x' ? 0 : 2;
            const across = cell[axis];
            if (across.lo === null && across.hi === null) {
                return [];
            }
            const hi = across.hi ?? max[index];
            const at = ((across.lo ?? min[index]) + hi) / 2;
            return hi - at >= LEAST_BANDS * band ? [line(axis, at, cell[OTHER[axis]])] : [];
        }),
    );
    return joined(found);
}
