// Sending a dataset, to a service in memory that loses connections, pieces and blobs.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { create } from '@bufbuild/protobuf';
import { Code, ConnectError, createClient, createRouterTransport } from '@connectrpc/connect';

import { faultOf } from '../../src/pages/faults.ts';
import { digestOfBytes } from '../../src/pages/upload/digest.ts';
import {
    type HashedFile,
    PIECE_BYTES,
    type SendOptions,
    type SendProgress,
    Speed,
    listText,
    sendDataset,
} from '../../src/pages/upload/send.ts';
import { DatasetState, type DatasetFile, UploadService } from '../../src/rpc/fathom/v1/upload_pb.ts';
import { ErrorInfoSchema } from '../../src/rpc/google/rpc/error_details_pb.ts';

const refused = (code: Code, reason: string, metadata: Record<string, string> = {}): ConnectError =>
    new ConnectError(reason, code, undefined, [
        { desc: ErrorInfoSchema, value: create(ErrorInfoSchema, { reason, domain: 'fathom', metadata }) },
    ]);

/** The rules of upload.proto, as far as they matter here. */
class Store {
    readonly blobs = new Map<string, Uint8Array>();
    readonly parts = new Map<string, Uint8Array>();
    readonly calls: string[] = [];
    /** Called before a call is answered; it may throw. */
    before: (call: string, count: number) => void = () => {};
    /** Called after a piece was kept, before the answer. */
    afterPiece: (count: number) => void = () => {};
    /** At most so many in the answer of BeginUpload. */
    mostMissing = 10_000;
    files: readonly DatasetFile[] = [];
    requestIds = new Set<string>();
    isCommitted = false;

    #note(call: string): void {
        this.calls.push(call);
        this.before(call, this.count(call));
    }

    count(call: string): number {
        return this.calls.filter((one) => one === call).length;
    }

    #missing(refs: readonly { readonly digest: string; readonly sizeBytes: bigint }[]) {
        return [...new Map(refs.map((ref) => [ref.digest, ref])).values()].filter(
            ({ digest }) => !this.blobs.has(digest),
        );
    }

    readonly client = createClient(
        UploadService,
        createRouterTransport(({ service }) => {
            service(UploadService, {
                beginUpload: (request) => {
                    this.#note('begin');
                    this.requestIds.add(request.requestId);
                    this.files = request.files;
                    if (request.list !== undefined) {
                        const lines = Buffer.from(this.blobs.get(request.list.digest) ?? [])
                            .toString()
                            .split('\n')
                            .slice(0, -1);
                        this.files = lines.map((line) => {
                            const [digest = '', bytes = '', path = ''] = line.split(' ');
                            return { path, blob: { digest, sizeBytes: BigInt(bytes) } } as DatasetFile;
                        });
                    }
                    const missing = this.#missing(this.files.map(({ blob }) => blob!));
                    const state = this.isCommitted ? DatasetState.COMMITTED : DatasetState.UPLOADING;
                    return {
                        dataset: { datasetId: request.datasetId, state },
                        missing: missing.slice(0, this.mostMissing),
                        missingCount: BigInt(missing.length),
                    };
                },
                findMissingBlobs: ({ blobs }) => {
                    this.#note('find');
                    return { missing: this.#missing(blobs) };
                },
                queryBlob: ({ blob }) => {
                    this.#note('query');
                    const { digest, sizeBytes } = blob!;
                    const complete = this.blobs.has(digest);
                    return {
                        complete,
                        committedSizeBytes: complete
                            ? sizeBytes
                            : BigInt(this.parts.get(digest)?.length ?? 0),
                    };
                },
                writeChunk: ({ blob, offsetBytes, data, finish }) => {
                    this.#note('write');
                    const { digest, sizeBytes } = blob!;
                    if (this.blobs.has(digest)) {
                        return { complete: true, committedSizeBytes: sizeBytes };
                    }
                    const part = this.parts.get(digest) ?? new Uint8Array();
                    assert.ok(data.length <= 1024 * 1024);
                    if (Number(offsetBytes) !== part.length) {
                        throw refused(Code.OutOfRange, 'WRONG_OFFSET', {
                            committed_size_bytes: String(part.length),
                        });
                    }
                    const whole = Buffer.concat([part, data]);
                    this.parts.set(digest, whole);
                    this.afterPiece(this.count('write'));
                    if (!finish) {
                        return { complete: false, committedSizeBytes: BigInt(whole.length) };
                    }
                    this.parts.delete(digest);
                    if (whole.length !== Number(sizeBytes) || digestOfBytes(whole) !== digest) {
                        throw refused(Code.DataLoss, 'DIGEST_MISMATCH');
                    }
                    this.blobs.set(digest, whole);
                    return { complete: true, committedSizeBytes: sizeBytes };
                },
                commitDataset: ({ datasetId }) => {
                    this.#note('commit');
                    if (this.files.some(({ blob }) => !this.blobs.has(blob!.digest))) {
                        throw refused(Code.FailedPrecondition, 'BLOB_NOT_FOUND');
                    }
                    this.isCommitted = true;
                    return { datasetId, state: DatasetState.COMMITTED, files: BigInt(this.files.length) };
                },
            });
        }),
    );
}

