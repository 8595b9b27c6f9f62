// Sends hashed files as a dataset: begin, the blobs that are missing, commit.
//
// Every call may be repeated, and the service keeps what has arrived, so a lost connection costs at most the
// pieces on their way. The service tells how much of a file it has; what was sent says nothing. Errors that
// pass by themselves are waited for as long as anything gets through now and then.

import type { MessageInitShape } from '@bufbuild/protobuf';
import { type Client, ConnectError } from '@connectrpc/connect';

import type { BlobRef } from '../../rpc/fathom/v1/blob_pb.ts';
import {
    type BeginUploadRequestSchema,
    type Dataset,
    DatasetState,
    type UploadService,
} from '../../rpc/fathom/v1/upload_pb.ts';
import { ErrorInfoSchema } from '../../rpc/google/rpc/error_details_pb.ts';
import { pause } from '../api.ts';
import { Backoff } from '../connection.ts';
import { Fault, faultOf } from '../faults.ts';
import { digestOfBytes } from './digest.ts';
import { byUtf8 } from './folder.ts';
import { changedFile } from './hash.ts';

export type UploadCalls = Pick<
    Client<typeof UploadService>,
    'beginUpload' | 'commitDataset' | 'findMissingBlobs' | 'queryBlob' | 'writeChunk'
>;

/** The largest piece of a call (`upload.proto`). */
export const PIECE_BYTES = 1024 * 1024;
/** More files than this go as a list (`upload.proto`), and so does a longer text. */
const FILES_PER_CALL = 10_000;
const LIST_BYTES = 1024 * 1024;
/** Without TLS a browser has six connections to a server; the page needs some of them. */
const AT_ONCE = 3;
/** A piece takes longer over a slow line, and a list of files needs its time. */
const PIECE_WITHIN = { timeoutMs: 120_000 } as const;
const LIST_WITHIN = { timeoutMs: 300_000 } as const;
/** Nothing got through for so long: give up, milliseconds. */
const GIVE_UP_MS = 600_000;
/** Times that the service expects another offset without more that has arrived. */
const MOST_OFFSETS = 16;
/** Blobs may be deleted between two uploads; once is enough, more often something is wrong. */
const MOST_ROUNDS = 3;
/** While the browser is offline, the service is asked again this often: it may be on this machine. */
const OFFLINE_MS = 5000;

export interface HashedFile {
    readonly path: string;
    readonly digest: string;
    readonly file: Blob;
}

export interface Upload {
    readonly datasetId: string;
    /** The same as long as id and files are. */
    readonly requestId: string;
    readonly files: readonly HashedFile[];
}

export interface SendProgress {
    readonly step: 'begin' | 'send' | 'commit';
    /** Of what the service lacked. */
    readonly bytes: number;
    readonly totalBytes: number;
    /** Number of different contents that it lacked. */
    readonly missing: number;
    /** Why nothing moves. */
    readonly waiting: '' | 'lost' | 'offline';
}

export interface SendOptions {
    readonly calls: UploadCalls;
    readonly signal: AbortSignal;
    readonly onProgress: (progress: SendProgress) => void;
    readonly isOnline?: () => boolean;
    readonly wait?: (ms: number, signal: AbortSignal) => Promise<void>;
    readonly nowMs?: () => number;
}

type Blobs = ReadonlyMap<string, HashedFile>;

const refOf = ({ digest, file }: HashedFile): Pick<BlobRef, 'digest' | 'sizeBytes'> => ({
    digest,
    sizeBytes: BigInt(file.size),
});

/** Waits, and no longer than until the browser is online again. */
async function waitOrOnline(ms: number, signal: AbortSignal): Promise<void> {
    const ended = new AbortController();
    const end = (): void => ended.abort();
    window.addEventListener('online', end, { signal: ended.signal });
    try {
        await pause(ms, AbortSignal.any([signal, ended.signal]));
    } catch {
        signal.throwIfAborted();
    } finally {
        end();
    }
}

/** The list of files as a blob, as the comment of the service in `upload.proto` defines it. */
export function listText(files: readonly HashedFile[]): string {
    const sorted = files.toSorted((a, b) => byUtf8(a.path, b.path));
    return sorted.map(({ path, digest, file }) => `${digest} ${file.size} ${path}\n`).join('');
}

/** Sends a dataset, or the rest of one. Resolves when it is committed. */
export function sendDataset(upload: Upload, options: SendOptions): Promise<Dataset> {
    return new Sending(upload, options).run();
}

class Sending {
    readonly #upload: Upload;
    readonly #options: SendOptions;
    readonly #calls: UploadCalls;
    readonly #wait: (ms: number, signal: AbortSignal) => Promise<void>;
    readonly #nowMs: () => number;
    readonly #isOnline: () => boolean;
    /** What has arrived, by digest. */
    readonly #arrived = new Map<string, number>();
    /** Calls that wait for the service. */
    #waiters = 0;
    #throughMs: number;
    #state: SendProgress = { step: 'begin', bytes: 0, totalBytes: 0, missing: 0, waiting: '' };

