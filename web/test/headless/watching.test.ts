// What a page tells of a job while it trains, and of the workers, before a made-up service: shades of the map,
// the PSNR of previews, the divider between pictures, the latest lines of workers, and links that work once.

import assert from 'node:assert/strict';
import { join } from 'node:path';
import { after, before, test } from 'node:test';

import { timestampFromMs } from '@bufbuild/protobuf/wkt';
import type { Browser } from 'playwright-core';
import { PNG } from 'pngjs';

import { Role, WorkerState } from '../../src/rpc/fathom/admin/v1/admin_pb.ts';
import { JobState, Stage, TaskState } from '../../src/rpc/fathom/v1/job_pb.ts';
import { launch } from './browser.ts';
import { type MadeUp, json, serveMadeUp } from './made-up.ts';
import { type Opened, finish, fitsWindow, looksRight, openAs } from './steps.ts';

const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const TIMEOUT = { timeout: 120_000 };
const NOW = Date.now();
const CELLS = 6;

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

/** A picture of one colour. */
function picture(red: number): Buffer {
    const made = new PNG({ width: 64, height: 48 });
    made.data.forEach((_, at) => (made.data[at] = at % 4 === 0 ? red : at % 4 === 3 ? 255 : 80));
    return PNG.sync.write(made);
}
const blobOf = (digest: string) => ({
    digest,
    sizeBytes: BigInt(service.told.blobs.get(digest)?.length ?? 0),
});
const open = (section: string): Promise<Opened> => openAs(browser, `${service.address}/#/jobs/7${section}`);

const PLAN = {
    columns: 3,
    rows: 2,
    alignment: { down: [0, 1, 0], world_to_aligned_quat_wxyz: [1, 0, 0, 0] },
    extent: { viewing_distance: 4.7, cameras: { min: [-6, -5, -4], max: [6, -4, 4] } },
    views: 12,
    held_out: [0, 8],
    partitions: Array.from({ length: CELLS }, (_, id) => ({
        id,
        cell: {
            x: { lo: id % 3 === 0 ? null : 4 * (id % 3) - 6, hi: id % 3 === 2 ? null : 4 * (id % 3) - 2 },
            z: id < 3 ? { lo: null, hi: 0 } : { lo: 0, hi: null },
        },
        extended_box: { min: [-7, -5, -5], max: [7, 5, 5] },
        base_views: [id],
        chosen_views: Array.from({ length: 4 + id }, (__, view) => view),
        filled_views: id === 0 ? 3 : 0,
        cell_points: 100,
        iterations: 6000,
        max_gaussians: 1000,
    })),
};

const manifestView = (name: string, place: number) => ({
    name: `${name}.png`,
    image: { digest: 'photograph' },
    pose: { rotation: [0, 0, 0, 1], translation: [3 * place - 1, 4, 2] },
});

/** Two views of each partition but the last, which get better; the first partition is the worst. */
function tell(): void {
    for (const name of ['render', 'clear']) {
        service.told.blobs.set(name, picture(name === 'render' ? 120 : 220));
    }
    service.told.blobs
        .set('photograph', picture(20))
        .set('plan', json(PLAN))
        .set('manifest', json({ views: ['a', 'b'].map(manifestView) }));
    const tasks = Array.from({ length: CELLS }, (_, partition) => ({
        taskId: `partition-000${partition}`,
        stage: Stage.PARTITION,
        partition,
        state: partition === CELLS - 1 ? TaskState.READY : TaskState.LEASED,
        attempts: 1,
        worker: partition === CELLS - 1 ? '' : `reef-gpu-${partition % 3}`,
        progress: { iteration: 900, iterations: 6000 },
    }));
    service.told.job = {
        jobId: '7',
        name: 'Transect 7',
        state: JobState.RUNNING,
        stage: Stage.PARTITION,
        partitions: CELLS,
        progress: 0.4,
        createTime: timestampFromMs(NOW - 600_000),
        plan: blobOf('plan'),
        manifest: blobOf('manifest'),
        tasks,
    };
    service.told.history = {
        tasks: tasks.slice(0, -1).map(({ taskId, partition }) => ({
            taskId,
            points: [100, 500, 900].map((iteration) => ({
                time: timestampFromMs(NOW - 300_000 + 100 * iteration),
                attempt: 1,
                progress: { iteration, iterations: 6000, loss: 10 / iteration, gaussians: iteration },
            })),
            previews: [200, 800].flatMap((iteration) =>
                ['a.png', 'b.png'].map((view, place) => ({
                    view,
                    iteration,
                    render: blobOf('render'),
                    clear: blobOf('clear'),
                    psnrDb: 20 + partition + 2 * place + iteration / 1000,
                })),
            ),
        })),
    };
}

test('the map shades cells by worker, PSNR and cameras, with a legend', TIMEOUT, async () => {
    tell();
    const opened = await open('');
    const { page } = opened;
    const select = page.getByLabel('Shade cells by');
    await select.waitFor();
    assert.equal(await select.inputValue(), 'state');
    const legend = page.getByRole('list', { name: 'Shades of the cells' });
    assert.equal(await legend.isVisible(), false);
    const items = (): Promise<string[]> => legend.getByRole('listitem').allTextContents();
    await select.selectOption('Worker');
    assert.deepEqual(await items(), [
        'reef-gpu-0: 2 cells',
        'reef-gpu-1: 2 cells',
        'reef-gpu-2: 1 cell',
        'plain: no worker, 1 cell',
    ]);
    await looksRight(opened, 'map-worker');
    await select.selectOption('PSNR');
    // The mean over both views: from 21.8 to 25.8 dB.
    await legend.getByText('25 to 26 dB').waitFor();
    assert.deepEqual(await items(), [
        '21 to 22 dB',
        '22 to 23 dB',
        '23 to 24 dB',
        '24 to 25 dB',
        '25 to 26 dB',
        'hatched: no PSNR yet, 1 cell',
    ]);
    await page.getByText('The plan as a table').click();
    await page.getByRole('row', { name: 'reef-gpu-0' }).first().getByText('21.80 dB (previews)').waitFor();
    await looksRight(opened, 'map-psnr');
    await select.selectOption('Seen by few cameras');
    assert.equal((await items()).at(-1), 'hatched: seen by too few, 1 cell');
    await looksRight(opened, 'map-cameras');
    await finish(opened);
});

