// An hour of a job in a minute: pages of a job whose news come sixty times as fast, and which ask for the rest
// twenty times as often. Their memory must not grow. The service is made up, as in many.test.ts.
//
// HEADLESS_QUICK=1 skips it.

import assert from 'node:assert/strict';
import { type ServerResponse, createServer } from 'node:http';
import type { AddressInfo } from 'node:net';
import { join } from 'node:path';
import { after, before, test } from 'node:test';

import { fromBinary } from '@bufbuild/protobuf';
import { timestampFromMs } from '@bufbuild/protobuf/wkt';
import type { Browser, CDPSession, Page } from 'playwright-core';
import { PNG } from 'pngjs';

import { CallerSchema, Role } from '../../src/rpc/fathom/admin/v1/admin_pb.ts';
import { HistorySchema, JobEventSchema, JobSchema, JobState, Stage, TaskState } from '../../src/rpc/fathom/v1/job_pb.ts';
import { LogEntrySchema, LogSeverity } from '../../src/rpc/fathom/v1/log_pb.ts';
import { ReadBlobRequestSchema, ReadBlobResponseSchema } from '../../src/rpc/fathom/v1/upload_pb.ts';
import { launch, newPage } from './browser.ts';
import { TRAILER, framed, messageOf } from './grpc-web.ts';
import { serveWith } from './service.ts';
import { sleep, until } from './steps.ts';

const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const skip = process.env['HEADLESS_QUICK'] === '1' ? 'it takes a minute and a half' : false;
const TIMEOUT = { timeout: 300_000 };

const SPEED = 60;
/** Rounds of asking take the time of a processor, so they are not as fast as the news. */
const ASKING_SPEED = 20;
const HOUR_S = 3600;
const PARTITIONS = 8;
/** A task reports, writes a log line, a checkpoint and two previews this often, seconds of the job. */
const REPORT_S = 2;
const LINE_S = 5;
const CHECKPOINT_S = 60;
const PREVIEW_S = 30;
/** As the service keeps them for a task. */
const MOST_POINTS = 240;
const MOST_PREVIEWS = 96;
const ITERATIONS = 36_000;
const TICK_MS = 50;

/** Growth of the heap that is allowed, bytes. */
const MOST_GROWTH = 20e6;
/** Elements, texts and so on of a page, whether in the document or not. */
const MOST_NODES = 8000;
const MOST_LISTENERS = 3000;
/** Addresses of pictures: of the previews that the service still names, and a few photographs. */
const MOST_ADDRESSES = PARTITIONS * MOST_PREVIEWS * 0.7;

/** When the hour began, by the clock of this machine; null before. */
let begun: number | null = null;
const NOW = Date.now();
const secondsOf = (): number => (begun === null ? 0 : Math.min(HOUR_S, ((Date.now() - begun) / 1000) * SPEED));
const timeOf = (seconds: number) => timestampFromMs(NOW + Math.round(seconds * 1000));
const taskOf = (index: number): string => `partition-${String(index).padStart(4, '0')}`;
const tasks = Array.from({ length: PARTITIONS }, (_, index) => index);
const viewOf = (index: number): string => `v000${index}.png`;

const progressAt = (seconds: number) => ({
    iteration: 1 + Math.round((seconds * (ITERATIONS - 1)) / HOUR_S),
    iterations: ITERATIONS,
    gaussians: 1000 + Math.round(100 * seconds),
    loss: 0.2 / (1 + seconds / 600),
    iterationsPerSecond: 10,
    heldOut: { iteration: 1, psnrDb: 20 + seconds / 600, ssim: 0.5, views: 8 },
});

/** Equal steps of at least `step` up to now, at most `most` of them. */
function stepsUntil(seconds: number, step: number, most: number): number[] {
    let wide = step;
    while (seconds / wide > most) {
        wide *= 2;
    }
    return Array.from({ length: Math.floor(seconds / wide) + 1 }, (_, i) => i * wide);
}

