// The pages around a new job, before a real service: datasets, the form, previews while it trains, and links.
//
// FATHOM names the program, PAGES the built pages (default: dist). Without FATHOM the tests are skipped.

import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import type { Browser, Page } from 'playwright-core';

import { createClient } from '@connectrpc/connect';
import { createGrpcWebTransport } from '@connectrpc/connect-web';

import { UploadService } from '../../src/rpc/fathom/v1/upload_pb.ts';
import { launch, newPage } from './browser.ts';
import { Service, serveWith } from './service.ts';
import { type Opened, accessible, finish, fitsWindow, openAs, until } from './steps.ts';

const FATHOM = process.env['FATHOM'] ?? '';
const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const skip = FATHOM === '' ? 'FATHOM does not name the program' : false;
const TIMEOUT = { timeout: 90_000 };
/** Previews come as often as they can, and training lasts until it is cancelled. */
const ADVANCED = '{"train": {"preview_seconds": 1}, "data": {"max_resolution": 96}}';
const PHONE = { viewport: { width: 360, height: 740 }, colorScheme: 'dark' } as const;

interface HistoryJson {
    readonly tasks: readonly {
        readonly task: string;
        readonly points: readonly { readonly iterations: number }[];
        readonly previews: readonly { readonly view: string; readonly iteration: number; readonly render: string }[];
    }[];
}

let folder = '';
let data = '';
let service: Service;
let serving: Awaited<ReturnType<typeof serveWith>>;
let browser: Browser;
const tokens = { ana: '', vera: '', worker: '' };
/** The job that the form creates. */
let job = '';

const open = (route: string, token: string, options = {}): Promise<Opened> => openAs(browser, `${serving.address}/${route}`, token, options);
const historyOf = (): Promise<HistoryJson> => service.api<HistoryJson>(tokens.ana, `jobs/${job}/history`);

before(async () => {
    if (skip !== false) {
        return;
    }
    folder = mkdtempSync(join(tmpdir(), 'fathom-submit-'));
    data = join(folder, 'reef');
    service = await Service.start(FATHOM, folder);
    execFileSync(FATHOM, ['synth', data, '--views', '20', '--size', '96x72'], { stdio: 'ignore' });
    tokens.ana = service.token('ana', '--role', 'submitter', '--tenant', 'reef');
    tokens.vera = service.token('vera', '--role', 'viewer', '--tenant', 'reef');
    tokens.worker = service.token('gpu', '--role', 'worker');
    serving = await serveWith(PAGES, service.webPort);
    browser = await launch();
}, TIMEOUT);

after(async () => {
    await browser?.close();
    serving?.close();
    await service?.stop();
    if (folder !== '') {
        rmSync(folder, { recursive: true, force: true });
    }
});

test('a job is created once from a dataset, and wrong settings are named at their fields', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/jobs', tokens.ana);
    const { page } = opened;
    await page.getByRole('link', { name: 'New job' }).click();
    await page.getByRole('heading', { name: 'No datasets yet' }).waitFor();
    const command = await page.getByLabel('Command').inputValue();
    assert.match(command, /^fathom dataset upload DATA --id NAME --coordinator \S+ --token-file FILE$/);
    await accessible(page, 'a new job without datasets');
    service.run(tokens.ana, 'dataset', 'upload', data, '--id', 'reef-7', '--coordinator', service.url);
    await page.getByLabel('Dataset').waitFor();
    assert.equal(await page.getByLabel('Dataset').inputValue(), 'reef-7');

    await page.getByLabel('Name').fill('Reef <7>');
    await page.getByLabel('Partitions').selectOption('grid');
    await page.getByLabel('Columns', { exact: true }).fill('1');
    await page.getByLabel('Rows').fill('1');
    await page.getByLabel('Most Gaussians').fill('1000');
    await page.getByLabel('Priority').fill('3');
    await page.getByText('Advanced settings', { exact: true }).click();
    const advanced = page.getByLabel('Advanced settings, JSON by section');
    const create = page.getByRole('button', { name: 'Create the job' });
    const wrong: readonly (readonly [text: string, said: RegExp])[] = [
        ['{"train": ', /This is not JSON/],
        ['{"train": {"iterations": 5}}', /train\.iterations has a field above/],
        ['{"train": {"ssim_wait": 0.3}}', /train\.ssim_wait: unknown field `ssim_wait`/],
        ['{"train": {"ssim_weight": 3}}', /train\.ssim_weight/],
    ];
    for (const [text, said] of wrong) {
        await advanced.fill(text);
        await create.click();
        await page.getByText(said).waitFor();
        assert.equal(await advanced.getAttribute('aria-invalid'), 'true', text);
    }
    await accessible(page, 'a new job with a wrong setting');
    await advanced.fill(ADVANCED);
    await page.getByLabel('Iterations').fill('500000');
    await create.dblclick();
    await page.getByRole('heading', { name: 'Reef <7>' }).waitFor();
    job = /#\/jobs\/([^/]+)$/.exec(page.url())?.[1] ?? '';
    const { jobs } = await service.api<{ jobs: readonly { job: string; dataset: string; priority: number }[] }>(tokens.ana, 'jobs');
    assert.deepEqual(jobs.map((one) => [one.job, one.dataset, one.priority]), [[job, 'reef-7', 3]]);
    const { config } = await service.api<{ config: Record<string, Record<string, unknown>> }>(tokens.ana, `jobs/${job}`);
    const { train, partition } = config;
    assert.deepEqual(
        [train?.['iterations'], train?.['max_gaussians'], train?.['preview_seconds'], partition?.['columns'], partition?.['auto']],
        [500_000, 1000, 1, 1, false],
    );
    await page.getByRole('link', { name: 'Views' }).click();
    await page.getByRole('heading', { name: 'No previews yet' }).waitFor();
    await accessible(page, 'no previews yet');
    // It trains while the next tests do something else.
    service.startWorker(tokens.worker, 'gpu-1');
    await finish(opened, /400/);

    const viewer = await open('#/new', tokens.vera);
    await viewer.page.getByText('Only submitters and operators create jobs.').waitFor();
    await finish(viewer);
});

