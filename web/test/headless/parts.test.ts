// The built pages of a job before a made-up service: its water as it settles, what bounds it, its
// seams, and the viewer while partitions train.

import assert from 'node:assert/strict';
import { join } from 'node:path';
import { after, before, test } from 'node:test';

import { timestampFromMs } from '@bufbuild/protobuf/wkt';
import type { Browser, Page } from 'playwright-core';
import { PNG } from 'pngjs';

import { MOST_JOBS } from '../../src/pages/service/bounds-of-jobs.ts';
import { brief } from '../../src/pages/parts/format.ts';
import { Role } from '../../src/rpc/fathom/admin/v1/admin_pb.ts';
import { JobState, Stage, TaskState } from '../../src/rpc/fathom/v1/job_pb.ts';
import { WIDE_WINDOW, launch } from './browser.ts';
import { type MadeUp, json, serveMadeUp } from './made-up.ts';
import { type Opened, askAgain, finish, looksRight, openAs } from './steps.ts';

const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const TIMEOUT = { timeout: 60_000 };
/** Without a graphics card the viewer draws slowly. */
const LONG_TIMEOUT = { timeout: 180_000 };
const NOW = Date.now();

let browser: Browser;
let service: MadeUp;

before(async () => {
    service = await serveMadeUp(PAGES);
    browser = await launch();
}, TIMEOUT);

after(async () => {
    await browser?.close();
    service?.close();
});

const JOB = {
    jobId: '7',
    name: 'Transect 7',
    state: JobState.RUNNING,
    stage: Stage.FIRST_PART,
    partitions: 4,
    progress: 0.4,
    createTime: timestampFromMs(NOW - 600_000),
};

const open = (section: string, options = {}): Promise<Opened> =>
    openAs(browser, `${service.address}/#/jobs/7${section}`, '', options);
/** The viewer in a small window: without a graphics card it draws slowly. */
const openViewer = (): Promise<Opened> => open('/viewer', { viewport: WIDE_WINDOW });

const rgb = (red: number, green: number, blue: number) => ({ red, green, blue });

/** Water that settles from a guess to what partition `index` finds. */
const waterAt = (index: number, share: number) => {
    const to = (end: number): number => end * (1 + 0.05 * index) * (1 - 0.5 * Math.exp(-4 * share));
    return {
        betaD: rgb(to(0.4), to(0.16), to(0.1)),
        betaB: rgb(to(0.3), to(0.2), to(0.14)),
        bInf: rgb(to(0.02), to(0.09), to(0.12)),
    };
};

/** Standard errors that shrink; nothing determines the backscatter of red, nor open water. */
const errorsAt = (share: number) => {
    const of = (end: number): number => end * (1 + 3 * Math.exp(-4 * share));
    return {
        betaD: { red: of(0.012), green: of(0.006), blue: of(0.004) },
        betaB: { green: of(0.02), blue: of(0.01) },
    };
};

/** The water of tasks that settles, with errors unless workers are too old to report them. */
const settling = (points: number, hasErrors = false, tasks = 4) =>
    Array.from({ length: tasks }, (_, index) => ({
        taskId: `first_part-000${index}`,
        points: Array.from({ length: points }, (__, at) => ({
            time: timestampFromMs(NOW - 300_000 + at * 5000),
            attempt: 1,
            progress: {
                iteration: at * 100,
                iterations: 6000,
                loss: 0.1,
                water: {
                    ...waterAt(index, at / 40),
                    ...(hasErrors ? { standardError: errorsAt(at / 40) } : {}),
                },
            },
        })),
    }));

const firstParts = Array.from({ length: 4 }, (_, index) => ({
    taskId: `first_part-000${index}`,
    stage: Stage.FIRST_PART,
    partition: index,
    state: TaskState.LEASED,
    attempts: 1,
}));

