// What the map of a plan shows, as plain numbers: cells with their states, cameras on the plane, and the
// projection to pixels.
//
// As in plan.png, the aligned x axis points right and z up the page. Cells are open at the edge of the scene;
// there they end at the frame.

import type { Bounds, CameraEntry } from '../../viewer/scene.ts';
import { type Quat, type Vec3, quatInverse, rotate, scale } from '../../viewer/vector.ts';
import { type ShownState, type TaskInfo, shownState } from './part.ts';

export interface Box {
    readonly min: Vec3;
    readonly max: Vec3;
}

/** The keys of plan.json that are read. */
export interface PlanContent {
    readonly columns?: number | null;
    readonly rows?: number | null;
    readonly cut?: { readonly shape: string; readonly reason: string };
    readonly alignment: { readonly world_to_aligned_quat_wxyz: readonly [number, number, number, number] };
    readonly extent: { readonly viewing_distance: number | null; readonly cameras: Box };
    readonly views: number;
    readonly held_out: readonly number[];
    readonly partitions: readonly PlanPartition[];
}

export interface PlanPartition {
    readonly id: number;
    readonly cell: { readonly x: Bounds; readonly z: Bounds };
    readonly extended_box: Box;
    readonly base_views: readonly number[];
    readonly chosen_views: readonly number[];
    /** How many of the chosen views see less than enough, and were added to reach the minimum. */
    readonly filled_views: number;
    readonly cell_points: number;
    readonly iterations: number;
    readonly max_gaussians: number;
}

/** The keys of a manifest that are read. */
export interface ManifestContent {
    readonly views: readonly {
        readonly name: string;
        /** World to camera; the rotation in the order x y z w. */
        readonly pose: { readonly rotation: Quat; readonly translation: Vec3 };
    }[];
}

/** A camera on the plane. */
export interface MapCamera {
    /** Its number in the plan: the place of its name in sorted order. */
    readonly index: number;
    readonly name: string;
    readonly x: number;
    readonly z: number;
    /** Where it looks, as it appears from above; shorter than 1 if it looks down or up. */
    readonly dx: number;
    readonly dz: number;
    readonly isHeldOut: boolean;
    /** The partition that has it for its own. */
    readonly owner: number | null;
}

/** Places all cameras on the plane. An empty list where the cameras are not known. */
export function placeCameras(
    plan: PlanContent,
    cameras: readonly CameraEntry[] | ManifestContent | null,
): MapCamera[] {
    if (cameras === null) {
        return [];
    }
    const [w, x, y, z] = plan.alignment.world_to_aligned_quat_wxyz;
    const toAligned: Quat = [x, y, z, w];
    const heldOut = new Set(plan.held_out);
    const owners = new Map(
        plan.partitions.flatMap(({ id, base_views }) => base_views.map((view) => [view, id] as const)),
    );
    const place = (index: number, name: string, centre: Vec3, ahead: Vec3): MapCamera => {
        const at = rotate(toAligned, centre);
        const look = rotate(toAligned, ahead);
        return {
            index,
            name,
            x: at[0],
            z: at[2],
            dx: look[0],
            dz: look[2],
            isHeldOut: heldOut.has(index),
            owner: owners.get(index) ?? null,
        };
    };
    if ('views' in cameras) {
        return cameras.views.map(({ name, pose }, index) => {
            const toWorld = quatInverse(pose.rotation);
            return place(index, name, rotate(toWorld, scale(pose.translation, -1)), rotate(toWorld, [0, 0, 1]));
        });
    }
    // The third column of camera-to-world is the direction of view.
    return cameras.map(({ id, img_name, position, rotation }) =>
        place(id, img_name, position, [rotation[0][2], rotation[1][2], rotation[2][2]]),
    );
}

/** How far a partition is. */
export interface CellState {
    readonly state: ShownState;
    /** 0 to 1, of the iterations of its current task. */
    readonly share: number;
    /** Whether this is the part of its run before the exchange between partitions. */
    readonly isFirstPart: boolean;
    readonly task: TaskInfo | null;
}

const WAITING: CellState = { state: 'waiting', share: 0, isFirstPart: false, task: null };

/** The state of each partition, by its id. Of two tasks the later one counts once it has begun. */
export function cellStates(plan: PlanContent, tasks: readonly TaskInfo[]): Map<number, CellState> {
    const states = new Map<number, CellState>(plan.partitions.map(({ id }) => [id, WAITING]));
    const first = tasks.filter(({ stage }) => stage === 'first_part');
    const rest = tasks.filter(({ stage }) => stage === 'partition');
    for (const task of [...first, ...rest]) {
        if (task.partition === null || !states.has(task.partition)) {
            continue;
        }
        const before = states.get(task.partition)!;
        const state = shownState(task.state);
        const isFirstPart = task.stage === 'first_part';
        // A failed first part cancels the rest, which should not hide the failure.
        if (!isFirstPart && before.state === 'failed' && state !== 'done') {
            continue;
        }
        if (!isFirstPart && state === 'waiting' && before.task !== null) {
            continue;
        }
        const share = state === 'done' ? 1 : task.iterations > 0 ? Math.min(1, task.iteration / task.iterations) : 0;
        // The first part is not the whole: its end is not the end of the partition.
        states.set(task.partition, {
            state: isFirstPart && state === 'done' ? 'waiting' : state,
            share: isFirstPart && state === 'done' ? 0 : share,
            isFirstPart,
            task,
        });
    }
    return states;
}