const PLAN = {
    columns: PARTITIONS,
    rows: 1,
    alignment: { world_to_aligned_quat_wxyz: [1, 0, 0, 0] },
    extent: { viewing_distance: 2, cameras: { min: [0, 0, 0], max: [PARTITIONS, 0, 3] } },
    views: 40,
    held_out: [0, 1],
    partitions: tasks.map((id) => ({
        id,
        cell: { x: { lo: id, hi: id + 1 }, z: { lo: 0, hi: 3 } },
        extended_box: { min: [id - 0.2, -1, 0], max: [id + 1.2, 1, 3] },
        base_views: [id],
        chosen_views: [id],
        filled_views: 0,
        cell_points: 100,
        iterations: ITERATIONS,
        max_gaussians: 500_000,
    })),
};
const MANIFEST = {
    views: tasks.map((index) => ({
        name: viewOf(index),
        image: { digest: `photograph ${index}` },
        pose: { rotation: [0, 0, 0, 1], translation: [-index, 0, -1] },
    })),
};
const PICTURE = ((): Buffer => {
    const picture = new PNG({ width: 320, height: 240 });
    picture.data.fill(200);
    return PNG.sync.write(picture);
})();
const BLOBS: Readonly<Record<string, Buffer>> = {
    plan: Buffer.from(JSON.stringify(PLAN)),
    manifest: Buffer.from(JSON.stringify(MANIFEST)),
};

/** What is sent to followers: the news of a job from one time to another, seconds. */
type News = (from: number, to: number) => Buffer[];

/** Multiples of `step` in the half-open interval. */
function timesIn(from: number, to: number, step: number): number[] {
    const first = Math.floor(from / step) + 1;
    return Array.from({ length: Math.max(0, Math.floor(to / step) - first + 1) }, (_, i) => (first + i) * step);
}

const checkpointNumber = (seconds: number, task: number): bigint => BigInt((seconds / CHECKPOINT_S) * PARTITIONS + task + 1);
const events: News = (from, to) => [
    ...timesIn(from, to, CHECKPOINT_S).flatMap((at) =>
        tasks.map((task) =>
            framed(JobEventSchema, {
                jobId: '1',
                seq: checkpointNumber(at, task),
                time: timeOf(at),
                event: { case: 'checkpoint', value: { taskId: taskOf(task), attempt: 1, iteration: progressAt(at).iteration } },
            }),
        ),
    ),
    ...timesIn(from, to, REPORT_S).flatMap((at) =>
        tasks.map((task) =>
            framed(JobEventSchema, {
                jobId: '1',
                time: timeOf(at),
                event: { case: 'progress', value: { taskId: taskOf(task), progress: progressAt(at), jobProgress: at / HOUR_S } },
            }),
        ),
    ),
];
const lines: News = (from, to) =>
    timesIn(from, to, LINE_S).flatMap((at) =>
        tasks.map((task) =>
            framed(LogEntrySchema, {
                time: timeOf(at),
                severity: LogSeverity.INFO,
                taskId: taskOf(task),
                attempt: 1,
                worker: `gpu-${task}`,
                message: `training iteration=${progressAt(at).iteration} loss=${progressAt(at).loss.toFixed(4)}`,
                number: BigInt((at / LINE_S) * PARTITIONS + task),
            }),
        ),
    );

const historyAt = (seconds: number): Buffer =>
    framed(HistorySchema, {
        tasks: tasks.map((task) => ({
            taskId: taskOf(task),
            points: stepsUntil(seconds, REPORT_S, MOST_POINTS).map((at) => ({
                time: timeOf(at),
                attempt: 1,
                progress: { ...progressAt(at), memoryBytes: 2_000_000_000n },
            })),
            previews: stepsUntil(seconds, PREVIEW_S, MOST_PREVIEWS / 2).flatMap((at) =>
                [0, 1].map((view) => ({
                    view: viewOf(view),
                    iteration: progressAt(at).iteration,
                    render: { digest: `render ${task} ${view} ${at}`, sizeBytes: 1n },
                    clear: { digest: `clear ${task} ${view} ${at}`, sizeBytes: 1n },
                })),
            ),
        })),
    });

