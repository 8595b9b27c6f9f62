// What the viewer is given: the typed content of scene.json.
//
// `water`, `cameras` and `plan` hold the contents of a result's water.json, cameras.json and plan.json as they
// are. Of the plan only the keys below are read.

import { ViewerError } from './errors.ts';
import type { Mat3, Vec3 } from './vector.ts';
import { type WaterRecord, checkWater } from './water.ts';

/** One entry of cameras.json. */
export interface CameraEntry {
    readonly id: number;
    /** Name of the photograph, the key in `Scene.photographs`. */
    readonly img_name: string;
    /** Pixels. */
    readonly width: number;
    readonly height: number;
    /** Centre of the camera, scene units. */
    readonly position: Vec3;
    /** Camera to world, three rows; camera axes are x right, y down, z forward. */
    readonly rotation: Mat3;
    /** Focal lengths, pixels. */
    readonly fx: number;
    readonly fy: number;
    /** Principal point, pixels; the middle of the picture if absent. */
    readonly cx?: number;
    readonly cy?: number;
}

/** Bounds of a cell along one axis: `lo` is excluded, `hi` included, null is open. */
export interface Bounds {
    readonly lo: number | null;
    readonly hi: number | null;
}

/** The keys of plan.json that the viewer reads. */
export interface Plan {
    readonly alignment: {
        /** Scene axes, unit length. */
        readonly down: Vec3;
        /** From scene axes to the axes of the cells. */
        readonly world_to_aligned_quat_wxyz: readonly [number, number, number, number];
    };
    readonly extent?: {
        /** Scene scale, scene units. */
        readonly viewing_distance?: number;
    };
    readonly partitions: readonly {
        readonly id: number;
        /** On the aligned x-z plane. */
        readonly cell: { readonly x: Bounds; readonly z: Bounds };
    }[];
}

/** The content of scene.json. */
export interface Scene {
    /** Shown as the title. */
    readonly name: string;
    /** Path of the model, given to `fetchFile`: .ply, .compressed.ply or .sog. */
    readonly model: string;
    /** Content of water.json. If null, a water in the header of a PLY is used. */
    readonly water: WaterRecord | null;
    /** Content of cameras.json. */
    readonly cameras: readonly CameraEntry[] | null;
    /** Content of plan.json. */
    readonly plan: Plan | null;
    /** From `img_name` to the path of the photograph, given to `fetchFile`. */
    readonly photographs: Readonly<Record<string, string>>;
    /** Who made the scene and under which licence; plain text, may be empty. */
    readonly credits: string;
}

/** Fetches a file of the scene. A dashboard can add a token here. */
export type FetchFile = (path: string) => Promise<Response>;

type Unknowns = Record<string, unknown>;

const isNumber = (value: unknown): value is number => typeof value === 'number' && Number.isFinite(value);
const isVec3 = (value: unknown): value is Vec3 =>
    Array.isArray(value) && value.length === 3 && value.every(isNumber);
const isObject = (value: unknown): value is Unknowns =>
    typeof value === 'object' && value !== null && !Array.isArray(value);

function refuse(what: string): never {
    throw new ViewerError(
        `The description of the scene is wrong: ${what}.`,
        'Make scene.json again, or correct the file that it was made from.',
    );
}

function checkCamera(value: unknown, index: number): CameraEntry {
    const entry = isObject(value) ? value : refuse(`camera ${index} is not an object`);
    const name = typeof entry['img_name'] === 'string' ? entry['img_name'] : refuse(`camera ${index} has no img_name`);
    const rotation = entry['rotation'];
    const sizes = ['width', 'height', 'fx', 'fy'].every((key) => isNumber(entry[key]) && entry[key] > 0);
    const isRotation = Array.isArray(rotation) && rotation.length === 3 && rotation.every(isVec3);
    const principal = ['cx', 'cy'].every((key) => entry[key] === undefined || isNumber(entry[key]));
    if (!sizes || !isVec3(entry['position']) || !isRotation || !principal) {
        refuse(`camera ${index} ("${name}") needs numbers in width, height, position, rotation, fx and fy`);
    }
    return { ...(entry as unknown as CameraEntry), id: isNumber(entry['id']) ? entry['id'] : index };
}

function checkPlan(value: unknown): Plan {
    const plan = isObject(value) ? value : refuse('plan is not an object');
    const alignment = plan['alignment'];
    const quat = isObject(alignment) ? alignment['world_to_aligned_quat_wxyz'] : undefined;
    if (!isObject(alignment) || !isVec3(alignment['down']) || !Array.isArray(quat) || !quat.every(isNumber)) {
        refuse('plan.alignment needs down and world_to_aligned_quat_wxyz');
    }
    const isBound = (side: unknown): boolean => side === null || isNumber(side);
    const isBounds = (axis: unknown): boolean => isObject(axis) && isBound(axis['lo']) && isBound(axis['hi']);
    const isPartition = (part: unknown): boolean =>
        isObject(part) && isObject(part['cell']) && isBounds(part['cell']['x']) && isBounds(part['cell']['z']);
    if (!Array.isArray(plan['partitions']) || !plan['partitions'].every(isPartition)) {
        refuse('plan.partitions needs a cell for each partition');
    }
    return plan as unknown as Plan;
}

/** Checks parsed JSON. Throws a `ViewerError` that names the first wrong key. */
export function checkScene(value: unknown): Scene {
    const scene = isObject(value) ? value : refuse('it is not an object');
    if (typeof scene['model'] !== 'string' || scene['model'] === '') {
        refuse('model must be the path of the model');
    }
    const photographs = scene['photographs'] ?? {};
    if (!isObject(photographs) || !Object.values(photographs).every((path) => typeof path === 'string')) {
        refuse('photographs must map names to paths');
    }
    const cameras = scene['cameras'] ?? null;
    if (cameras !== null && !Array.isArray(cameras)) {
        refuse('cameras must be a list');
    }
    const plan = scene['plan'] ?? null;
    const water = scene['water'] ?? null;
    return {
        name: typeof scene['name'] === 'string' ? scene['name'] : 'Scene',
        model: scene['model'] as string,
        water: water === null ? null : checkWater(water),
        cameras: cameras === null ? null : cameras.map(checkCamera),
        plan: plan === null ? null : checkPlan(plan),
        photographs: photographs as Record<string, string>,
        credits: typeof scene['credits'] === 'string' ? scene['credits'] : '',
    };
}
