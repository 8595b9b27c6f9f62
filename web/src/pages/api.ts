// Calls to the service: gRPC-Web with generated clients, and the JSON interface for files.

import { type Client, type Interceptor, createClient } from '@connectrpc/connect';
import { createGrpcWebTransport } from '@connectrpc/connect-web';

import { AdminService } from '../rpc/fathom/admin/v1/admin_pb.ts';
import { JobService } from '../rpc/fathom/v1/job_pb.ts';
import { UploadService } from '../rpc/fathom/v1/upload_pb.ts';
import type { Connection } from './connection.ts';
import { Fault, faultOf, faultOfResponse } from './faults.ts';

/** A call without an answer for this long has failed. */
const CALL_WITHIN_MS = 20_000;
/** For calls that stream: they have no end. */
export const NO_LIMIT = { timeoutMs: 0 } as const;
/** Attempts at a file whose connection breaks without any progress, before the page gives up. */
const ATTEMPTS = 5;
const PAUSE_MS = 1000;
/** Pieces are joined to blobs of this size, which the browser may keep on its disk. */
const JOINED_BYTES = 16 << 20;

export interface Identity {
    token(): string | null;
    /** The service does not accept the token any more. */
    refused(): void;
}

export type OnProgress = (done: number, total: number) => void;

export class Api {
    readonly jobs: Client<typeof JobService>;
    readonly uploads: Client<typeof UploadService>;
    readonly admin: Client<typeof AdminService>;
    readonly #base: string;
    readonly #identity: Identity;
    readonly #connection: Connection;

    /** `base` is the folder of the page, whose address ends with `/`. */
    constructor(base: string, identity: Identity, connection: Connection) {
        this.#base = base;
        this.#identity = identity;
        this.#connection = connection;
        // The error itself goes on: a caller makes a fault of it.
        const noted: Interceptor = (next) => async (request) => {
            const token = identity.token();
            if (token !== null) {
                request.header.set('authorization', `Bearer ${token}`);
            }
            try {
                const response = await next(request);
                connection.answered();
                return response;
            } catch (error) {
                this.#noted(error, token);
                throw error;
            }
        };
        const transport = createGrpcWebTransport({
            baseUrl: base.replace(/\/$/, ''),
            useBinaryFormat: true,
            defaultTimeoutMs: CALL_WITHIN_MS,
            interceptors: [noted],
        });
        this.jobs = createClient(JobService, transport);
        this.uploads = createClient(UploadService, transport);
        this.admin = createClient(AdminService, transport);
    }

    /** Notes what an error says about the connection and the token. Streams call it when they break. */
    noted(error: unknown): Fault {
        return this.#noted(error, this.#identity.token());
    }