const jobAt = (seconds: number): Buffer =>
    framed(JobSchema, {
        jobId: '1',
        name: 'An hour',
        state: JobState.RUNNING,
        stage: Stage.PARTITION,
        partitions: PARTITIONS,
        createTime: timeOf(0),
        progress: seconds / HOUR_S,
        lastSeq: seconds < CHECKPOINT_S ? 0n : checkpointNumber(Math.floor(seconds / CHECKPOINT_S) * CHECKPOINT_S, PARTITIONS - 1),
        plan: { digest: 'plan', sizeBytes: 1n },
        manifest: { digest: 'manifest', sizeBytes: 1n },
        timeLeftSeconds: HOUR_S - seconds,
        tasks: tasks.map((task) => ({
            taskId: taskOf(task),
            stage: Stage.PARTITION,
            partition: task,
            state: TaskState.LEASED,
            attempts: 1,
            worker: `gpu-${task}`,
            progress: progressAt(seconds),
        })),
    });

const ANSWERS: Readonly<Record<string, (asked: Buffer) => Buffer>> = {
    GetCaller: () => framed(CallerSchema, { name: 'ana', role: Role.SUBMITTER, tenant: 'reef', tokensRequired: true }),
    GetJob: () => jobAt(secondsOf()),
    GetHistory: () => historyAt(secondsOf()),
    ReadBlob: (asked) => {
        const data = BLOBS[fromBinary(ReadBlobRequestSchema, messageOf(asked)).digest] ?? PICTURE;
        return framed(ReadBlobResponseSchema, { sizeBytes: BigInt(data.length), data });
    },
};

/** Sends news from the beginning of the hour, or of what is left of it, as they come. */
function play(response: ServerResponse, news: News): void {
    let sent = 0;
    const timer = setInterval(() => {
        const now = secondsOf();
        news(sent, now).forEach((message) => response.write(message));
        sent = now;
    }, TICK_MS);
    response.on('close', () => clearInterval(timer));
}

let browser: Browser;
let serving: Awaited<ReturnType<typeof serveWith>>;
const service = createServer((asked, response) => {
    const method = (asked.url ?? '').split('/').at(-1) ?? '';
    const pieces: Buffer[] = [];
    asked.on('data', (piece: Buffer) => pieces.push(piece));
    asked.on('end', () => {
        response.writeHead(200, { 'content-type': 'application/grpc-web+proto' });
        if (method === 'WatchJob' || method === 'StreamLogs') {
            response.flushHeaders();
            play(response, method === 'WatchJob' ? events : lines);
        } else {
            response.end(Buffer.concat([ANSWERS[method]?.(Buffer.concat(pieces)) ?? Buffer.alloc(0), TRAILER]));
        }
    });
});

before(async () => {
    if (skip !== false) {
        return;
    }
    await new Promise<void>((done) => service.listen(0, '127.0.0.1', done));
    serving = await serveWith(PAGES, (service.address() as AddressInfo).port);
    browser = await launch();
}, TIMEOUT);

after(async () => {
    await browser?.close();
    serving?.close();
    service.closeAllConnections();
    service.close();
});

interface Watched {
    readonly name: string;
    readonly page: Page;
    readonly complaints: string[];
    readonly devtools: CDPSession;
}