test('the water is shown while it settles, with the spread between partitions', TIMEOUT, async () => {
    service.told.blobs.set('plan', json({ extent: { viewing_distance: 4.7 } }));
    service.told.job = { ...JOB, plan: { digest: 'plan', sizeBytes: 1n }, tasks: firstParts };
    service.told.history = { tasks: [] };
    const opened = await open('/water');
    const { page } = opened;
    await page.getByText('The water is shown here while it trains').waitFor();
    service.told.history = { tasks: settling(20) };
    await askAgain(page);
    await page.getByText('First part of partition 0 at iteration 1,900').waitFor();
    assert.equal(await page.locator('.fp-curve canvas').count(), 3);
    const expected = waterAt(0, 19 / 40).betaD.red.toPrecision(3);
    await page.locator('.fp-curve').first().getByText(expected).waitFor();
    await page.getByText('Bands: lowest to highest of 4 tasks of this stage, dashed: their mean.').waitFor();
    // Before the job has succeeded, the latest water is shown by what it does to colours.
    const colours = page.locator('.fp-water-colours');
    await colours.getByText('The latest water of First part of partition 0, at iteration 1,900.').waitFor();
    await colours.getByText('the median depth of the scene in the photographs').waitFor();
    assert.deepEqual(
        (await colours.locator('thead th').allTextContents()).map((text) => text.split(' ').slice(0, 2).join(' ')),
        ['In air', '1 ×', '3 ×', '10 ×', 'Open water'],
    );
    // The values of partition 3 are 15 % above those of partition 0, of a mean of 1.075 times the latter.
    assert.equal(await page.locator('.fp-water-spread').getByText('14 % apart').count(), 9);
    await page.getByLabel('Water of').selectOption('First part of partition 2');
    assert.equal(await page.locator('.fp-water-parameter').count(), 0, 'these workers report no errors');
    service.told.history = { tasks: settling(40, true) };
    await askAgain(page);
    await page.getByText('First part of partition 2 at iteration 3,900').waitFor();
    // Bands between partitions stay; the tables have the errors of the chosen task.
    await page.getByText('Bands: lowest to highest of 4 tasks of this stage, dashed: their mean.').waitFor();
    assert.deepEqual(await numbersOf(page), expectedNumbers(2, 39 / 40));
    assert.equal(await page.locator('.fp-water-error').count(), 5, 'a bar for each error');
    await page.getByText('one standard error, drawn on the bars. –: the photographs').waitFor();
    await page.getByText('The latest water of each task as a table').click();
    const row = page.getByRole('row', { name: 'First part of partition 3' });
    const { betaD } = waterAt(3, 39 / 40);
    const ofRed = `${brief(betaD.red)} ±\u00a0${brief(errorsAt(39 / 40).betaD.red, 2)}`;
    assert.equal((await row.getByRole('cell').allTextContents())[1], ofRed);
    await looksRight(opened, 'water');
    await finish(opened);
});

/** The tables of the page: by parameter and colour, its value and its error. */
const numbersOf = (page: Page): Promise<(string | null)[][]> =>
    page
        .locator('.fp-water-parameter tbody tr')
        .evaluateAll((rows) =>
            rows.map((row) => [...row.children].slice(0, 3).map(({ textContent }) => textContent)),
        );

/** What the tables say of the history that `settling` makes. */
const expectedNumbers = (index: number, share: number): string[][] => {
    const errors: Record<string, Record<string, number>> = errorsAt(share);
    return Object.entries(waterAt(index, share)).flatMap(([parameter, values]) =>
        Object.entries(values).map(([channel, value]) => {
            const error = errors[parameter]?.[channel];
            const name = `${channel[0]!.toUpperCase()}${channel.slice(1)}`;
            return [name, brief(value), error === undefined ? '–' : brief(error, 2)];
        }),
    );
};

test('bands show the errors of the water of one task', TIMEOUT, async () => {
    service.told.job = { ...JOB, tasks: firstParts.slice(0, 1) };
    service.told.history = { tasks: settling(30, true, 1) };
    const opened = await open('/water');
    const { page } = opened;
    await page.getByText('Lines are red, green and blue light. Bands: ± one standard error.').waitFor();
    assert.deepEqual(await numbersOf(page), expectedNumbers(0, 29 / 40));
    await looksRight(opened, 'water-errors');
    const coloured = (): Promise<number> =>
        page
            .locator('.fp-curve canvas')
            .first()
            .evaluate((canvas: HTMLCanvasElement) => {
                const context = canvas.getContext('2d')!;
                const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
                let count = 0;
                for (let at = 0; at < data.length; at += 4) {
                    // The opacity of a band is 0x2e; where two overlap it is more.
                    count += data[at + 3]! > 40 && data[at + 3]! < 90 ? 1 : 0;
                }
                return count;
            });
    const withErrors = await coloured();
    service.told.history = { tasks: settling(31, false, 1) };
    await page.getByText('at iteration 3,000. Lines are red, green and blue light.').waitFor();
    assert.equal(await page.getByText('Bands:').count(), 0);
    await page.locator('.fp-water-parameter').waitFor({ state: 'detached' });
    const without = await coloured();
    assert.ok(withErrors > without + 1000, `${withErrors} pixels of bands, ${without} without errors`);
    await finish(opened);
});