test('the curve of the PSNR is that of previews where nothing was measured', TIMEOUT, async () => {
    tell();
    const opened = await open('/curves');
    const { page } = opened;
    const chart = page.locator('.fp-curve').filter({ has: page.getByRole('heading', { name: 'PSNR of previews, dB' }) });
    await chart.getByText('Partition 0, previews 21.80').waitFor();
    await finish(opened);
});

test('previews are told with their PSNR, the worst first, also without water beside them', TIMEOUT, async () => {
    tell();
    const opened = await open('/views');
    const { page } = opened;
    await page.getByText('10 views, worst PSNR first').waitFor();
    const labels = await page.locator('.fp-compare-words').allTextContents();
    assert.deepEqual(labels.slice(0, 4), [
        'a.png20.80 dB, Partition 0',
        'a.png21.80 dB, Partition 1',
        'a.png22.80 dB, Partition 2',
        'b.png22.80 dB, Partition 0',
    ]);
    await page.getByText('Partition 0, PSNR 20.80 dB').waitFor();
    await page.getByRole('slider', { name: 'Divider between photograph and render' }).waitFor();
    await page.getByLabel('Divider between', { exact: true }).selectOption('Render and scene without water');
    const divider = page.getByRole('slider', { name: 'Divider between render and scene without water' });
    await divider.press('End');
    assert.equal(await divider.getAttribute('aria-valuetext'), '100 % render, then scene without water');
    await page.getByText('The render on the left of the divider, the scene without water on its right.').waitFor();
    await divider.press('PageDown');
    await looksRight(opened, 'views');
    await finish(opened);
});

test('workers are told with their rate and their latest line', TIMEOUT, async () => {
    service.told.role = Role.OPERATOR;
    const worker = { state: WorkerState.ACTIVE, adapter: 'NVIDIA H100 80GB HBM3', connected: true, buildVersion: '1.2.3' };
    service.told.workers = [
        {
            ...worker,
            workerId: 'w1',
            name: 'reef-gpu-1',
            lastSeen: timestampFromMs(NOW),
            iterationsPerSecond: 41.26,
            lastWords: `checkpoint of partition-0003 at iteration 5,000: ${'x'.repeat(120)} ${'words '.repeat(20)}`,
            lastWordsTime: timestampFromMs(NOW - 65_000),
            held: [{ jobId: '7', taskId: 'partition-0003', attempt: 1 }],
        },
        { ...worker, workerId: 'w2', name: 'reef-gpu-2' },
    ];
    const opened = await openAs(browser, `${service.address}/#/service`);
    const { page } = opened;
    const row = page.getByRole('row', { name: 'reef-gpu-1' });
    await row.getByText('41.3 /s').waitFor();
    await row.getByText('checkpoint of partition-0003').waitFor();
    const time = row.locator('time');
    assert.match((await time.textContent()) ?? '', /^1 min \d+ s ago$/);
    assert.equal(await time.getAttribute('datetime'), new Date(NOW - 65_000).toISOString());
    assert.equal(await page.getByRole('row', { name: 'reef-gpu-2' }).locator('time').count(), 0);
    await looksRight(opened, 'workers');
    // What a card hides beyond its edge does not widen the page.
    for (const width of [725, 760, 900, 1000, 1200]) {
        await page.setViewportSize({ width, height: 800 });
        await fitsWindow(page, `workers, ${width}`);
        const hidden = await page.evaluate(() => {
            const card = document.querySelector('.card.flush')!;
            return card.scrollWidth - card.clientWidth;
        });
        assert.ok(hidden <= 0, `${hidden} pixels of the table are hidden at ${width}`);
    }
    await finish(opened);
    delete service.told.role;
});

test('a link with an invitation works once, and the tab keeps its session', TIMEOUT, async () => {
    tell();
    service.told.invitation = 'once';
    const opened = await openAs(browser, `${service.address}/#invitation=once`);
    const { page } = opened;
    await page.getByRole('heading', { name: 'Transect 7' }).waitFor();
    assert.match(page.url(), /#\/jobs\/7$/, 'to the only job, without the invitation');
    assert.deepEqual(await page.evaluate(() => ({ ...sessionStorage })), { 'fathom.token': 'session' });
    await page.reload();
    await page.getByRole('heading', { name: 'Transect 7' }).waitFor();
    const used = await openAs(browser, `${service.address}/#invitation=once`);
    await used.page.getByText('This link was used before, or its run has ended.').waitFor();
    assert.ok(!used.page.url().includes('once'));
    // In the tab that has a session the same link leads to the job.
    await page.goto(`${service.address}/#invitation=once`);
    await page.getByRole('heading', { name: 'Transect 7' }).waitFor();
    await finish(opened, /401/);
    await looksRight(used, 'invitation-used');
    await finish(used, /401/);
    delete service.told.invitation;
});