/** Opens a section of the job in a page that asks more often. */
async function openFast(name: string, section: string, shown: string): Promise<Watched> {
    const { page, complaints } = await newPage(browser);
    await page.addInitScript((speed) => {
        const original = window.setTimeout.bind(window);
        // Longer ones are limits, and shorter ones are for drawing.
        const faster = (work: TimerHandler, ms = 0, ...rest: unknown[]): number =>
            original(work, ms >= 3000 && ms <= 30_000 ? ms / speed : ms, ...rest);
        window.setTimeout = faster as typeof window.setTimeout;
        const [make, revoke] = [URL.createObjectURL.bind(URL), URL.revokeObjectURL.bind(URL)];
        const live = new Set<string>();
        Object.assign(window, { liveAddresses: live });
        URL.createObjectURL = (content) => {
            const address = make(content);
            live.add(address);
            return address;
        };
        URL.revokeObjectURL = (address) => {
            live.delete(address);
            revoke(address);
        };
    }, ASKING_SPEED);
    await page.goto(`${serving.address}/#/jobs/1${section}`);
    await page.locator(shown).first().waitFor();
    return { name, page, complaints, devtools: await page.context().newCDPSession(page) };
}

interface Memory {
    readonly heap: number;
    readonly nodes: number;
    readonly listeners: number;
    readonly addresses: number;
}

async function memoryOf({ page, devtools }: Watched): Promise<Memory> {
    // Twice, since finalizers give free what others hold.
    await devtools.send('HeapProfiler.collectGarbage');
    await devtools.send('HeapProfiler.collectGarbage');
    const { usedSize: heap } = await devtools.send('Runtime.getHeapUsage');
    const { nodes, jsEventListeners: listeners } = await devtools.send('Memory.getDOMCounters');
    const addresses = await page.evaluate(() => (window as unknown as { liveAddresses: Set<string> }).liveAddresses.size);
    return { heap, nodes, listeners, addresses };
}

test('an hour of news takes no more memory than a minute', { skip, ...TIMEOUT }, async (t) => {
    const all = [
        await openFast('overview', '', '.fp-plan-canvas'),
        await openFast('curves', '/curves', '.fp-curves'),
        await openFast('views', '/views', '.section'),
        await openFast('log', '/log', '.log'),
        await openFast('going round', '/settings', '.section'),
    ];
    begun = Date.now();
    await until('the first minute', async () => secondsOf() >= 60);
    const early = await Promise.all(all.map(memoryOf));
    const roundabout = all.at(-1)!.page;
    const sections = ['', '/curves', '/views', '/log', '/settings'];
    for (let turn = 0; secondsOf() < HOUR_S; turn += 1) {
        await roundabout.evaluate((hash) => (location.hash = hash), `#/jobs/1${sections[turn % sections.length]}`);
        await sleep(800);
    }

    // All of them have followed to the end of the hour.
    const [overview, curves, views, log] = all.map(({ page }) => page) as [Page, Page, Page, Page];
    // A click waits for a page at rest, and this one is not.
    await Promise.all(all.map(({ page }) => page.evaluate(() => document.querySelectorAll('details').forEach((one) => (one.open = true)))));
    await overview.getByText(/^36,000 of 36,000$/).first().waitFor();
    await curves.getByRole('cell', { name: '36,000' }).first().waitFor();
    await log.getByText(`${((PARTITIONS * HOUR_S) / LINE_S).toLocaleString('en')} lines`).waitFor();
    await until('the newest preview', async () =>
        /Iteration 3[56],\d+ of 36,000/.test((await views.locator('.section output').last().textContent()) ?? ''),
    );
    for (const [index, one] of all.entries()) {
        const [first, now] = [early[index]!, await memoryOf(one)];
        const mb = (bytes: number): string => (bytes / 1e6).toFixed(1);
        const counts = `${now.nodes} nodes, ${now.listeners} listeners, ${now.addresses} addresses`;
        t.diagnostic(`${one.name}: ${mb(first.heap)} MB, then ${mb(now.heap)} MB; ${first.nodes} nodes, then ${counts}`);
        assert.ok(now.heap - first.heap < MOST_GROWTH, `${one.name}: from ${mb(first.heap)} to ${mb(now.heap)} MB`);
        assert.ok(now.nodes < MOST_NODES && now.listeners < MOST_LISTENERS, `${one.name}: ${counts}`);
        assert.ok(now.addresses <= MOST_ADDRESSES, `${one.name}: ${counts}`);
        assert.deepEqual(one.complaints, [], one.name);
        await one.page.context().close();
    }
});
