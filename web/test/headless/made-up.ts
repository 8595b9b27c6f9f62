// A made-up service for the tests: a small server that speaks gRPC-Web and tells of one job, as a test says.

import { createServer } from 'node:http';
import type { AddressInfo } from 'node:net';

import { type DescMessage, type MessageInitShape, create, fromBinary, toBinary } from '@bufbuild/protobuf';

import { CallerSchema, Role } from '../../src/rpc/fathom/admin/v1/admin_pb.ts';
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
    history: MessageInitShape<typeof HistorySchema>;
    events: MessageInitShape<typeof JobEventSchema>[];
    /** By digest. */
    readonly blobs: Map<string, Buffer>;
    /** Files of the job, by path. */
    readonly files: Map<string, Buffer>;
}

export interface MadeUp {
    readonly address: string;
    readonly told: Told;
    /** Digests of the blobs that were read, in order. */
    readonly read: string[];
    close(): void;
}

const NOT_FOUND = 5;

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
    const told: Told = { job: {}, history: {}, events: [], blobs: new Map(), files: new Map() };
    const read: string[] = [];
    const answers: Readonly<Record<string, (asked: Buffer) => readonly Buffer[] | null>> = {
        GetCaller: () => [framed(CallerSchema, { name: 'ada', role: Role.VIEWER, tokensRequired: true })],
        ListJobs: () => [framed(ListJobsResponseSchema, { jobs: [told.job] })],
        GetJob: () => [framed(JobSchema, told.job)],
        GetHistory: () => [framed(HistorySchema, told.history)],
        WatchJob: () => told.events.map((event) => framed(JobEventSchema, event)),
        ListArtifacts: () => {
            const artifacts = [...told.files].map(([path, content]) => ({
                path,
                blob: { digest: path, sizeBytes: BigInt(content.length) },
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
        const file = /^\/api\/v1\/jobs\/[^/]+\/files\/(.*)$/.exec(pathname);
        if (file !== null) {
            const content = told.files.get(decodeURIComponent(file[1] ?? ''));
            response.writeHead(content === undefined ? 404 : 200).end(content);
            return;
        }
        const method = pathname.split('/').at(-1) ?? '';
        const pieces: Buffer[] = [];
        asked.on('data', (piece: Buffer) => pieces.push(piece));
        asked.on('end', () => {
            const answer = answers[method]?.(Buffer.concat(pieces)) ?? null;
            response.writeHead(200, { 'content-type': 'application/grpc-web+proto' });
            response.write(Buffer.concat(answer ?? []));
            if (answer === null) {
                response.end(trailer(NOT_FOUND));
            } else if (method !== 'WatchJob') {
                // A stream of events stays open.
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
        close: () => {
            serving.close();
            service.closeAllConnections();
            service.close();
        },
    };
}

/** JSON as the content of a file. */
export const json = (value: unknown): Buffer => Buffer.from(JSON.stringify(value));