const WATER = {
    format: 2,
    medium: 'per_pixel',
    blend: 'srgb',
    beta_d: [0.4, 0.16, 0.1],
    beta_b: [0.3, 0.2, 0.14],
    b_inf: [0.02, 0.09, 0.12],
    standard_error: { beta_d: [0.01, 0.008, 0.006], beta_b: [null, null, 0.03], b_inf: [null, null, 0.05] },
    source: 'consensus',
    partitions: [],
};

test('the final water comes first, and how it settled below it', TIMEOUT, async () => {
    const tasks = firstParts.map((task) => ({ ...task, state: TaskState.DONE }));
    service.told.job = { ...JOB, state: JobState.SUCCEEDED, progress: 1, tasks };
    service.told.history = { tasks: settling(40) };
    service.told.files
        .set('water.json', json(WATER))
        .set('plan.json', json({ extent: { viewing_distance: 4.7 } }));
    const opened = await open('/water');
    const { page } = opened;
    await page.getByText('one standard error').waitFor();
    await page.getByRole('heading', { name: 'How it settled' }).waitFor();
    const places = await page.evaluate(() =>
        ['.fp-water-grid', '.fp-curve'].map(
            (what) => document.querySelector(what)!.getBoundingClientRect().top,
        ),
    );
    assert.ok(places[0]! < places[1]!);
    await looksRight(opened, 'water-final');
    await finish(opened);
});

test('a job in air says that it has no water', TIMEOUT, async () => {
    service.told.job = { ...JOB, configJson: '{"water": {"medium": "none"}}', tasks: firstParts };
    service.told.history = { tasks: [] };
    const opened = await open('/water');
    await opened.page.getByText('This job trains the scene as it looks in air').waitFor();
    await finish(opened);
});

const changed = (at: number, seq: number, taskId: string, stage: Stage, state: TaskState) => ({
    jobId: '7',
    seq: BigInt(seq),
    time: timestampFromMs(at),
    event: {
        case: 'taskChanged' as const,
        value: { taskId, stage, state, attempt: 1, worker: 'gpu-1' },
    },
});

test('the overview says what bounds the job, and where its time went', TIMEOUT, async () => {
    // Shares of the time must not depend on how long the tests before took.
    const now = Date.now();
    const tasks = [
        { taskId: 'plan', stage: Stage.PLAN, state: TaskState.DONE, attempts: 1, seconds: 40 },
        { taskId: 'partition-0000', stage: Stage.PARTITION, state: TaskState.LEASED, attempts: 1 },
        { taskId: 'partition-0001', stage: Stage.PARTITION, partition: 1, state: TaskState.READY },
    ];
    service.told.job = { ...JOB, createTime: timestampFromMs(now - 600_000), tasks, lastSeq: 4n };
    service.told.events = [
        changed(now - 600_000, 1, 'plan', Stage.PLAN, TaskState.LEASED),
        changed(now - 560_000, 2, 'plan', Stage.PLAN, TaskState.DONE),
        {
            ...changed(now - 560_000, 3, '', Stage.PARTITION, TaskState.READY),
            event: { case: 'jobStage' as const, value: { stage: Stage.PARTITION, tasks: 2 } },
        },
        changed(now - 530_000, 4, 'partition-0000', Stage.PARTITION, TaskState.LEASED),
    ];
    const timeSpent = {
        seconds: 520,
        fetchingSeconds: 25,
        trainingSeconds: 470,
        photographsSeconds: 15,
        diskSeconds: 6,
        watchingSeconds: 10,
    };
    const point = {
        time: timestampFromMs(now),
        attempt: 1,
        progress: { iteration: 900, iterations: 6000, timeSpent },
    };
    service.told.history = { tasks: [{ taskId: 'partition-0000', points: [point] }] };
    const opened = await open('');
    const { page } = opened;
    await page.getByText('The GPU bounds this job: workers spent 90 % of their time training.').waitFor();
    await page
        .getByText('More workers would finish it sooner: on average 1.0 tasks waited for one.')
        .waitFor();
    const list = page.getByRole('list', { name: 'Where the time of the job went' });
    const items = await list.getByRole('listitem').allTextContents();
    assert.deepEqual(
        items.map((text) => text.split(':')[0]),
        [
            'Training',
            'Reading photographs from disk',
            'Decoding photographs',
            'Fetching input, sending results',
            'Measuring, previews, checkpoints',
            'Work of the coordinator',
            'Waiting for workers',
        ],
    );
    assert.match(items[0]!, /^Training: 80 %, \d+ min/);
    await looksRight(opened, 'bounds');
    const [text, advice] = await page.locator('.bounds > p').allTextContents();
    await finish(opened);

    // The queue says the same of this job.
    service.told.role = Role.OPERATOR;
    const queue = await openAs(browser, `${service.address}/#/service/queue`);
    const cell = queue.page.getByRole('row', { name: 'Transect 7' }).locator('.bound');
    await cell.getByText('GPU', { exact: true }).waitFor();
    assert.equal(await cell.locator('.soft').textContent(), `${text} ${advice}`);
    await looksRight(queue, 'queue-bounds');
    await finish(queue);
    delete service.told.role;
});

