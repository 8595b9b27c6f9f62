// A made-up service for the tests: a small server that speaks gRPC-Web and tells of one job, as a test says.

import { createServer } from 'node:http';
import type { AddressInfo } from 'node:net';

import { type DescMessage, type MessageInitShape, create, fromBinary, toBinary } from '@bufbuild/protobuf';

import { CallerSchema, ListWorkersResponseSchema, Role } from '../../src/rpc/fathom/admin/v1/admin_pb.ts';
import {
    HistorySchema,
    JobEventSchema,
    JobSchema,
    ListArtifactsResponseSchema,
    ListJobsResponseSchema,
} from '../../src/rpc/fathom/v1/job_pb.ts';
import { ReadBlobRequestSchema, ReadBlobResponseSchema } from '../../src/rpc/fathom/v1/upload_pb.ts';
import { serveWith } from './service.ts';

/** What the service tells of its job. Tests change it while a page is open. */
export interface Told {
    job: MessageInitShape<typeof JobSchema>;
    /** The list of jobs, where it is not that job alone. */
    jobs?: MessageInitShape<typeof JobSchema>[];
    history: MessageInitShape<typeof HistorySchema>;
    events: MessageInitShape<typeof JobEventSchema>[];
    /** By digest. */
    readonly blobs: Map<string, Buffer>;
    /** Files of the job, by path. */
    readonly files: Map<string, Buffer>;
    /** The role of who uses the page; a viewer unless it is given. */
    role?: Role;
    workers?: MessageInitShape<typeof ListWorkersResponseSchema>['workers'];
    /** What `api/v1/enter` takes once, for the token "session". Once it is given, calls need that token. */
    invitation?: string;
    /** Sizes of files that the service states in place of their true ones, by path. */
    readonly sizes: Map<string, number>;
    /** Paths of files that it lists and does not give. */
    readonly refused: Set<string>;
}

export interface MadeUp {
    readonly address: string;
    readonly told: Told;
    /** Digests of the blobs that were read, in order. */
    readonly read: string[];
    /** Paths of the files that were asked for, in order. */
    readonly asked: string[];
    /** Names of the calls, in order. */
    readonly calls: string[];
    /** How many streams of events are open. */
    streams(): number;
    close(): void;
}

const NOT_FOUND = 5;
const UNAUTHENTICATED = 16;

function framed<D extends DescMessage>(schema: D, content: MessageInitShape<D>): Buffer {
    const body = toBinary(schema, create(schema, content));
    const head = Buffer.alloc(5);
    head.writeUInt32BE(body.length, 1);
    return Buffer.concat([head, body]);
}

function trailer(status: number): Buffer {
    const text = Buffer.from(`grpc-status:${status}\r\n`);
    const head = Buffer.alloc(5);
    head.writeUInt8(0x80, 0);
    head.writeUInt32BE(text.length, 1);
    return Buffer.concat([head, text]);
}

/** Serves the built pages before a made-up service. */
export async function serveMadeUp(dist: string): Promise<MadeUp> {
    const told: Told = {
        job: {},
        history: {},
        events: [],
        blobs: new Map(),
        files: new Map(),
        sizes: new Map(),
        refused: new Set(),
    };
    const read: string[] = [];
    const askedFor: string[] = [];
    const calls: string[] = [];
    let streams = 0;
    const answers: Readonly<Record<string, (asked: Buffer) => readonly Buffer[] | null>> = {
        GetCaller: () => [
            framed(CallerSchema, { name: 'ada', role: told.role ?? Role.VIEWER, tokensRequired: true }),
        ],
        ListWorkers: () => [framed(ListWorkersResponseSchema, { workers: told.workers ?? [] })],
        ListJobs: () => [framed(ListJobsResponseSchema, { jobs: told.jobs ?? [told.job] })],
        GetJob: () => [framed(JobSchema, told.job)],
        GetHistory: () => [framed(HistorySchema, told.history)],
        WatchJob: () => told.events.map((event) => framed(JobEventSchema, event)),
        ListArtifacts: () => {
            const artifacts = [...told.files].map(([path, content]) => ({
                path,
                blob: { digest: path, sizeBytes: BigInt(told.sizes.get(path) ?? content.length) },
            }));
            return [framed(ListArtifactsResponseSchema, { artifacts })];
        },
        ReadBlob: (asked) => {
            const { digest } = fromBinary(ReadBlobRequestSchema, asked.subarray(5));
            read.push(digest);
            const data = told.blobs.get(digest);
            return data === undefined
                ? null
                : [framed(ReadBlobResponseSchema, { sizeBytes: BigInt(data.length), data })];
        },
    };
    const service = createServer((asked, response) => {
        const { pathname } = new URL(asked.url ?? '', 'http://x');
        const { authorization } = asked.headers;
        if (pathname === '/api/v1/enter') {
            const isValid = told.invitation !== undefined && authorization === `Bearer ${told.invitation}`;
            if (isValid) {
                told.invitation = 'another';
            }
            response.writeHead(isValid ? 200 : 401, { 'content-type': 'application/json' });
            response.end(JSON.stringify(isValid ? { token: 'session' } : { error: { reason: 'TOKEN_REFUSED' } }));
            return;
        }
        const file = /^\/api\/v1\/jobs\/[^/]+\/files\/(.*)$/.exec(pathname);
        if (file !== null) {
            const path = decodeURIComponent(file[1] ?? '');
            askedFor.push(path);
            const content = told.refused.has(path) ? undefined : told.files.get(path);
            response.writeHead(content === undefined ? 404 : 200).end(content);
            return;
        }
        const method = pathname.split('/').at(-1) ?? '';
        calls.push(method);
        const pieces: Buffer[] = [];
        asked.on('data', (piece: Buffer) => pieces.push(piece));
        asked.on('end', () => {
            response.writeHead(200, { 'content-type': 'application/grpc-web+proto' });
            if (told.invitation !== undefined && authorization !== 'Bearer session') {
                response.end(trailer(UNAUTHENTICATED));
                return;
            }
            const answer = answers[method]?.(Buffer.concat(pieces)) ?? null;
            response.write(Buffer.concat(answer ?? []));
            if (answer === null) {
                response.end(trailer(NOT_FOUND));
            } else if (method === 'WatchJob') {
                // A stream of events stays open.
                streams += 1;
                response.on('close', () => (streams -= 1));
            } else {
                response.end(trailer(0));
            }
        });
    });
    await new Promise<void>((done) => service.listen(0, '127.0.0.1', done));
    const serving = await serveWith(dist, (service.address() as AddressInfo).port);
    return {
        address: serving.address,
        told,
        read,
        asked: askedFor,
        calls,
        streams: () => streams,
        close: () => {
            serving.close();
            service.closeAllConnections();
            service.close();
        },
    };
}

/** JSON as the content of a file. */
export const json = (value: unknown): Buffer => Buffer.from(JSON.stringify(value));
