// A small server for the tests: the compressed build, and below /scene/ the files of a scene, with the strict
// policy that a dashboard should send.

import { existsSync, readFileSync, statSync } from 'node:fs';
import { type Server, createServer } from 'node:http';
import type { AddressInfo } from 'node:net';
import { extname, join, normalize } from 'node:path';

export const POLICY =
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; " +
    "worker-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

const TYPES: Readonly<Record<string, string>> = {
    '.html': 'text/html; charset=utf-8',
    '.js': 'text/javascript; charset=utf-8',
    '.css': 'text/css; charset=utf-8',
    '.json': 'application/json',
    '.png': 'image/png',
    '.jpg': 'image/jpeg',
    '.ply': 'application/octet-stream',
};

export interface Serving {
    readonly address: string;
    close(): void;
}

/**
 * Serves `dist` at every folder `/NAME/`, with the files that `filesOf(NAME)` gives beside the page: contents,
 * or the path of a file.
 */
export async function serve(
    dist: string,
    filesOf: (scene: string) => Readonly<Record<string, string | Buffer>>,
): Promise<Serving> {
    const server: Server = createServer((request, response) => {
        const path = normalize(decodeURIComponent(new URL(request.url ?? '/', 'http://x').pathname));
        const [, scene = '', ...rest] = path.split('/');
        const name = rest.join('/');
        const headers: Record<string, string> = {
            'content-type': TYPES[extname(name)] ?? 'application/octet-stream',
            'content-security-policy': POLICY,
            'x-content-type-options': 'nosniff',
            'cache-control': 'no-store',
        };
        const packed = join(dist, `${name}.gz`);
        const file = filesOf(scene)[name];
        let body: Buffer | null = null;
        if (existsSync(packed) && statSync(packed).isFile()) {
            body = readFileSync(packed);
            headers['content-encoding'] = 'gzip';
        } else if (file !== undefined) {
            body = typeof file === 'string' ? readFileSync(file) : file;
        }
        if (body === null) {
            response.writeHead(404, headers).end();
            return;
        }
        response.writeHead(200, { ...headers, 'content-length': String(body.length) }).end(body);
    });
    await new Promise<void>((done) => server.listen(0, '127.0.0.1', done));
    const { port } = server.address() as AddressInfo;
    return { address: `http://127.0.0.1:${port}`, close: () => server.close() };
}