test('a long queue has verdicts of its first jobs', TIMEOUT, async () => {
    // The made-up service tells the same of every job.
    service.told.jobs = Array.from({ length: MOST_JOBS + 2 }, (_, at) => ({
        ...service.told.job,
        jobId: `7-${at}`,
        name: `Transect ${at}`,
        priority: -at,
    }));
    service.told.role = Role.OPERATOR;
    service.calls.length = 0;
    const opened = await openAs(browser, `${service.address}/#/service/queue`);
    const { page } = opened;
    const cells = page.locator('.queue tbody .bound');
    await page.waitForFunction(
        (most) => document.querySelectorAll('.queue tbody .bound .soft').length === most,
        MOST_JOBS,
    );
    const words = (await cells.allTextContents()).map((text) => text.slice(0, 3));
    assert.deepEqual(words, [...Array.from({ length: MOST_JOBS }, () => 'GPU'), 'in ', 'in ']);
    const link = cells.last().getByRole('link', { name: 'in its Overview' });
    assert.equal(await link.getAttribute('href'), `#/jobs/7-${MOST_JOBS + 1}`);
    await looksRight(opened, 'queue-long');
    // Rounds of the queue, in which nobody is asked again.
    await page.waitForTimeout(4000);
    const count = (method: string): number => service.calls.filter((one) => one === method).length;
    assert.deepEqual(
        ['GetJob', 'WatchJob', 'GetHistory'].map(count),
        [MOST_JOBS, MOST_JOBS, MOST_JOBS],
    );
    assert.equal(service.streams(), 0, 'no stream is left open');
    await finish(opened);
    delete service.told.role;
    delete service.told.jobs;
});

test('a job that has only begun has no verdict', TIMEOUT, async () => {
    service.told.job = { ...JOB, createTime: timestampFromMs(Date.now() - 5000), tasks: [], lastSeq: 0n };
    service.told.events = [];
    service.told.history = { tasks: [] };
    const opened = await open('');
    await opened.page.getByRole('heading', { name: 'Stages' }).waitFor();
    await opened.page.waitForTimeout(4000);
    assert.equal(await opened.page.locator('.bounds').isVisible(), false);
    await finish(opened);
});

