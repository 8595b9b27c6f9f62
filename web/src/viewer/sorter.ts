// The drawing side of sort-worker.ts. One sort runs at a time; of those that wait, only the latest is kept.

import { type Pinhole, type Pose, worldToCamera } from './camera.ts';
import type { FromWorker, ToWorker } from './sort-worker.ts';
import { startSorting } from './start-sorting.ts';

export type Sorted = FromWorker;

interface Waiting {
    readonly pose: Pose;
    readonly camera: Pinhole;
    readonly done: (sorted: Sorted | null) => void;
}

export class Sorter {
    readonly #worker: Worker;
    #running: Waiting | null = null;
    #next: Waiting | null = null;
    #number = 0;
    #spare: Uint32Array | null = null;
    /** Milliseconds that the last sort took. */
    lastMilliseconds = 0;

    constructor(centres: Float32Array) {
        this.#worker = startSorting();
        this.#worker.addEventListener('message', (event: MessageEvent<FromWorker>) => this.#finish(event.data));
        this.#send({ kind: 'centres', centres });
    }

    /** Sorts for a camera. Null if a later call replaced this one before it began. */
    order(pose: Pose, camera: Pinhole): Promise<Sorted | null> {
        return new Promise((done) => {
            this.#next?.done(null);
            this.#next = { pose, camera, done };
            this.#start();
        });
    }

    /** Gives an order back, so that its memory is used again. */
    giveBack(order: Uint32Array): void {
        this.#spare = order;
    }

    destroy(): void {
        this.#worker.terminate();
        this.#next?.done(null);
        this.#running?.done(null);
    }

    #start(): void {
        if (this.#running !== null || this.#next === null) {
            return;
        }
        this.#running = this.#next;
        this.#next = null;
        const { pose, camera } = this.#running;
        const { rotation, translation } = worldToCamera(pose);
        const row = (i: 0 | 1 | 2) => [...rotation[i], translation[i]] as const;
        const { width, height, fx, fy, cx, cy } = camera;
        const order = this.#spare;
        this.#spare = null;
        this.#number += 1;
        this.#send(
            {
                kind: 'sort',
                number: this.#number,
                rows: [row(0), row(1), row(2)],
                ratios: [-cx / fx, -cy / fy, (width - cx) / fx, (height - cy) / fy],
                order,
            },
            order === null ? [] : [order.buffer as ArrayBuffer],
        );
    }

    #send(message: ToWorker, transfer: Transferable[] = []): void {
        this.#worker.postMessage(message, transfer);
    }

    #finish(result: FromWorker): void {
        const running = this.#running;
        this.#running = null;
        this.lastMilliseconds = result.milliseconds;
        running?.done(result);
        this.#start();
    }
}
