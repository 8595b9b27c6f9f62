// Which partition keeps a Gaussian: the cell that its centre lies in.

import type { Bounds, Plan } from './scene.ts';
import { matOfQuat } from './vector.ts';

const isIn = (value: number, { lo, hi }: Bounds): boolean =>
    (lo === null || value > lo) && (hi === null || value <= hi);

/** The index in `plan.partitions` of each centre (scene axes, x y z after each other), at most 255. */
export function partitionsOf(plan: Plan, centres: Float32Array): Uint8Array {
    const [w, x, y, z] = plan.alignment.world_to_aligned_quat_wxyz;
    const [toX, , toZ] = matOfQuat([x, y, z, w]);
    const numbers = new Uint8Array(centres.length / 3);
    for (let i = 0; i < numbers.length; i++) {
        const [px, py, pz] = [centres[3 * i]!, centres[3 * i + 1]!, centres[3 * i + 2]!];
        const alignedX = toX[0] * px + toX[1] * py + toX[2] * pz;
        const alignedZ = toZ[0] * px + toZ[1] * py + toZ[2] * pz;
        const found = plan.partitions.findIndex(({ cell }) => isIn(alignedX, cell.x) && isIn(alignedZ, cell.z));
        numbers[i] = Math.min(255, Math.max(0, found));
    }
    return numbers;
}