/** How many partitions are in each state. */
export function countStates(states: Iterable<CellState>): Record<ShownState, number> {
    const counts: Record<ShownState, number> = { waiting: 0, running: 0, done: 0, failed: 0, cancelled: 0 };
    for (const { state } of states) {
        counts[state] += 1;
    }
    return counts;
}

/** Cameras that see enough of the extended box of a partition. */
export const seenBy = (partition: PlanPartition): number =>
    Math.max(0, partition.chosen_views.length - partition.filled_views);

/** Part of the plane, aligned axes. */
export interface Area {
    readonly x0: number;
    readonly x1: number;
    readonly z0: number;
    readonly z1: number;
}

/** Everything that has a finite place: the cameras and the extended boxes. */
export function areaOf(plan: PlanContent, cameras: readonly MapCamera[]): Area {
    let [x0, x1] = [plan.extent.cameras.min[0], plan.extent.cameras.max[0]];
    let [z0, z1] = [plan.extent.cameras.min[2], plan.extent.cameras.max[2]];
    const include = (x: number, z: number): void => {
        if (Number.isFinite(x) && Number.isFinite(z)) {
            [x0, x1, z0, z1] = [Math.min(x0, x), Math.max(x1, x), Math.min(z0, z), Math.max(z1, z)];
        }
    };
    for (const {
        extended_box: { min, max },
    } of plan.partitions) {
        include(min[0], min[2]);
        include(max[0], max[2]);
    }
    cameras.forEach(({ x, z }) => include(x, z));
    // A margin, and never a side of nothing.
    const [padX, padZ] = [0.015 * (x1 - x0) || 0.5, 0.015 * (z1 - z0) || 0.5];
    return { x0: x0 - padX, x1: x1 + padX, z0: z0 - padZ, z1: z1 + padZ };
}

/** What part of the map is shown: 1 is the whole, `x` and `z` are in its middle. */
export interface MapView {
    readonly zoom: number;
    readonly x: number;
    readonly z: number;
}

/** From the plane to pixels and back. */
export interface Projection {
    readonly pixelsPerUnit: number;
    x(x: number): number;
    y(z: number): number;
    /** The place on the plane at a pixel. */
    at(left: number, top: number): { x: number; z: number };
    /** Left, top, right, bottom; open sides end at the frame of the whole map. */
    rect(cell: PlanPartition['cell']): readonly [number, number, number, number];
}

export const MOST_ZOOM = 60;

/** Keeps the view inside the map. */
export function clampView(area: Area, width: number, height: number, view: MapView): MapView {
    const zoom = Math.min(MOST_ZOOM, Math.max(1, view.zoom));
    const fit = Math.min(width / (area.x1 - area.x0), height / (area.z1 - area.z0));
    const clamp = (at: number, lo: number, hi: number, pixels: number): number => {
        const half = pixels / fit / 2;
        const middle = (lo + hi) / 2;
        const slack = half * (1 - 1 / zoom);
        return Math.min(middle + slack, Math.max(middle - slack, at));
    };
    return { zoom, x: clamp(view.x, area.x0, area.x1, width), z: clamp(view.z, area.z0, area.z1, height) };
}

export function project(area: Area, width: number, height: number, view: MapView): Projection {
    const fit = Math.min(width / (area.x1 - area.x0), height / (area.z1 - area.z0));
    const pixelsPerUnit = fit * view.zoom;
    const [midX, midZ] = [(area.x0 + area.x1) / 2, (area.z0 + area.z1) / 2];
    const [halfX, halfZ] = [width / fit / 2, height / fit / 2];
    const toX = (x: number): number => width / 2 + (x - view.x) * pixelsPerUnit;
    const toY = (z: number): number => height / 2 - (z - view.z) * pixelsPerUnit;
    return {
        pixelsPerUnit,
        x: toX,
        y: toY,
        at: (left, top) => ({
            x: view.x + (left - width / 2) / pixelsPerUnit,
            z: view.z - (top - height / 2) / pixelsPerUnit,
        }),
        rect: ({ x, z }) => [
            toX(Math.max(x.lo ?? -Infinity, midX - halfX)),
            toY(Math.min(z.hi ?? Infinity, midZ + halfZ)),
            toX(Math.min(x.hi ?? Infinity, midX + halfX)),
            toY(Math.max(z.lo ?? -Infinity, midZ - halfZ)),
        ],
    };
}

