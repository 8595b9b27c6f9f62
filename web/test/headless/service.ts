// A real service for the tests: a coordinator with tokens and workers, and in front of it a server with the
// built pages, so that the pages are those of this working tree.

import { type ChildProcess, execFileSync, spawn } from 'node:child_process';
import { closeSync, existsSync, openSync, readFileSync, statSync } from 'node:fs';
import { type IncomingMessage, type ServerResponse, createServer, request } from 'node:http';
import { type AddressInfo, createServer as createTcp } from 'node:net';
import { extname, join, normalize } from 'node:path';

import { POLICY } from './server.ts';

const TYPES: Readonly<Record<string, string>> = {
    '.html': 'text/html; charset=utf-8',
    '.js': 'text/javascript; charset=utf-8',
    '.css': 'text/css; charset=utf-8',
    '.txt': 'text/plain; charset=utf-8',
    '.png': 'image/png',
};
const SERVICE_PATH = /^\/(api\/|fathom\.)/;
const START_MS = 30_000;

async function freePort(): Promise<number> {
    const server = createTcp();
    await new Promise<void>((done) => server.listen(0, '127.0.0.1', done));
    const { port } = server.address() as AddressInfo;
    await new Promise((done) => server.close(done));
    return port;
}

const pause = (ms: number): Promise<void> => new Promise((done) => setTimeout(done, ms));

function ended(child: ChildProcess): Promise<void> {
    return new Promise((done) => {
        if (child.exitCode !== null || child.signalCode !== null) {
            done();
        } else {
            child.once('exit', () => done());
        }
    });
}

/** A job as the JSON interface gives it, as far as tests read it. */
export interface JobJson {
    readonly job: string;
    readonly name: string;
    readonly state: string;
    readonly progress: number;
    readonly priority: number;
    readonly max_parallel: number;
    readonly pause_reason: string | null;
    readonly error: string | null;
    readonly waiting_reason: string | null;
    readonly partitions: number;
    readonly tasks: readonly { readonly task: string; readonly state: string; readonly attempts: number }[];
}

/** A coordinator that can be killed and started again, and its workers. */
export class Service {
    readonly fathom: string;
    readonly folder: string;
    readonly grpcPort: number;
    readonly webPort: number;
    #coordinator: ChildProcess | null = null;
    readonly #workers: ChildProcess[] = [];

    private constructor(fathom: string, folder: string, grpcPort: number, webPort: number) {
        this.fathom = fathom;
        this.folder = folder;
        this.grpcPort = grpcPort;
        this.webPort = webPort;
    }

    static async start(fathom: string, folder: string): Promise<Service> {
        const service = new Service(fathom, folder, await freePort(), await freePort());
        await service.startCoordinator();
        return service;
    }

    get url(): string {
        return `http://127.0.0.1:${this.grpcPort}`;
    }

    /** The token of the operator that the coordinator made. */
    get operator(): string {
        return readFileSync(join(this.folder, 'data', 'operator.token'), 'utf8').trim();
    }

    /** What the coordinator logs. */
    get logPath(): string {
        return join(this.folder, 'coordinator.log');
    }

    get coordinatorPid(): number {
        return this.#coordinator!.pid!;
    }

    async startCoordinator(): Promise<void> {
        const [grpc, web] = [`127.0.0.1:${this.grpcPort}`, `127.0.0.1:${this.webPort}`];
        const data = join(this.folder, 'data');
        const flags = ['--data-dir', data, '--listen', grpc, '--web', web, '--tokens'];
        const log = openSync(this.logPath, 'a');
        this.#coordinator = spawn(this.fathom, ['coordinator', ...flags], { stdio: ['ignore', log, log] });
        closeSync(log);
        const until = Date.now() + START_MS;
        // Any answer will do; without a token it is a refusal.
        while (!(await fetch(`http://${web}/api/v1/jobs`).then(() => true, () => false))) {
            if (Date.now() > until || this.#coordinator.exitCode !== null) {
                throw new Error('the coordinator did not start');
            }
            await pause(100);
        }
    }