test('datasets are listed, and one that a job uses is not deleted', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/datasets', tokens.ana);
    const { page } = opened;
    const row = page.getByRole('row', { name: 'reef-7' });
    await row.getByText('Complete').waitFor();
    const { datasets } = await service.api<{ datasets: readonly { files: number }[] }>(tokens.ana, 'datasets');
    await row.getByText(String(datasets[0]!.files), { exact: true }).waitFor();
    await accessible(page, 'datasets');
    await row.getByRole('button', { name: 'Delete reef-7' }).click();
    await page.getByRole('button', { name: 'Delete the dataset' }).click();
    await page.getByText('Delete the jobs that use it first.').waitFor();
    await accessible(page, 'a dataset in use');
    await page.getByRole('button', { name: 'Keep it' }).click();
    await finish(opened, /40[049]|412/);
});

/** Whether the picture on the page is the JPEG with these bytes. */
const isPicture = (page: Page, jpeg: Uint8Array): Promise<boolean> =>
    page.evaluate(async (bytes) => {
        const image = document.querySelector<HTMLImageElement>('.fp-compare-stage img:not([hidden])')!;
        const expected = await createImageBitmap(new Blob([new Uint8Array(bytes)], { type: 'image/jpeg' }));
        const pixels = (picture: CanvasImageSource): string => {
            const canvas = document.createElement('canvas');
            [canvas.width, canvas.height] = [expected.width, expected.height];
            const context = canvas.getContext('2d')!;
            context.drawImage(picture, 0, 0);
            return context.getImageData(0, 0, canvas.width, canvas.height).data.join(' ');
        };
        return image.complete && image.naturalWidth === expected.width && pixels(image) === pixels(expected);
    }, [...jpeg]);

async function blobOf(digest: string): Promise<Uint8Array> {
    const transport = createGrpcWebTransport({
        baseUrl: `http://127.0.0.1:${service.webPort}`,
        interceptors: [
            (next) => (request) => {
                request.header.set('authorization', `Bearer ${tokens.ana}`);
                return next(request);
            },
        ],
    });
    const pieces: Uint8Array[] = [];
    for await (const { data: piece } of createClient(UploadService, transport).readBlob({ digest, jobId: job })) {
        pieces.push(piece);
    }
    return Buffer.concat(pieces);
}