const isIn = (value: number, { lo, hi }: Bounds): boolean =>
    (lo === null || value > lo) && (hi === null || value <= hi);

/** Whether a cell holds a place; `lo` is excluded, `hi` included. */
export const holds = ({ cell }: PlanPartition, x: number, z: number): boolean => isIn(x, cell.x) && isIn(z, cell.z);

/** The partition whose cell holds a place. */
export const partitionAt = (plan: PlanContent, x: number, z: number): PlanPartition | null =>
    plan.partitions.find((partition) => holds(partition, x, z)) ?? null;

/** The cameras of a partition: its own, and held-out ones that stand in its cell. */
export function camerasOf(partition: PlanPartition, cameras: readonly MapCamera[]): MapCamera[] {
    const own = new Set(partition.base_views);
    return cameras.filter(({ index, isHeldOut, x, z }) => own.has(index) || (isHeldOut && holds(partition, x, z)));
}

/** Pixels of the map for each camera, below which cameras cannot be distinguished. */
const CROWDED = 120;

/** Area of the map for each camera, pixels. */
export const pixelsPerCamera = (area: Area, projection: Projection, cameras: readonly MapCamera[]): number =>
    ((area.x1 - area.x0) * (area.z1 - area.z0) * projection.pixelsPerUnit ** 2) / (cameras.length + 1);

/** Whether the cameras stand too densely to be pointed at one by one. */
export const isCrowded = (pixels: number): boolean => pixels < CROWDED;

/**
 * The middle of a label in a cell, where it hides the fewest cameras; of several such places the one nearest to
 * the middle of the cell. All in pixels.
 */
export function quietPlace(
    [left, top, right, bottom]: readonly [number, number, number, number],
    halfWidth: number,
    halfHeight: number,
    cameras: readonly (readonly [number, number])[],
): [number, number] {
    const inside = cameras.filter(([x, y]) => x >= left && x <= right && y >= top && y <= bottom);
    const shares = [0, -0.25, 0.25, -0.5, 0.5, -0.75, 0.75, -1, 1];
    const [midX, midY] = [(left + right) / 2, (top + bottom) / 2];
    const [roomX, roomY] = [Math.max(0, midX - left - halfWidth - 4), Math.max(0, midY - top - halfHeight - 4)];
    let [best, least]: [[number, number], number] = [[midX, midY], Infinity];
    for (const shareX of shares) {
        for (const shareY of shares) {
            const [x, y] = [midX + shareX * roomX, midY + shareY * roomY];
            const hides = inside.filter(
                ([cx, cy]) => Math.abs(cx - x) < halfWidth + 4 && Math.abs(cy - y) < halfHeight + 4,
            );
            // Below 2, so that the distance decides only between places that hide as many.
            const cost = 2 * hides.length + Math.hypot(shareX, shareY);
            if (cost < least) {
                [best, least] = [[x, y], cost];
            }
        }
    }
    return best;
}

/** The camera nearest to a pixel, at most `reach` pixels away. */
export function cameraAt(
    cameras: readonly MapCamera[],
    projection: Projection,
    left: number,
    top: number,
    reach: number,
): MapCamera | null {
    let [best, least] = [null as MapCamera | null, reach];
    for (const camera of cameras) {
        const away = Math.hypot(projection.x(camera.x) - left, projection.y(camera.z) - top);
        if (away <= least) {
            [best, least] = [camera, away];
        }
    }
    return best;
}

/**
 * The next partition in a direction (1 or -1 along x or z): of those whose middle lies that way, the one that is
 * nearest, where a step to the side counts double.
 */
export function nextPartition(
    plan: PlanContent,
    area: Area,
    from: PlanPartition,
    dx: number,
    dz: number,
): PlanPartition {
    const middle = ({ cell: { x, z } }: PlanPartition): [number, number] => [
        (Math.max(x.lo ?? area.x0, area.x0) + Math.min(x.hi ?? area.x1, area.x1)) / 2,
        (Math.max(z.lo ?? area.z0, area.z0) + Math.min(z.hi ?? area.z1, area.z1)) / 2,
    ];
    const [x0, z0] = middle(from);
    let [best, least] = [from, Infinity];
    for (const other of plan.partitions) {
        const [x, z] = middle(other);
        const ahead = (x - x0) * dx + (z - z0) * dz;
        const aside = Math.abs((x - x0) * dz) + Math.abs((z - z0) * dx);
        const cost = ahead + 2 * aside;
        if (other !== from && ahead > 1e-9 && ahead >= aside && cost < least) {
            [best, least] = [other, cost];
        }
    }
    return best;
}
