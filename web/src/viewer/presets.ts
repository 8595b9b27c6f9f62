// Views that a page suggests: cameras of photographs that stand far from each other.

import type { CameraEntry } from './scene.ts';
import { length, sub } from './vector.ts';

/** At most `count` cameras: first the one in the middle of all, then always the one farthest from the chosen. */
export function spreadOver(cameras: readonly CameraEntry[], count: number): CameraEntry[] {
    const middle = [0, 1, 2].map(
        (axis) => cameras.reduce((sum, camera) => sum + camera.position[axis]!, 0) / Math.max(1, cameras.length),
    ) as [number, number, number];
    const chosen: CameraEntry[] = [];
    // At first from the middle, with a sign that makes the nearest the best.
    let apart = cameras.map((camera) => -length(sub(camera.position, middle)));
    while (chosen.length < Math.min(count, cameras.length)) {
        const best = apart.reduce((at, value, i) => (value > apart[at]! ? i : at), 0);
        const next = cameras[best]!;
        if (chosen.length > 0 && !(apart[best]! > 0)) {
            // All that is left stands where a chosen one does.
            break;
        }
        const distances = cameras.map((camera) => length(sub(camera.position, next.position)));
        apart = distances.map((distance, i) => (chosen.length === 0 ? distance : Math.min(distance, apart[i]!)));
        chosen.push(next);
    }
    return chosen;
}