    constructor(upload: Upload, options: SendOptions) {
        this.#upload = upload;
        this.#options = options;
        this.#calls = options.calls;
        this.#wait = options.wait ?? waitOrOnline;
        this.#nowMs = options.nowMs ?? (() => performance.now());
        this.#isOnline = options.isOnline ?? (() => navigator.onLine);
        this.#throughMs = this.#nowMs();
    }

    async run(): Promise<Dataset> {
        const { signal } = this.#options;
        const blobs: Blobs = new Map(this.#upload.files.map((file) => [file.digest, file]));
        for (let round = 1; ; round += 1) {
            this.#tell({ step: 'begin' });
            const { dataset, missing } = await this.#begin(blobs);
            if (dataset.state === DatasetState.COMMITTED) {
                return dataset;
            }
            await this.#sendAll(missing);
            this.#tell({ step: 'commit' });
            try {
                return await this.#again(signal, () =>
                    this.#calls.commitDataset({ datasetId: dataset.datasetId }, { signal, ...LIST_WITHIN }),
                );
            } catch (error) {
                if (round >= MOST_ROUNDS || faultOf(error).reason !== 'BLOB_NOT_FOUND') {
                    throw error;
                }
            }
        }
    }

    #tell(change: Partial<SendProgress>): void {
        this.#state = { ...this.#state, ...change };
        this.#options.onProgress(this.#state);
    }

    async #begin(
        blobs: Blobs,
    ): Promise<{ readonly dataset: Dataset; readonly missing: readonly HashedFile[] }> {
        const { signal } = this.#options;
        const { files, datasetId, requestId } = this.#upload;
        const text = new Blob([listText(files)]);
        let content: MessageInitShape<typeof BeginUploadRequestSchema>;
        if (files.length > FILES_PER_CALL || text.size > LIST_BYTES) {
            const digest = digestOfBytes(new Uint8Array(await text.arrayBuffer()));
            const list = { path: 'The list of files', digest, file: text };
            await this.#sendAll([list]);
            this.#tell({ step: 'begin' });
            content = { list: refOf(list) };
        } else {
            content = { files: files.map((file) => ({ path: file.path, blob: refOf(file) })) };
        }
        const begun = await this.#again(signal, () =>
            this.#calls.beginUpload({ datasetId, requestId, ...content }, { signal, ...LIST_WITHIN }),
        );
        if (begun.dataset === undefined) {
            throw new Fault('refused', '', 'The service named no dataset. Update the coordinator.');
        }
        const isAll = BigInt(begun.missing.length) === begun.missingCount;
        const missing = isAll ? begun.missing : await this.#find([...blobs.values()]);
        const known = missing.map(({ digest }) => blobs.get(digest)).filter((file) => file !== undefined);
        return { dataset: begun.dataset, missing: known };
    }

    async #find(files: readonly HashedFile[]): Promise<readonly BlobRef[]> {
        const { signal } = this.#options;
        const missing: BlobRef[] = [];
        for (let begin = 0; begin < files.length; begin += FILES_PER_CALL) {
            const blobs = files.slice(begin, begin + FILES_PER_CALL).map(refOf);
            const answer = await this.#again(signal, () =>
                this.#calls.findMissingBlobs({ blobs }, { signal, ...LIST_WITHIN }),
            );
            missing.push(...answer.missing);
        }
        return missing;
    }

    /** Sends some files, several at a time. The first error ends all. */
    async #sendAll(files: readonly HashedFile[]): Promise<void> {
        this.#arrived.clear();
        const totalBytes = files.reduce((sum, { file }) => sum + file.size, 0);
        this.#tell({ step: 'send', bytes: 0, totalBytes, missing: files.length });
        const stop = new AbortController();
        const signal = AbortSignal.any([this.#options.signal, stop.signal]);
        const queue = files.toReversed();
        const work = async (): Promise<void> => {
            for (let next = queue.pop(); next !== undefined; next = queue.pop()) {
                await this.#send(next, signal);
            }
        };
        try {
            await Promise.all(Array.from({ length: AT_ONCE }, work));
        } finally {
            stop.abort();
        }
    }

    #note(digest: string, bytes: number): void {
        const more = bytes - (this.#arrived.get(digest) ?? 0);
        this.#arrived.set(digest, bytes);
        this.#tell({ bytes: this.#state.bytes + more });
    }

    async #send(hashed: HashedFile, signal: AbortSignal): Promise<void> {
        const { digest, file, path } = hashed;
        const blob = refOf(hashed);
        // A short file is sent without a question; if a part of it is there, the answer says so.
        let offset = file.size > PIECE_BYTES ? await this.#query(hashed, signal) : 0;
        let [farthest, offsets, mismatches] = [offset, 0, 0];
        for (;;) {
            const end = Math.min(file.size, offset + PIECE_BYTES);
            const data = await pieceOf(hashed, offset, end);
            // The service checks length and digest with the last piece.
            const piece = { blob, offsetBytes: BigInt(offset), data, finish: end === file.size };
            try {
                const answer = await this.#again(signal, () =>
                    this.#calls.writeChunk(piece, { signal, ...PIECE_WITHIN }),
                );
                if (answer.complete) {
                    this.#note(digest, file.size);
                    return;
                }
                offset = Number(answer.committedSizeBytes);
            } catch (error) {
                const { reason } = faultOf(error);
                if (reason === 'DIGEST_MISMATCH' && mismatches === 0) {
                    // The service has deleted what it had. It may have been another page that sent it.
                    mismatches += 1;
                } else if (reason === 'DIGEST_MISMATCH') {
                    throw changedFile(path, error);
                } else if (reason !== 'WRONG_OFFSET') {
                    throw error;
                }
                offset = committedOf(error) ?? (await this.#query(hashed, signal));
            }
            offset = Math.min(offset, file.size);
            this.#note(digest, offset);
            offsets = offset > farthest ? 0 : offsets + 1;
            farthest = Math.max(farthest, offset);
            if (offsets > MOST_OFFSETS) {
                throw new Fault(
                    'refused',
                    '',
                    `"${path}" does not get on: another page may be sending it. Try again later.`,
                );
            }
        }
    }

    async #query(hashed: HashedFile, signal: AbortSignal): Promise<number> {
        const answer = await this.#again(signal, () =>
            this.#calls.queryBlob({ blob: refOf(hashed) }, { signal }),
        );
        const arrived = Number(answer.committedSizeBytes);
        this.#note(hashed.digest, arrived);
        return arrived;
    }

    /** Makes a call until the service answers it. */
    async #again<T>(signal: AbortSignal, call: () => Promise<T>): Promise<T> {
        const backoff = new Backoff();
        let isWaiting = false;
        try {
            for (;;) {
                try {
                    const answer = await call();
                    this.#throughMs = this.#nowMs();
                    return answer;
                } catch (error) {
                    signal.throwIfAborted();
                    const fault = faultOf(error);
                    if (!passes(fault)) {
                        throw error;
                    }
                    const isOnline = this.#isOnline();
                    if (!isOnline) {
                        // That time does not count.
                        this.#throughMs = this.#nowMs();
                    } else if (this.#nowMs() - this.#throughMs > GIVE_UP_MS) {
                        throw fault;
                    }
                    // A busy service answers.
                    if (fault.kind === 'lost' || fault.kind === 'ended') {
                        this.#waiters += isWaiting ? 0 : 1;
                        isWaiting = true;
                        this.#tell({ waiting: isOnline ? 'lost' : 'offline' });
                    }
                    await this.#wait(isOnline ? backoff.next() : OFFLINE_MS, signal);
                }
            }
        } finally {
            if (isWaiting) {
                this.#waiters -= 1;
                this.#tell(this.#waiters === 0 ? { waiting: '' } : {});
            }
        }
    }
}