/** Four cells about the origin; the third and fourth are cut elsewhere. */
const PLAN = {
    format: 4,
    columns: 2,
    rows: 2,
    alignment: { down: [0, 1, 0], world_to_aligned_quat_wxyz: [1, 0, 0, 0] },
    extent: { viewing_distance: 4.7, cameras: { min: [-7, -5, -4], max: [7, -4, 4] } },
    views: 12,
    held_out: [0, 8],
    partitions: [
        { x: { lo: null, hi: 0 }, z: { lo: null, hi: 0 } },
        { x: { lo: null, hi: 0 }, z: { lo: 0, hi: null } },
        { x: { lo: 0, hi: null }, z: { lo: null, hi: 1 } },
        { x: { lo: 0, hi: null }, z: { lo: 1, hi: null } },
    ].map((cell, id) => ({
        id,
        cell,
        extended_box: { min: [-8, -5, -5], max: [8, 5, 5] },
        base_views: [id],
        chosen_views: [id],
        filled_views: 0,
        cell_points: 100,
        iterations: 6000,
        max_gaussians: 1000,
    })),
};
const CAMERAS = Array.from({ length: 12 }, (_, id) => ({
    id,
    img_name: `v${id}.png`,
    width: 160,
    height: 120,
    position: [-6.6 + 1.2 * id, -4.5, 3 * Math.cos(id)],
    rotation: [
        [1, 0, 0],
        [0, 0, 1],
        [0, -1, 0],
    ],
    fx: 120,
    fy: 120,
}));
const SEAM_BAND = {
    views: 2,
    psnr: 26.37,
    ssim: 0.7075,
    flank_psnr: 26.92,
    flank_ssim: 0.7211,
    pixels: 4564,
};
const SEAM_STEPS = { pairs: 431, median: 0.0181, beside_pairs: 912, beside_median: 0.012, ratio: 1.51 };
const METRICS = {
    seams: {
        band: 0.235,
        border: { ...SEAM_BAND, loss_db: 0.55, loss_db_error: 0.11, interior_psnr: 24.8 },
        control: { ...SEAM_BAND, loss_db: 0.04, loss_db_error: 0.08, interior_psnr: 24.8 },
        range_step: { border: SEAM_STEPS, control: { ...SEAM_STEPS, ratio: 1.08 } },
    },
    views: [
        { name: 'v0.png', border_pixels: 1394, border_psnr: 26.62, interior_psnr: 25, control_psnr: 26.43 },
        { name: 'v8.png', border_pixels: 3170, border_psnr: 26.11, interior_psnr: 24.6, control_psnr: null },
    ],
};
const PICTURE = ((): Buffer => {
    const picture = new PNG({ width: 320, height: 120 });
    picture.data.forEach((_, at) => (picture.data[at] = at % 4 === 3 ? 255 : (at >> 3) % 256));
    return PNG.sync.write(picture);
})();

test('seams are told with their numbers, on the plan and in pictures', TIMEOUT, async () => {
    service.told.job = { ...JOB, state: JobState.SUCCEEDED, progress: 1, tasks: [] };
    service.told.files
        .set('metrics.json', json(METRICS))
        .set('plan.json', json(PLAN))
        .set('cameras.json', json(CAMERAS))
        .set('renders/border_0000_v0.png', PICTURE)
        .set('renders/border_0001_v8.png', PICTURE);
    const opened = await open('/seams');
    const { page } = opened;
    await page.getByText('Borders show. Along borders the model is 0.55 dB worse').waitFor();
    await page.getByText('across borders, 1.51 times as much as beside them').waitFor();
    await page.getByRole('row', { name: 'Loss, dB' }).getByText('0.55 ± 0.11').waitFor();
    await page.getByRole('img', { name: 'The plan from above with 3 borders between cells.' }).waitFor();
    await page.getByLabel('Held-out view', { exact: true }).selectOption('v8');
    await page.getByRole('img', { name: 'Borders in the held-out view v8' }).waitFor();
    await page.getByText('Each held-out view as a table').click();
    await page.getByRole('row', { name: 'v8.png' }).getByText('26.11 dB').waitFor();
    await looksRight(opened, 'seams');
    await finish(opened);
});

test('a scene in one piece has no seams, and a job that runs has none yet', TIMEOUT, async () => {
    service.told.job = { ...JOB, partitions: 1, tasks: [] };
    const one = await open('/seams');
    await one.page.getByText('The scene was not cut').waitFor();
    await finish(one);
    service.told.job = { ...JOB, tasks: [] };
    const four = await open('/seams');
    await four.page.getByText('The seams between partitions will be here once').waitFor();
    await finish(four);
    service.told.job = { ...JOB, partitions: 1, state: JobState.SUCCEEDED, tasks: [] };
    service.told.files.set('metrics.json', json({ seams: null, views: [] }));
    const ended = await open('/seams');
    await ended.page.getByText('The scene was not cut').waitFor();
    await looksRight(ended, 'seams-none');
    await finish(ended);
});

