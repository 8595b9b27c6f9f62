// Which partition keeps a Gaussian: the cell that its centre lies in.
//
// The arithmetic is that of the merge, operation by operation (`Alignment::to_aligned` in
// coordinator/plan/src/geometry.rs, and the product of a quaternion with a vector in glam), so that both
// agree on the owner of a Gaussian to the last bit.

import type { Bounds, Plan } from './scene.ts';

const isIn = (value: number, { lo, hi }: Bounds): boolean =>
    (lo === null || value > lo) && (hi === null || value <= hi);

/** The cells of a plan. */
export class Cells {
    readonly #cells: readonly { readonly x: Bounds; readonly z: Bounds }[];
    readonly #quat: readonly [number, number, number, number];

    constructor(plan: Pick<Plan, 'alignment' | 'partitions'>) {
        this.#cells = plan.partitions.map(({ cell }) => cell);
        this.#quat = plan.alignment.world_to_aligned_quat_wxyz;
    }

    /** The index in `plan.partitions` of the cell that holds a point, scene axes; -1 if it is not finite. */
    at(x: number, y: number, z: number): number {
        const [alignedX, alignedY, alignedZ] = this.#toAligned(x, y, z);
        if (!Number.isFinite(alignedX) || !Number.isFinite(alignedY) || !Number.isFinite(alignedZ)) {
            return -1;
        }
        return this.#cells.findIndex((cell) => isIn(alignedX, cell.x) && isIn(alignedZ, cell.z));
    }

    #toAligned(x: number, y: number, z: number): readonly [number, number, number] {
        const [w, bx, by, bz] = this.#quat;
        const own = w * w - (bx * bx + by * by + bz * bz);
        const along = (x * bx + y * by + z * bz) * 2;
        const across = w * 2;
        return [
            x * own + bx * along + (by * z - y * bz) * across,
            y * own + by * along + (bz * x - z * bx) * across,
            z * own + bz * along + (bx * y - x * by) * across,
        ];
    }
}

/** The index in `plan.partitions` of each centre (scene axes, x y z after each other), at most 255. */
export function partitionsOf(plan: Plan, centres: Float32Array): Uint8Array {
    const cells = new Cells(plan);
    const numbers = new Uint8Array(centres.length / 3);
    for (let i = 0; i < numbers.length; i++) {
        const found = cells.at(centres[3 * i]!, centres[3 * i + 1]!, centres[3 * i + 2]!);
        numbers[i] = Math.min(255, Math.max(0, found));
    }
    return numbers;
}