    /** Kills the coordinator as a power failure would. */
    async kill(): Promise<void> {
        this.#coordinator?.kill('SIGKILL');
        await ended(this.#coordinator!);
    }

    /** Runs a command with a token, and gives what it prints. */
    run(token: string, ...args: readonly string[]): string {
        const env = { ...process.env, FATHOM_TOKEN: token };
        return execFileSync(this.fathom, [...args], { env, encoding: 'utf8', stdio: ['ignore', 'pipe', 'pipe'] }).trim();
    }

    token(name: string, ...flags: readonly string[]): string {
        return this.run(this.operator, 'token', 'issue', name, '--coordinator', this.url, ...flags);
    }

    startWorker(token: string, name: string): ChildProcess {
        const env = { ...process.env, FATHOM_TOKEN: token };
        const flags = ['--coordinator', this.url, '--allow-cpu', '--name', name, '--cache-dir', join(this.folder, name)];
        const worker = spawn(this.fathom, ['worker', ...flags], { env, stdio: 'ignore' });
        this.#workers.push(worker);
        return worker;
    }

    submit(token: string, data: string, ...flags: readonly string[]): string {
        return this.run(token, 'submit', data, '--coordinator', this.url, ...flags).split('\n').at(-1) ?? '';
    }

    /** What the JSON interface says. */
    async api<T>(token: string, path: string): Promise<T> {
        const headers = { authorization: `Bearer ${token}` };
        const ask = (): Promise<Response> => fetch(`http://127.0.0.1:${this.webPort}/api/v1/${path}`, { headers });
        // A connection that `fetch` kept may have been closed by the other side at this moment.
        const response = await ask().catch(ask);
        return (await response.json()) as T;
    }

    async stop(): Promise<void> {
        for (const child of [...this.#workers, this.#coordinator]) {
            child?.kill('SIGKILL');
        }
        await Promise.all([...this.#workers, this.#coordinator!].map(ended));
    }
}

function page(dist: string, path: string, response: ServerResponse): void {
    const name = path === '/' ? 'index.html' : normalize(path).replace(/^\//, '');
    const packed = join(dist, `${name}.gz`);
    const headers = {
        'content-type': TYPES[extname(name)] ?? 'application/octet-stream',
        'content-security-policy': POLICY,
        'x-content-type-options': 'nosniff',
        'referrer-policy': 'no-referrer',
        'cache-control': 'no-cache',
    };
    if (!existsSync(packed) || !statSync(packed).isFile()) {
        response.writeHead(404, headers).end();
        return;
    }
    response.writeHead(200, { ...headers, 'content-encoding': 'gzip' }).end(readFileSync(packed));
}

function pass(port: number, asked: IncomingMessage, response: ServerResponse): void {
    const { method, url: path, headers } = asked;
    const passed = request({ host: '127.0.0.1', port, method, path, headers }, (answer) => {
        response.writeHead(answer.statusCode ?? 502, answer.headers);
        // The page must notice when the service breaks off.
        answer.on('error', () => response.destroy());
        answer.on('aborted', () => response.destroy());
        answer.pipe(response);
    });
    passed.on('error', () => response.destroy());
    response.on('close', () => passed.destroy());
    asked.pipe(passed);
}

/** Serves the built pages at `/`, and passes calls on to the service. */
export async function serveWith(dist: string, webPort: number): Promise<{ readonly address: string; close(): void }> {
    const server = createServer((asked, response) => {
        const path = new URL(asked.url ?? '/', 'http://x').pathname;
        if (SERVICE_PATH.test(path)) {
            pass(webPort, asked, response);
        } else {
            page(dist, path, response);
        }
    });
    await new Promise<void>((done) => server.listen(0, '127.0.0.1', done));
    const { port } = server.address() as AddressInfo;
    return {
        address: `http://127.0.0.1:${port}`,
        close: () => {
            server.closeAllConnections();
            server.close();
        },
    };
}
