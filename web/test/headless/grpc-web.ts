// Answers of a made-up service that speaks gRPC-Web.

import { type DescMessage, type MessageInitShape, create, toBinary } from '@bufbuild/protobuf';

const HEAD_BYTES = 5;
const IS_TRAILER = 0x80;

function withHead(kind: number, body: Uint8Array): Buffer {
    const head = Buffer.alloc(HEAD_BYTES);
    head.writeUInt8(kind, 0);
    head.writeUInt32BE(body.length, 1);
    return Buffer.concat([head, body]);
}

/** A message. */
export const framed = <D extends DescMessage>(schema: D, content: MessageInitShape<D>): Buffer =>
    withHead(0, toBinary(schema, create(schema, content)));

/** The end of an answer that succeeded. */
export const TRAILER = withHead(IS_TRAILER, Buffer.from('grpc-status:0\r\n'));

/** The message of a request with one. */
export const messageOf = (request: Buffer): Buffer => request.subarray(HEAD_BYTES);