    #noted(error: unknown, token: string | null): Fault {
        const fault = faultOf(error);
        if (fault.kind === 'lost') {
            this.#connection.lost();
        } else if (fault.kind !== 'ended') {
            this.#connection.answered();
        }
        // A call that was made with an earlier token says nothing about this one.
        if (fault.kind === 'token' && token !== null && token === this.#identity.token()) {
            this.#identity.refused();
        }
        return fault;
    }

    /** A request to the JSON interface. Rejects with a `Fault` unless it succeeds. */
    async fetch(path: string, init: RequestInit = {}): Promise<Response> {
        const token = this.#identity.token();
        const headers = new Headers(init.headers);
        if (token !== null) {
            headers.set('authorization', `Bearer ${token}`);
        }
        try {
            const response = await fetch(new URL(`api/v1/${path}`, this.#base), { ...init, headers, cache: 'no-store' });
            if (!response.ok) {
                throw await faultOfResponse(response);
            }
            this.#connection.answered();
            return response;
        } catch (error) {
            throw this.#noted(error, token);
        }
    }

    /** Exchanges an invitation, which is valid once, for the token of a session. */
    async enter(invitation: string): Promise<string> {
        try {
            const response = await fetch(new URL('api/v1/enter', this.#base), {
                method: 'POST',
                headers: { authorization: `Bearer ${invitation}` },
                cache: 'no-store',
            });
            if (!response.ok) {
                throw await faultOfResponse(response);
            }
            const { token } = (await response.json()) as { readonly token?: unknown };
            if (typeof token !== 'string' || token === '') {
                throw new Fault('refused', '', 'The service gives no token for this link.');
            }
            this.#connection.answered();
            return token;
        } catch (error) {
            // Its refusal says nothing about the token of the session.
            throw this.#noted(error, null);
        }
    }

    /** The content of a blob, as a job may read it. Rejects if it has more than `most` bytes. */
    async blob(digest: string, jobId: string, signal: AbortSignal, type = 'application/octet-stream', most = Infinity): Promise<Blob> {
        try {
            const pieces: Uint8Array<ArrayBuffer>[] = [];
            let bytes = 0;
            for await (const piece of this.uploads.readBlob({ digest, jobId }, { signal, ...NO_LIMIT })) {
                pieces.push(piece.data as Uint8Array<ArrayBuffer>);
                bytes += piece.data.length;
                if (bytes > most) {
                    throw new Fault('refused', 'TOO_LARGE', `The file ${digest} is larger than it can be.`);
                }
            }
            return new Blob(pieces, { type });
        } catch (error) {
            throw this.noted(error);
        }
    }

    /** The content of a blob as JSON. */
    async json(digest: string, jobId: string, signal: AbortSignal): Promise<unknown> {
        const blob = await this.blob(digest, jobId, signal);
        return JSON.parse(await blob.text()) as unknown;
    }

    /** A file of a job, with progress. A broken download continues where it broke. */
    async file(jobId: string, path: string, signal: AbortSignal, onProgress: OnProgress = () => {}): Promise<Blob> {
        const joined: Blob[] = [];
        let [pieces, held, done, total, type]: [Uint8Array<ArrayBuffer>[], number, number, number, string] = [[], 0, 0, 0, ''];
        for (let attempt = 0; ; attempt += 1) {
            const begun = done;
            try {
                const headers: HeadersInit = done > 0 ? { range: `bytes=${done}-` } : {};
                const response = await this.fetch(filePath(jobId, path), { headers, signal });
                type = response.headers.get('content-type') ?? '';
                total = done + Number(response.headers.get('content-length') ?? 0);
                const reader = response.body?.getReader();
                for (let read = await reader?.read(); read !== undefined && !read.done; read = await reader?.read()) {
                    pieces.push(read.value);
                    held += read.value.length;
                    done += read.value.length;
                    if (held >= JOINED_BYTES) {
                        joined.push(new Blob(pieces));
                        [pieces, held] = [[], 0];
                    }
                    onProgress(done, total);
                }
                return new Blob([...joined, ...pieces], { type });
            } catch (error) {
                const fault = this.noted(error);
                if (done > begun) {
                    attempt = 0;
                }
                if (fault.kind !== 'lost' || attempt + 1 >= ATTEMPTS) {
                    throw fault;
                }
                await pause(PAUSE_MS * (attempt + 1), signal);
            }
        }
    }
}

/** The path of a file of a job below `api/v1/`. */
export const filePath = (jobId: string, path: string): string =>
    `jobs/${encodeURIComponent(jobId)}/files/${path.split('/').map(encodeURIComponent).join('/')}`;

/** Waits; rejects when the signal ends it. */
export function pause(ms: number, signal: AbortSignal): Promise<void> {
    return new Promise((resolve, reject) => {
        const stop = (): void => {
            clearTimeout(timer);
            reject(new DOMException('ended', 'AbortError'));
        };
        const timer = setTimeout(() => {
            signal.removeEventListener('abort', stop);
            resolve();
        }, ms);
        if (signal.aborted) {
            stop();
        } else {
            signal.addEventListener('abort', stop, { once: true });
        }
    });
}