const COLOURS = { red: [1, 0, 0], green: [0, 1, 0], blue: [0, 0, 1] } as const;
const NAMES = [
    'f_dc_0',
    'f_dc_1',
    'f_dc_2',
    'opacity',
    'scale_0',
    'scale_1',
    'scale_2',
    'rot_0',
    'rot_1',
    'rot_2',
    'rot_3',
];
const PROPERTIES = ['x', 'y', 'z', ...NAMES];
/** The constant harmonic. */
const SH_0 = 0.28209479177387814;

/** Small opaque Gaussians of one colour all over the plane, with the water of a job as a comment. */
function carpet(colour: keyof typeof COLOURS): Buffer {
    const dc = COLOURS[colour].map((value) => (value - 0.5) / SH_0);
    const rows: number[] = [];
    for (let x = -7.5; x < 8; x++) {
        for (let z = -4.5; z < 5; z++) {
            rows.push(x, 0, z, ...dc, 8, -1.2, -1.2, -1.2, 1, 0, 0, 0);
        }
    }
    const header = [
        'ply',
        'format binary_little_endian 1.0',
        `comment fathom_water ${JSON.stringify(WATER)}`,
        `element vertex ${rows.length / PROPERTIES.length}`,
        ...PROPERTIES.map((name) => `property float ${name}`),
        'end_header\n',
    ];
    return Buffer.concat([Buffer.from(header.join('\n')), Buffer.from(new Float32Array(rows).buffer)]);
}

/** From above; z of the scene is up in the picture. */
const ABOVE = {
    id: 0,
    img_name: 'from above',
    width: 160,
    height: 120,
    position: [0, -10, 0],
    rotation: [
        [1, 0, 0],
        [0, 0, 1],
        [0, -1, 0],
    ],
    fx: 100,
    fy: 100,
};

/** The colour of the model at places (x, z) of the plane, from above and without water. */
const seenAt = (page: Page, places: readonly (readonly [number, number])[]): Promise<readonly string[]> =>
    page.evaluate(
        async ([camera, all]) => {
            const handle = document.querySelector<HTMLElement>('.viewer-host')!.fathomViewer!;
            const { width, height } = camera;
            const { data } = await handle.picture({ width, height, camera: camera as never, mode: 'clear' });
            return all.map(([x, z]) => {
                const [left, top] = [Math.round(80 + 10 * x), Math.round(60 - 10 * z)];
                const pixel = [...data.subarray(4 * (top * width + left), 4 * (top * width + left) + 3)];
                const most = pixel.indexOf(Math.max(...pixel));
                return Math.max(...pixel) < 100 ? 'none' : ['red', 'green', 'blue'][most]!;
            });
        },
        [ABOVE, places] as const,
    );

/** What is on the screen, from where the camera is. */
const onScreen = (page: Page): Promise<string> =>
    page.evaluate(async () => {
        const handle = document.querySelector<HTMLElement>('.viewer-host')!.fathomViewer!;
        const { data } = await handle.picture({ width: 64, height: 48, mode: 'range' });
        return [...data].join();
    });

/** Takes the newer model that the page offers, and waits until it is there. */
async function showNewer(page: Page): Promise<void> {
    const button = page.getByRole('button', { name: 'Show it' });
    await button.click();
    await button.waitFor({ state: 'hidden' });
}

/** In each cell of the plan. */
const IN_CELLS = [
    [-3, -2.5],
    [-3, 2.5],
    [3, -2.5],
    [3, 2.5],
] as const;

const partition = (index: number, model: string) => ({
    taskId: `partition-000${index}`,
    stage: Stage.PARTITION,
    partition: index,
    state: model === '' ? TaskState.LEASED : TaskState.DONE,
    attempts: 1,
    ...(model === '' ? {} : { model: blobOf(model) }),
});
const blobOf = (digest: string) => ({
    digest,
    sizeBytes: BigInt(service.told.blobs.get(digest)?.length ?? 0),
});

