// Digests of many files, by several workers.

import { Fault } from '../faults.ts';
import type { FolderFile } from './folder.ts';
import type { FromHashing } from './hash-worker.ts';

/** More of them would wait for the disk. */
const MOST_WORKERS = 4;

/** Computes one digest at a time. */
export interface Hashing {
    /** Rejects when the file cannot be read. */
    hash(file: Blob, onBytes: (more: number) => void): Promise<string>;
    end(): void;
}

function startWorker(): Hashing {
    const worker = new Worker(new URL('hash-worker.ts', import.meta.url), { type: 'module' });
    return {
        hash: (file, onBytes) =>
            new Promise((done, failed) => {
                const listening = new AbortController();
                const { signal } = listening;
                const end = (settle: () => void): void => {
                    listening.abort();
                    settle();
                };
                worker.addEventListener(
                    'message',
                    ({ data }: MessageEvent<FromHashing>) => {
                        if ('bytes' in data) {
                            onBytes(data.bytes);
                        } else if ('digest' in data) {
                            end(() => done(data.digest));
                        } else {
                            end(() => failed(new DOMException(data.text, data.error)));
                        }
                    },
                    { signal },
                );
                worker.addEventListener('error', ({ message }) => end(() => failed(new Error(message))), {
                    signal,
                });
                worker.postMessage(file, []);
            }),
        end: () => worker.terminate(),
    };
}

/** A file that is not any more what it was when the folder was chosen. */
export const changedFile = (path: string, cause: unknown): Fault =>
    new Fault(
        'refused',
        'FILE_CHANGED',
        `"${path}" cannot be read: it was changed, moved or deleted after you chose the folder, or you may ` +
            'not read it. Choose the folder again; what has arrived is not sent again.',
        cause,
    );

export interface HashOptions {
    readonly signal: AbortSignal;
    readonly onBytes: (more: number) => void;
    /** How many at a time. */
    readonly workers?: number;
    readonly start?: () => Hashing;
}

/** As many as the machine has cores besides the one for the page. */
export const workersFor = (cores: number): number => Math.min(MOST_WORKERS, Math.max(1, cores - 1));

/** Puts the digest of each file into `known`, unless it is there. */
export async function hashFiles(
    files: readonly FolderFile[],
    known: Map<Blob, string>,
    options: HashOptions,
): Promise<void> {
    const queue = files.filter(({ file }) => !known.has(file)).toReversed();
    const { signal, onBytes, start = startWorker } = options;
    const count = Math.min(queue.length, options.workers ?? workersFor(navigator.hardwareConcurrency));
    signal.throwIfAborted();
    const workers = Array.from({ length: count }, start);
    const work = async (worker: Hashing): Promise<void> => {
        for (let next = queue.pop(); next !== undefined; next = queue.pop()) {
            const { path, file } = next;
            const fault = (error: unknown): never => {
                throw error instanceof DOMException ? changedFile(path, error) : error;
            };
            known.set(file, await worker.hash(file, onBytes).catch(fault));
        }
    };
    const listening = new AbortController();
    const ended = new Promise<never>((_, failed) => {
        const end = (): void => failed(new DOMException('ended', 'AbortError'));
        signal.addEventListener('abort', end, { signal: listening.signal });
    });
    try {
        await Promise.race([Promise.all(workers.map(work)), ended]);
    } finally {
        listening.abort();
        // Nothing more is taken by those that still work.
        queue.length = 0;
        workers.forEach((worker) => worker.end());
    }
}