/** Whether an error passes by itself. Either end cancels a call that takes too long. */
const passes = ({ kind, reason }: Fault): boolean =>
    kind === 'lost' || kind === 'ended' || reason === 'WRITE_IN_PROGRESS' || reason === 'RATE_LIMITED';

/** How much the service has, if the error says so. */
function committedOf(error: unknown): number | null {
    const info = error instanceof ConnectError ? error.findDetails(ErrorInfoSchema)[0] : undefined;
    const committed = Number(info?.metadata['committed_size_bytes'] ?? Number.NaN);
    return Number.isSafeInteger(committed) ? committed : null;
}

async function pieceOf(
    { path, file }: HashedFile,
    begin: number,
    end: number,
): Promise<Uint8Array<ArrayBuffer>> {
    try {
        const data = new Uint8Array(await file.slice(begin, end).arrayBuffer());
        if (data.length !== end - begin) {
            throw new DOMException(
                `has ${begin + data.length} bytes instead of ${file.size}`,
                'NotReadableError',
            );
        }
        return data;
    } catch (error) {
        throw changedFile(path, error);
    }
}

/** How fast something goes, by what happened in the latest seconds. */
export class Speed {
    readonly #points: (readonly [ms: number, bytes: number])[] = [];
    readonly #windowMs: number;

    constructor(windowMs = 10_000) {
        this.#windowMs = windowMs;
    }

    add(nowMs: number, bytes: number): void {
        this.#points.push([nowMs, bytes]);
        while (this.#points.length > 2 && this.#points[1]![0] < nowMs - this.#windowMs) {
            this.#points.shift();
        }
    }

    /** Bytes a second; 0 while it is not known. */
    get bytesPerSecond(): number {
        const [first, last] = [this.#points[0], this.#points.at(-1)];
        const ms = first === undefined ? 0 : last![0] - first[0];
        return ms < 500 ? 0 : Math.max(0, ((last![1] - first![1]) / ms) * 1000);
    }
}