test(
    'finished partitions are seen within their cells, and the coarse model elsewhere',
    LONG_TIMEOUT,
    async () => {
        service.told.blobs
            .set('plan', json(PLAN))
            .set('coarse', carpet('blue'))
            .set('zero', carpet('red'))
            .set('three', carpet('green'))
            .set('whole', carpet('green'));
        const job = { ...JOB, plan: blobOf('plan') };
        const global = { taskId: 'global', stage: Stage.GLOBAL, attempts: 1 };
        const done = { ...global, state: TaskState.DONE, model: blobOf('coarse') };
        const waiting = [0, 1, 2, 3].map((index) => partition(index, ''));
        service.told.job = { ...job, tasks: [{ ...global, state: TaskState.LEASED }, ...waiting] };
        const opened = await openViewer();
        const { page } = opened;
        await page.getByText('as soon as the coarse model has been trained').waitFor();
        service.told.job = { ...job, tasks: [done, ...waiting] };
        // This first change it finds in its own time.
        await page.getByText('The coarse model. None of 4 partitions has finished.').waitFor();
        await page.waitForFunction(() => document.querySelector<HTMLElement>('.viewer-host')?.fathomViewer);
        assert.deepEqual(await seenAt(page, IN_CELLS), ['blue', 'blue', 'blue', 'blue']);
        // Somewhere else than at the beginning.
        await page.evaluate(() => document.querySelector<HTMLElement>('.fv-canvas')!.focus());
        await page.keyboard.press('ArrowLeft');
        const seen = await onScreen(page);
        const [first, second, third, fourth] = [
            partition(0, 'zero'),
            waiting[1]!,
            waiting[2]!,
            partition(3, 'three'),
        ];
        service.told.job = { ...job, tasks: [done, first, second, third, fourth] };
        await askAgain(page);
        await page.getByText('There is more: 2 of 4 partitions, the coarse model elsewhere.').waitFor();
        await looksRight(opened, 'composite-newer');
        await showNewer(page);
        await page.getByText('2 of 4 partitions, the coarse model elsewhere.').waitFor();
        assert.deepEqual(await seenAt(page, IN_CELLS), ['red', 'blue', 'blue', 'green']);
        // The Gaussians stand at the same places in all models.
        assert.equal(await onScreen(page), seen, 'the camera has not moved');
        assert.equal(
            service.read.filter((digest) => digest === 'coarse').length,
            1,
            'what was fetched is kept',
        );
        const merge = { taskId: 'merge', stage: Stage.MERGE, state: TaskState.DONE, model: blobOf('whole') };
        service.told.job = { ...job, tasks: [done, merge] };
        await askAgain(page);
        await page.getByText('There is more: The merged model. Its evaluation follows.').waitFor();
        await showNewer(page);
        assert.deepEqual(await seenAt(page, IN_CELLS), ['green', 'green', 'green', 'green']);
        service.told.files.set('model.ply', carpet('red'));
        service.told.job = { ...job, state: JobState.SUCCEEDED, tasks: [done, merge] };
        await askAgain(page);
        await page.getByText('There is more: The finished model.').waitFor();
        await showNewer(page);
        assert.deepEqual(await seenAt(page, IN_CELLS), ['red', 'red', 'red', 'red']);
        await finish(opened);
    },
);

test('without a coarse model, nothing is seen outside of finished partitions', TIMEOUT, async () => {
    service.told.job = { ...JOB, plan: blobOf('plan'), tasks: [partition(2, 'zero'), partition(3, '')] };
    const opened = await openViewer();
    const { page } = opened;
    await page.getByText('1 of 4 partitions, nothing elsewhere.').waitFor();
    await page.waitForFunction(() => document.querySelector<HTMLElement>('.viewer-host')?.fathomViewer);
    assert.deepEqual(await seenAt(page, IN_CELLS), ['none', 'none', 'red', 'none']);
    await finish(opened);
});

test('a model that is gone is told, and the viewer stays with what it has', TIMEOUT, async () => {
    service.told.job = { ...JOB, plan: blobOf('plan'), tasks: [partition(2, 'zero'), partition(3, '')] };
    const opened = await openViewer();
    const { page } = opened;
    await page.waitForFunction(() => document.querySelector<HTMLElement>('.viewer-host')?.fathomViewer);
    service.told.job = {
        ...JOB,
        plan: blobOf('plan'),
        tasks: [partition(2, 'zero'), partition(3, 'missing')],
    };
    await askAgain(page);
    await page.getByRole('button', { name: 'Show it' }).click();
    await page.getByText('The newer model cannot be shown.').waitFor();
    assert.deepEqual(await seenAt(page, IN_CELLS), ['none', 'none', 'red', 'none']);
    await page.getByRole('button', { name: 'Show it' }).waitFor();
    await finish(opened);
});