const hashed = (path: string, bytes: Uint8Array<ArrayBuffer> | string): HashedFile => {
    const content = typeof bytes === 'string' ? new TextEncoder().encode(bytes) : bytes;
    return { path, digest: digestOfBytes(content), file: new Blob([content]) };
};
const LARGE = hashed(
    'large',
    Uint8Array.from({ length: 2 * PIECE_BYTES + 5 }, (_, at) => at * 7),
);
const FILES = [hashed('b', 'bbb'), hashed('a', 'a'), hashed('copy of b', 'bbb'), hashed('empty', ''), LARGE];
const BYTES = 4 + LARGE.file.size;

const sending = (store: Store, change: Partial<SendOptions> = {}, files: readonly HashedFile[] = FILES) => {
    const seen: SendProgress[] = [];
    let waits = 0;
    const options: SendOptions = {
        calls: store.client,
        signal: AbortSignal.timeout(20_000),
        onProgress: (progress) => seen.push(progress),
        isOnline: () => true,
        wait: async () => {
            waits += 1;
        },
        nowMs: () => 0,
        ...change,
    };
    const done = sendDataset({ datasetId: 'reef', requestId: 'r', files }, options);
    return { done, seen, waits: () => waits };
};

test('each content is sent once, in pieces, and the dataset is committed', async () => {
    const store = new Store();
    const { done, seen } = sending(store);
    const dataset = await done;
    assert.deepEqual([dataset.datasetId, dataset.files], ['reef', 5n]);
    assert.equal(store.blobs.size, 4);
    assert.deepEqual([store.count('write'), store.count('query'), store.count('begin')], [6, 1, 1]);
    const sent = seen.filter(({ step }) => step === 'send');
    assert.deepEqual(
        [sent[0]!.bytes, sent[0]!.totalBytes, sent[0]!.missing, sent.at(-1)!.bytes],
        [0, BYTES, 4, BYTES],
    );
    assert.equal(seen.at(-1)!.step, 'commit');
});

test('the same files again send nothing', async () => {
    const store = new Store();
    await sending(store).done;
    await sending(store).done;
    assert.deepEqual([store.count('write'), store.count('commit')], [6, 1]);
    store.isCommitted = false;
    await sending(store).done;
    assert.deepEqual([store.count('write'), store.count('commit')], [6, 2]);
});

test('a file goes on where it stopped', async () => {
    const store = new Store();
    const stop = new AbortController();
    store.afterPiece = () => {
        if (store.parts.get(LARGE.digest)?.length === PIECE_BYTES) {
            stop.abort();
        }
    };
    await assert.rejects(sending(store, { signal: stop.signal }).done, { name: 'AbortError' });
    assert.equal(store.parts.get(LARGE.digest)?.length, PIECE_BYTES);
    store.afterPiece = () => {};
    const { done, seen } = sending(store);
    await done;
    assert.equal(seen.at(-1)!.bytes, seen.at(-1)!.totalBytes);
    assert.deepEqual(
        Buffer.from(store.blobs.get(LARGE.digest)!),
        Buffer.from(await LARGE.file.arrayBuffer()),
    );
});

test('a lost connection is waited for, with every call', async () => {
    const store = new Store();
    store.before = (_, count) => {
        if (count === 1) {
            throw new ConnectError('gone', Code.Unavailable);
        }
    };
    // The answer of a piece is lost: it has arrived all the same.
    store.afterPiece = (count) => {
        if (count === 3) {
            throw new ConnectError('gone', Code.Unknown);
        }
    };
    const { done, seen, waits } = sending(store);
    await done;
    assert.equal(store.blobs.size, 4);
    assert.ok(waits() >= 5);
    assert.ok(seen.some(({ waiting }) => waiting === 'lost'));
    assert.equal(seen.at(-1)!.waiting, '');
    assert.deepEqual([...store.requestIds], ['r']);
});

test('another writer, and a busy service, are waited for', async () => {
    const store = new Store();
    store.before = (call, count) => {
        if (call === 'write' && count <= 4) {
            throw count % 2 === 0
                ? refused(Code.Aborted, 'WRITE_IN_PROGRESS')
                : refused(Code.ResourceExhausted, 'RATE_LIMITED');
        }
    };
    const { done, waits } = sending(store);
    await done;
    assert.deepEqual([store.blobs.size, waits()], [4, 4]);
});