test('previews appear while a job trains, and are those of its history', { skip, ...TIMEOUT }, async () => {
    const opened = await open(`#/jobs/${job}/views`, tokens.ana);
    const { page } = opened;
    const entries = page.locator('.fp-compare-list li');
    await entries.first().waitFor();
    const slider = page.getByRole('slider', { name: 'Training' });
    await until('a second preview', async () => Number(await slider.getAttribute('max')) > 0);
    await page.getByRole('button', { name: 'Pause' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Pause' }).click();
    // A dialog gives the focus back when it closes.
    await page.locator('dialog').waitFor({ state: 'detached' });

    // What is known of the first view does not change any more, only what follows.
    const history = await historyOf();
    const { task, previews } = history.tasks[0]!;
    const views = [...new Set(previews.map(({ view }) => view))].toSorted();
    assert.equal(task, 'partition-0000');
    await until('all views', async () => (await entries.count()) >= views.length);
    assert.deepEqual((await entries.locator('.fp-compare-name').allTextContents()).slice(0, views.length), views);
    const first = previews.find(({ view }) => view === views[0])!;
    await slider.focus();
    await page.keyboard.press('Home');
    await page.getByText(`Iteration ${first.iteration.toLocaleString('en')} of 500,000`).waitFor();
    await page.getByLabel('Render', { exact: true }).check();
    const jpeg = await blobOf(first.render);
    await until('the first render', () => isPicture(page, jpeg));
    await page.getByLabel('Without water').check();
    await page.getByText('The trained scene without its water.').waitFor();
    await page.getByLabel('Compare').check();
    await page.getByRole('slider', { name: 'Divider between photograph and render' }).waitFor();
    await accessible(page, 'previews');
    await finish(opened);

    const phone = await open(`#/jobs/${job}/views`, tokens.vera, PHONE);
    await phone.page.locator('.fp-compare-stage img').first().waitFor();
    await fitsWindow(phone.page, 'previews');
    await accessible(phone.page, 'previews on a phone');
    await finish(phone);
});

test('a preview that is gone is said to be gone', { skip, ...TIMEOUT }, async () => {
    const opened = await newPage(browser, {});
    const { page } = opened;
    // As the service answers once the file is deleted: for a digest that it does not have.
    await page.route('**/fathom.v1.UploadService/ReadBlob', async (route) => {
        const body = route.request().postDataBuffer()!;
        const { previews } = (await historyOf()).tasks[0]!;
        const isPreview = previews.some(({ render }) => body.includes(render));
        await (isPreview ? route.continue({ postData: Buffer.from(body.toString('latin1').replace(/[0-9a-f]{64}/, 'a'.repeat(64)), 'latin1') }) : route.continue());
    });
    await page.goto(`${serving.address}/#/jobs/${job}/views?token=${tokens.vera}`);
    await page.getByText('This picture is gone').waitFor();
    await page.getByLabel('Photograph', { exact: true }).check();
    await page.locator('.fp-compare-stage img').first().waitFor();
    await finish(opened, /404/);
});

test('the list of jobs shows the newest preview', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/jobs', tokens.ana);
    const isDrawn = (): Promise<boolean> =>
        opened.page.evaluate(() => {
            const canvas = document.querySelector<HTMLCanvasElement>('.job-thumb');
            const pixels = canvas?.getContext('2d', { willReadFrequently: true })?.getImageData(0, 0, canvas.width, canvas.height).data ?? [];
            return pixels.some((value) => value > 0);
        });
    await until('a picture', isDrawn);
    await accessible(opened.page, 'a list with pictures');
    await finish(opened);
});

test('links: one job for a guest, and a token alone leads to the only job', { skip, ...TIMEOUT }, async () => {
    const opened = await open(`#/jobs/${job}`, tokens.ana);
    const { page } = opened;
    await page.getByRole('button', { name: 'Share' }).click();
    await page.getByLabel('The link is valid for').selectOption('1 hour');
    await page.getByRole('button', { name: 'Make a link' }).click();
    const link = await page.getByLabel('Link', { exact: true }).inputValue();
    await finish(opened);

    const guest = await newPage(browser, {});
    await guest.page.goto(link);
    await guest.page.getByRole('heading', { name: 'Reef <7>' }).waitFor();
    assert.equal(new URL(guest.page.url()).hash, `#/jobs/${job}`);
    await guest.page.getByText('Shared job, read only, until').waitFor();
    assert.equal(await guest.page.locator('.job-head').getByRole('button').count(), 0);
    assert.equal(await guest.page.getByRole('navigation', { name: 'Pages' }).getByRole('link').count(), 0);
    await guest.page.getByRole('link', { name: 'Views' }).click();
    await guest.page.locator('.fp-compare-stage img').first().waitFor();
    for (const elsewhere of ['#/jobs', '#/datasets', '#/new', '#/service']) {
        await guest.page.evaluate((hash) => (location.hash = hash), elsewhere);
        await until('the shared job stays', async () => new URL(guest.page.url()).hash === `#/jobs/${job}`);
    }
    await accessible(guest.page, 'a shared job');
    await finish(guest);

    const bare = await newPage(browser, {});
    await bare.page.goto(`${serving.address}/#token=${tokens.vera}`);
    await bare.page.getByRole('heading', { name: 'Reef <7>' }).waitFor();
    assert.equal(new URL(bare.page.url()).hash, `#/jobs/${job}`);
    await finish(bare);
});

test('a job and its dataset are deleted', { skip, ...TIMEOUT }, async () => {
    const opened = await open(`#/jobs/${job}`, tokens.ana);
    const { page } = opened;
    service.run(tokens.ana, 'cancel', job, '--coordinator', service.url);
    await page.getByRole('button', { name: 'Delete' }).click();
    await page.getByRole('button', { name: 'Delete the job' }).click();
    await page.getByRole('heading', { name: 'No jobs yet' }).waitFor();
    await page.getByRole('link', { name: 'Datasets' }).click();
    await page.getByRole('button', { name: 'Delete reef-7' }).click();
    await page.getByRole('button', { name: 'Delete the dataset' }).click();
    await page.getByRole('heading', { name: 'No datasets yet' }).waitFor();
    await finish(opened, /404/);
});