/** How often a file of the job was asked for. */
const timesAsked = (path: string): number => service.asked.filter((asked) => asked === path).length;

/** A finished job whose model is red and whose copy is blue, with the sizes that the service states. */
function finishedWith(modelBytes: number | null, copyBytes: number | null): void {
    service.told.job = { ...JOB, state: JobState.SUCCEEDED, progress: 1, tasks: [] };
    service.told.files
        .set('plan.json', json(PLAN))
        .set('cameras.json', json(CAMERAS))
        .set('water.json', json(WATER))
        .set('model.ply', carpet('red'))
        .set('model.compressed.ply', carpet('blue'));
    service.told.refused.clear();
    service.told.sizes.clear();
    if (modelBytes !== null && copyBytes !== null) {
        service.told.sizes.set('model.ply', modelBytes).set('model.compressed.ply', copyBytes);
    }
    service.asked.length = 0;
}

const waitForViewer = (page: Page): Promise<unknown> =>
    page.waitForFunction(() => document.querySelector<HTMLElement>('.viewer-host')?.fathomViewer);

const COPY_LINE = 'A copy for viewing: 61.0 MB instead of 248 MB.';

test('of a large finished model the copy is seen first, and the whole model on request', LONG_TIMEOUT, async () => {
    finishedWith(248e6, 61e6);
    const opened = await openViewer();
    const { page } = opened;
    await page.getByText(COPY_LINE, { exact: true }).waitFor();
    await waitForViewer(page);
    assert.deepEqual(await seenAt(page, IN_CELLS), ['blue', 'blue', 'blue', 'blue']);
    assert.deepEqual([timesAsked('model.compressed.ply'), timesAsked('model.ply')], [1, 0]);
    await looksRight(opened, 'viewer-copy');
    const whole = page.getByRole('button', { name: 'Load the whole model' });

    // Refused: what was seen stays, and it can be tried again.
    service.told.refused.add('model.ply');
    await whole.click();
    await page.getByText('The whole model cannot be shown.').waitFor();
    await page.getByText(COPY_LINE, { exact: true }).waitFor();
    await page.waitForFunction(
        () => ![...document.querySelectorAll('button')].some(({ textContent, disabled }) =>
            disabled && textContent === 'Load the whole model'),
    );
    assert.deepEqual(await seenAt(page, IN_CELLS), ['blue', 'blue', 'blue', 'blue']);
    const refusals = timesAsked('model.ply');
    assert.ok(refusals >= 1);

    service.told.refused.clear();
    await whole.click();
    await page.getByText(COPY_LINE, { exact: true }).waitFor({ state: 'hidden' });
    assert.deepEqual(await seenAt(page, IN_CELLS), ['red', 'red', 'red', 'red']);
    assert.ok(await whole.isHidden());
    assert.deepEqual([timesAsked('model.compressed.ply'), timesAsked('model.ply')], [1, refusals + 1]);
    await finish(opened, /404/);
});

test('a small finished model is loaded itself, and a huge copy only after a question', TIMEOUT, async () => {
    finishedWith(null, null);
    const small = await openViewer();
    await waitForViewer(small.page);
    assert.deepEqual(await seenAt(small.page, IN_CELLS), ['red', 'red', 'red', 'red']);
    assert.deepEqual([timesAsked('model.compressed.ply'), timesAsked('model.ply')], [0, 1]);
    assert.equal(await small.page.getByText('A copy for viewing').isVisible(), false);
    assert.equal(await small.page.getByRole('button', { name: 'Load the whole model' }).isVisible(), false);
    await finish(small);

    finishedWith(800e6, 200e6);
    const huge = await openViewer();
    await huge.page.getByRole('button', { name: 'Load the model (200 MB)' }).waitFor();
    assert.deepEqual([timesAsked('model.compressed.ply'), timesAsked('model.ply')], [0, 0]);
    await finish(huge);
});