test('another offset is taken from the error', async () => {
    const store = new Store();
    store.parts.set(FILES[0]!.digest, new TextEncoder().encode('bb'));
    await sending(store).done;
    assert.equal(Buffer.from(store.blobs.get(FILES[0]!.digest)!).toString(), 'bbb');
});

test('an offset that never fits ends the upload', async () => {
    const store = new Store();
    store.before = (call) => {
        if (call === 'write') {
            throw refused(Code.OutOfRange, 'WRONG_OFFSET', { committed_size_bytes: '0' });
        }
    };
    await assert.rejects(sending(store, {}, [FILES[0]!]).done, /does not get on/);
});

test('while the browser is offline the upload waits without an end', async () => {
    const store = new Store();
    let [isOnline, nowMs] = [false, 0];
    store.before = () => {
        nowMs += 400_000;
        if (nowMs > 4_000_000) {
            isOnline = true;
        } else {
            throw new ConnectError('gone', Code.Unavailable);
        }
    };
    const { done, seen } = sending(store, { isOnline: () => isOnline, nowMs: () => nowMs }, [FILES[0]!]);
    await done;
    assert.ok(seen.some(({ waiting }) => waiting === 'offline'));
});

test('after ten minutes without an answer the upload stops', async () => {
    const store = new Store();
    let nowMs = 0;
    store.before = () => {
        nowMs += 61_000;
        throw new ConnectError('gone', Code.Unavailable);
    };
    await assert.rejects(sending(store, { nowMs: () => nowMs }).done, { name: 'Fault', kind: 'lost' });
    assert.equal(store.calls.length, 10);
});

test('a refusal ends the upload with its reason', async () => {
    for (const reason of ['QUOTA_SPENT', 'LOW_DISK_SPACE']) {
        const store = new Store();
        store.before = (call) => {
            if (call === 'write') {
                throw refused(Code.ResourceExhausted, reason);
            }
        };
        const error: unknown = await sending(store).done.then(
            () => null,
            (thrown: unknown) => thrown,
        );
        assert.equal(faultOf(error).reason, reason);
        const { length } = store.calls;
        await new Promise((done) => setTimeout(done, 20));
        assert.equal(store.calls.length, length, 'nothing goes on');
    }
});

test('a file that changed is named', async () => {
    const other = { ...FILES[0]!, file: new Blob(['xyz']) };
    await assert.rejects(
        sending(new Store(), {}, [other]).done,
        /^Fault: "b" cannot be read: it was changed/,
    );
    const gone = {
        size: 3,
        slice: () => ({ arrayBuffer: () => Promise.reject(new DOMException('gone', 'NotReadableError')) }),
    };
    await assert.rejects(sending(new Store(), {}, [{ ...FILES[0]!, file: gone as unknown as Blob }]).done, {
        reason: 'FILE_CHANGED',
    });
});

test('many files go as a list, and their blobs are asked for in parts', async () => {
    const store = new Store();
    store.mostMissing = 3;
    const many = Array.from({ length: 10_001 }, (_, at) => hashed(`images/${String(at)}.jpg`, `${at % 7}`));
    const dataset = await sending(store, {}, many).done;
    assert.equal(dataset.files, 10_001n);
    assert.deepEqual([store.count('find'), store.count('write'), store.blobs.size], [1, 8, 8]);
    const text = listText(many);
    assert.ok(store.blobs.has(digestOfBytes(new TextEncoder().encode(text))));
    assert.match(text, /^[\da-f]{64} 1 images\/0\.jpg\n[\da-f]{64} 1 images\/1\.jpg\n/);
    // Long paths make a long message of fewer files.
    const long = new Store();
    await sending(
        long,
        {},
        Array.from({ length: 1200 }, (_, at) => hashed(`${'x'.repeat(1000)}${at}`, 'y')),
    ).done;
    assert.deepEqual([long.files.length, long.blobs.size], [1200, 2]);
});

test('blobs that are deleted meanwhile are sent again', async () => {
    const store = new Store();
    store.before = (call, count) => {
        if (call === 'commit' && count === 1) {
            store.blobs.delete(FILES[0]!.digest);
        }
    };
    await sending(store).done;
    assert.deepEqual([store.count('commit'), store.count('begin'), store.count('write')], [2, 2, 7]);
});

test('the speed is that of the latest seconds', () => {
    const speed = new Speed(10_000);
    assert.equal(speed.bytesPerSecond, 0);
    speed.add(0, 0);
    speed.add(100, 1000);
    assert.equal(speed.bytesPerSecond, 0, 'too early');
    speed.add(1000, 5000);
    assert.equal(speed.bytesPerSecond, 5000);
    for (let second = 2; second <= 30; second += 1) {
        speed.add(second * 1000, 5000 + second);
    }
    assert.ok(speed.bytesPerSecond < 2);
});
