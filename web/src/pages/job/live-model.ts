// Fetches the models of a job that still trains, and makes one of them.

import type { CameraEntry, Plan } from '../../viewer/scene.ts';
import { type Rows, compositeOf, keptRows, readRows } from '../../viewer/composite.ts';
import { type Quat, type Vec3, matOfQuat, quatInverse, rotate, scale } from '../../viewer/vector.ts';
import type { Live } from './live-state.ts';
import type { JobContext } from './section.ts';

type Composite = Extract<Live, { kind: 'composite' }>;

export class LiveModel {
    readonly #context: JobContext;
    readonly #plan: Plan;
    /** What is kept of each model, by its digest. */
    readonly #known = new Map<string, Rows>();

    constructor(context: JobContext, plan: Plan) {
        this.#context = context;
        this.#plan = plan;
    }

    /** The model as a PLY. `onStep` is told how many files of how many are there. */
    async ply(
        live: Exclude<Live, { kind: 'finished' }>,
        onStep: (done: number, total: number) => void,
    ): Promise<Uint8Array<ArrayBuffer>> {
        if (live.kind === 'merged') {
            onStep(0, 1);
            return this.#fetch(live.model.digest);
        }
        return this.#composite(live, onStep);
    }

    async #composite(
        { coarse, partitions }: Composite,
        onStep: (done: number, total: number) => void,
    ): Promise<Uint8Array<ArrayBuffer>> {
        const total = partitions.size + (coarse === null ? 0 : 1);
        let done = 0;
        const read = async (digest: string, name: string, ofCell: number | null): Promise<Rows> => {
            onStep(done, total);
            const known = this.#known.get(digest);
            const all = known ?? readRows(await this.#fetch(digest), name);
            // The margins of a partition are never shown.
            const rows =
                known !== undefined || ofCell === null
                    ? all
                    : keptRows(all, this.#plan, (at) => at === ofCell);
            this.#known.set(digest, rows);
            done += 1;
            return rows;
        };
        const whole = coarse === null ? null : await read(coarse.digest, 'The coarse model', null);
        const finished = new Map<number, Rows>();
        for (const [partition, { digest }] of partitions) {
            const index = this.#plan.partitions.findIndex(({ id }) => id === partition);
            finished.set(index, await read(digest, `The model of partition ${partition}`, index));
        }
        return compositeOf(this.#plan, whole, finished);
    }

    async #fetch(digest: string): Promise<Uint8Array<ArrayBuffer>> {
        const { id, session, signal } = this.#context;
        const blob = await session.api.blob(digest, id, signal);
        return new Uint8Array(await blob.arrayBuffer());
    }
}

/** The keys of a manifest that are read. */
interface Manifest {
    readonly cameras?: readonly {
        readonly id: number;
        readonly model: string;
        readonly width: number;
        readonly height: number;
        readonly params: readonly number[];
    }[];
    readonly views?: readonly {
        readonly name: string;
        readonly camera_id: number;
        /** World to camera; the rotation in the order x y z w. */
        readonly pose: { readonly rotation: Quat; readonly translation: Vec3 };
    }[];
}

/** Models of COLMAP with one focal length, which comes first. */
const ONE_FOCAL_LENGTH = /^SIMPLE_|^RADIAL/i;

/**
 * The cameras of a manifest, as those of cameras.json. Distortion is left out, so pictures differ a little
 * from photographs with it; cameras without a focal length are left out too.
 */
export function camerasOf(manifest: unknown): CameraEntry[] {
    const { cameras = [], views = [] } = (manifest ?? {}) as Manifest;
    const known = new Map(cameras.map((camera) => [camera.id, camera]));
    return views.flatMap(({ name, camera_id, pose }, id) => {
        const camera = known.get(camera_id);
        if (camera === undefined || /^equirectangular$/i.test(camera.model)) {
            return [];
        }
        const isOne = ONE_FOCAL_LENGTH.test(camera.model);
        const [fx, fy, cx, cy] = isOne ? [camera.params[0], ...camera.params] : camera.params;
        if (fx === undefined || fy === undefined || cx === undefined || cy === undefined) {
            return [];
        }
        const toWorld = quatInverse(pose.rotation);
        const position = rotate(toWorld, scale(pose.translation, -1));
        const { width, height } = camera;
        return [
            { id, img_name: name, width, height, position, rotation: matOfQuat(toWorld), fx, fy, cx, cy },
        ];
    });
}
