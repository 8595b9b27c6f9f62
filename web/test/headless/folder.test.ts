// A folder that is submitted from the page, before a real service: upload, check, job.
//
// FATHOM names the program, PAGES the built pages (default: dist). Without FATHOM the tests are skipped.
// PICTURES names a folder for pictures of the pages, to look at.

import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import {
    copyFileSync,
    cpSync,
    mkdirSync,
    mkdtempSync,
    readFileSync,
    rmSync,
    truncateSync,
    writeFileSync,
} from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import type { Browser, Page } from 'playwright-core';

import { createClient } from '@connectrpc/connect';
import { createGrpcWebTransport } from '@connectrpc/connect-web';

import { UploadService } from '../../src/rpc/fathom/v1/upload_pb.ts';
import { sentence } from '../../src/pages/format.ts';
import { launch } from './browser.ts';
import { type JobJson, Service, serveWith } from './service.ts';
import { type Opened, accessible, finish, fitsWindow, openAs, sleep, until } from './steps.ts';

const FATHOM = process.env['FATHOM'] ?? '';
const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const PICTURES = process.env['PICTURES'] ?? '';
const skip = FATHOM === '' ? 'FATHOM does not name the program' : false;
const TIMEOUT = { timeout: 120_000 };
const PHONE = { viewport: { width: 390, height: 844 }, colorScheme: 'dark' } as const;
const CALL = (name: string): string => `**/fathom.v1.UploadService/${name}`;
/** Of the large file, in pieces of a MiB. */
const LARGE_BYTES = 5_500_000;
const VIEWS = 20;

interface InspectJson {
    readonly source: string;
    readonly unseen: number;
    readonly cameras: readonly unknown[];
    readonly images: readonly { readonly mask: string | null }[];
    readonly counts: Readonly<Record<string, number>>;
    readonly warnings: readonly string[];
    readonly plan: {
        readonly held_out: readonly number[];
        readonly partitions: readonly { readonly base_views: readonly number[] }[];
    };
}

let folder = '';
let data = '';
let service: Service;
let serving: Awaited<ReturnType<typeof serveWith>>;
let browser: Browser;
const tokens = { ana: '', worker: '' };

const open = (route: string, options = {}): Promise<Opened> =>
    openAs(browser, `${serving.address}/${route}`, tokens.ana, options);
const input = (page: Page) => page.locator('input[webkitdirectory]');
const start = (page: Page) => page.getByRole('button', { name: 'Upload and check' });
/** A screen reader is told the same, so the text alone is there twice. */
const listed = (page: Page, text: string): Promise<void> =>
    page.locator('.folder-title', { hasText: text }).waitFor();
const progress = (page: Page, text: string | RegExp): Promise<void> =>
    page.locator('.folder-progress').getByText(text).waitFor();
const picture = async (page: Page, name: string): Promise<void> => {
    if (PICTURES !== '') {
        await page.screenshot({ path: join(PICTURES, `${name}.png`), fullPage: true });
    }
};
const datasets = async (): Promise<readonly string[]> => {
    const { datasets: all } = await service.api<{ datasets: readonly { dataset: string }[] }>(
        tokens.ana,
        'datasets',
    );
    return all.map(({ dataset }) => dataset).toSorted();
};
const inspect = (scene: string, ...flags: readonly string[]): InspectJson =>
    JSON.parse(
        execFileSync(FATHOM, ['inspect', scene, '--json', '--no-plan', ...flags], {
            encoding: 'utf8',
            stdio: ['ignore', 'pipe', 'ignore'],
        }),
    ) as InspectJson;

/** The facts of the check on the page, by name. */
async function facts(page: Page): Promise<ReadonlyMap<string, string>> {
    const list = page.locator('.plan-check-facts');
    const [names, values] = [
        await list.locator('dt').allTextContents(),
        await list.locator('dd').allTextContents(),
    ];
    return new Map(names.map((name, at) => [name, values[at]!]));
}

/** The page shows what `fathom inspect` says. */
async function agrees(page: Page, said: InspectJson): Promise<void> {
    const shown = await facts(page);
    const number = (name: string): number => Number(shown.get(name)?.replaceAll(/\D/g, ''));
    assert.match(shown.get('Views') ?? '', new RegExp(`^${said.images.length}, each`));
    assert.deepEqual(
        [number('Held out'), number('Cameras'), number('Sparse points'), number('Partitions')],
        [said.plan.held_out.length, said.cameras.length, said.counts['points'], said.plan.partitions.length],
    );
    assert.equal(said.images.filter(({ mask }) => mask !== null).length, 0);
    assert.equal(shown.get('Masks'), 'none');
    assert.ok(said.source.startsWith(shown.get('Format') ?? '?'), `${said.source}: ${shown.get('Format')}`);
    assert.equal(
        shown.get('Seen by fewer than two views'),
        `${(100 * said.unseen).toFixed(1)} % of what the held-out views show`,
    );
    // What few views see is a fact here, and only a service knows that it has no workers.
    const warnings = said.warnings.filter((text) => !text.includes('is in fewer than two training views'));
    const shownWarnings = await page.locator('.plan-check-warnings li').allTextContents();
    assert.deepEqual(
        shownWarnings.filter((text) => !text.startsWith('No worker was connected')),
        warnings.map(sentence),
    );
    const canvas = page.getByRole('application', { name: `Map of ${said.plan.partitions.length} partition` });
    await canvas.waitFor();
}

const client = () =>
    createClient(
        UploadService,
        createGrpcWebTransport({
            baseUrl: `http://127.0.0.1:${service.webPort}`,
            interceptors: [
                (next) => (request) => {
                    request.header.set('authorization', `Bearer ${tokens.ana}`);
                    return next(request);
                },
            ],
        }),
    );

/** What a call over gRPC-Web says, from the page's request. */
const countCalls = (page: Page, name: string): { count: number } => {
    const calls = { count: 0 };
    page.on('request', (request) => {
        calls.count += request.url().endsWith(`UploadService/${name}`) ? 1 : 0;
    });
    return calls;
};

before(async () => {
    if (skip !== false) {
        return;
    }
    folder = mkdtempSync(join(tmpdir(), 'fathom-folder-'));
    data = join(folder, 'Reef Süd');
    service = await Service.start(FATHOM, folder);
    execFileSync(FATHOM, ['synth', data, '--views', String(VIEWS), '--size', '96x72'], { stdio: 'ignore' });
    rmSync(join(data, 'truth'), { recursive: true });
    writeFileSync(
        join(data, 'survey.bin'),
        Uint8Array.from({ length: LARGE_BYTES }, (_, at) => (at * at) >> 5),
    );
    writeFileSync(join(data, '.DS_Store'), 'x');
    writeFileSync(join(data, 'images', 'Thumbs.db'), 'x');
    writeFileSync(join(data, 'database.db'), 'y'.repeat(1000));
    mkdirSync(join(data, 'images_2'));
    copyFileSync(join(data, 'images', 'v0001.png'), join(data, 'images_2', 'v0001.png'));
    tokens.ana = service.token('ana', '--role', 'submitter', '--tenant', 'reef');
    tokens.worker = service.token('gpu', '--role', 'worker');
    serving = await serveWith(PAGES, service.webPort);
    browser = await launch();
    if (PICTURES !== '') {
        mkdirSync(PICTURES, { recursive: true });
    }
}, TIMEOUT);

after(async () => {
    await browser?.close();
    serving?.close();
    await service?.stop();
    if (folder !== '') {
        rmSync(folder, { recursive: true, force: true });
    }
});

test('a chosen folder is listed, without junk and what is derived', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/new');
    const { page } = opened;
    await page.getByRole('heading', { name: 'No datasets yet' }).waitFor();
    await page.getByRole('button', { name: 'Choose a folder' }).waitFor();
    await accessible(page, 'a new job without a folder');
    await picture(page, 'empty');
    // With the keyboard alone.
    const choosing = page.waitForEvent('filechooser');
    await page.getByRole('button', { name: 'Choose a folder' }).press('Enter');
    await (await choosing).setFiles(data);
    await listed(page, `Reef Süd: ${VIEWS + 4} files, 6.`);
    await page.getByText('2 hidden and system files are left out.', { exact: true }).waitFor();
    const database = page.getByLabel('COLMAP database (1 file, 1.00 kB)');
    assert.equal(await database.isChecked(), false);
    assert.equal(await page.getByLabel('Smaller copies: images_2 (1 file').isChecked(), false);
    await database.check();
    await listed(page, `Reef Süd: ${VIEWS + 5} files, 6.`);
    await database.uncheck();
    const id = page.getByLabel('Upload as');
    assert.equal(await id.inputValue(), 'reef-sud');
    await accessible(page, 'a chosen folder');
    await picture(page, 'chosen');
    await id.fill('Reef 7');
    await start(page).click();
    await page.getByText('A name has 1 to 64 lower-case letters').waitFor();
    assert.equal(await id.getAttribute('aria-invalid'), 'true');
    await page.getByRole('button', { name: 'Create the job' }).click();
    await page.getByText('First upload the folder.').waitFor();
    await accessible(page, 'a wrong name of a dataset');
    assert.deepEqual(await datasets(), []);
    await finish(opened);
});

test(
    'an upload goes on after the coordinator died, and what was read is that of fathom inspect',
    { skip, ...TIMEOUT },
    async () => {
        const opened = await open('#/new');
        const { page } = opened;
        const writes = countCalls(page, 'WriteChunk');
        // Slow enough to be in the middle of it.
        await page.route(CALL('WriteChunk'), async (route) => {
            await sleep(200);
            await route.continue();
        });
        await input(page).setInputFiles(data);
        await start(page).click();
        await progress(page, /^Uploading: .* of 6\.\d+ MB/);
        await until('some files', async () => writes.count > 5);
        await service.kill();
        await progress(page, 'The service does not answer; trying again.');
        await accessible(page, 'an upload that waits');
        await picture(page, 'waiting');
        assert.equal(await page.getByRole('button', { name: 'Upload and check' }).isDisabled(), true);
        await service.startCoordinator();
        await page.getByText('Uploaded as "reef-sud".').waitFor();
        await page.locator('.plan-check-facts').waitFor();
        await agrees(page, inspect(data, '--partitions', 'auto'));
        await accessible(page, 'a check');
        await picture(page, 'checked');
        assert.deepEqual(await datasets(), ['reef-sud']);
        await finish(opened, /ERR_|50[0-9]|40[0-9]|Failed to load/);
    },
);

test('an upload waits while the computer is offline', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/new');
    const { page } = opened;
    const other = join(folder, 'offline');
    mkdirSync(other);
    writeFileSync(
        join(other, 'a.bin'),
        Uint8Array.from({ length: 3_000_000 }, (_, at) => (at * at) >> 7),
    );
    let pieces = 0;
    await page.route(CALL('WriteChunk'), async (route) => {
        pieces += 1;
        await (pieces === 2 ? page.context().setOffline(true) : Promise.resolve());
        await route.continue();
    });
    await page.getByText('A folder on this computer').waitFor();
    await input(page).setInputFiles(other);
    await start(page).click();
    await progress(page, 'This computer is offline.');
    await accessible(page, 'an upload that is offline');
    await page.context().setOffline(false);
    await page.getByText('Uploaded as "offline".').waitFor();
    assert.ok(pieces >= 3);
    service.run(tokens.ana, 'dataset', 'delete', 'offline', '--coordinator', service.url);
    await finish(opened, /ERR_|412|400|Failed to load/);
});

test('a cancelled upload goes on where it stopped, also in another page', { skip, ...TIMEOUT }, async () => {
    const other = join(folder, 'cancelled');
    mkdirSync(other);
    writeFileSync(
        join(other, 'a.bin'),
        Uint8Array.from({ length: 3_000_000 }, (_, at) => (at * at) >> 9),
    );
    const first = await open('#/new');
    let pieces = 0;
    await first.page.route(CALL('WriteChunk'), async (route) => {
        pieces += 1;
        // The second piece never arrives.
        await (pieces === 1 ? route.continue() : new Promise(() => {}));
    });
    await first.page.getByText('A folder on this computer').waitFor();
    await input(first.page).setInputFiles(other);
    await start(first.page).click();
    await until('the second piece', async () => pieces === 2);
    await first.page.getByRole('button', { name: 'Cancel' }).click();
    await first.page.getByText('Cancelled. What has arrived stays').waitFor();
    await first.page.context().close();

    const opened = await open('#/new');
    const writes = countCalls(opened.page, 'WriteChunk');
    await opened.page.getByText('A folder on this computer').waitFor();
    await input(opened.page).setInputFiles(other);
    await start(opened.page).click();
    await opened.page.getByText('Uploaded as "cancelled".').waitFor();
    assert.equal(writes.count, 2);
    service.run(tokens.ana, 'dataset', 'delete', 'cancelled', '--coordinator', service.url);
    await finish(opened, /412|400/);
});

test('a page that is closed while it uploads asks first', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/new');
    const { page } = opened;
    await page.route(CALL('BeginUpload'), () => {});
    await page.getByLabel('A folder on this computer').check();
    await input(page).setInputFiles(data);
    await listed(page, 'Reef Süd: ');
    const asked: string[] = [];
    page.on('dialog', (dialog) => {
        asked.push(dialog.type());
        void dialog.accept();
    });
    await start(page).click();
    await progress(page, 'Asking what the service has already');
    await page.getByRole('button', { name: 'Cancel' }).click();
    await page.getByText('Cancelled. What has arrived stays').waitFor();
    await start(page).click();
    await progress(page, 'Asking what the service has already');
    await page.getByRole('link', { name: 'All datasets' }).click();
    await page.getByText('The upload has stopped. Choose the same folder again to go on.').waitFor();
    await page.goBack();
    await page.getByLabel('A folder on this computer').check();
    await input(page).setInputFiles(data);
    await start(page).click();
    await progress(page, 'Asking what the service has already');
    await page.close({ runBeforeUnload: true });
    await until('the question', async () => asked.length > 0);
    assert.deepEqual(asked, ['beforeunload']);
    await opened.page.context().close();
});

test('the same folder again sends nothing', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/new');
    const { page } = opened;
    const [writes, begins] = [countCalls(page, 'WriteChunk'), countCalls(page, 'BeginUpload')];
    // There is a dataset now, and it comes first.
    await page.getByLabel('Dataset').waitFor();
    await input(page).setInputFiles(data);
    assert.equal(await page.getByLabel('A folder on this computer').isChecked(), true);
    await start(page).click();
    await page.getByText('Uploaded as "reef-sud".').waitFor();
    await page.locator('.plan-check-facts').waitFor();
    assert.deepEqual([writes.count, begins.count], [0, 1]);
    assert.deepEqual(await datasets(), ['reef-sud']);
    await finish(opened);
});

test('only what changed is sent, under a new name', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/new');
    const { page } = opened;
    const writes = countCalls(page, 'WriteChunk');
    writeFileSync(join(data, 'notes.txt'), 'visibility 8 m');
    await input(page).setInputFiles(data);
    const name = page.getByLabel('Upload as');
    await name.fill('reef-sud');
    await start(page).click();
    await page.getByText('There is a dataset of this name with other files.').waitFor();
    await accessible(page, 'a name that is taken');
    await name.fill('reef-8');
    await name.press('Enter');
    await page.getByText('Uploaded as "reef-8".').waitFor();
    assert.equal(writes.count, 1);
    rmSync(join(data, 'notes.txt'));
    service.run(tokens.ana, 'dataset', 'delete', 'reef-8', '--coordinator', service.url);
    await finish(opened, /409/);
});

test('a folder that changed after it was chosen is named', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/new');
    const { page } = opened;
    const other = join(folder, 'changing');
    cpSync(data, other, { recursive: true });
    await input(page).setInputFiles(other);
    await listed(page, 'changing: ');
    await sleep(50);
    writeFileSync(join(other, 'images', 'v0002.png'), 'other');
    await start(page).click();
    await page.getByText('"images/v0002.png" cannot be read: it was changed').waitFor();
    await accessible(page, 'a file that changed');
    await finish(opened);
});

test(
    'a folder that is no scene, and a picture that is not complete, are refused with what to do',
    { skip, ...TIMEOUT },
    async () => {
        const opened = await open('#/new');
        const { page } = opened;
        const other = join(folder, 'holiday');
        mkdirSync(other);
        copyFileSync(join(data, 'images', 'v0001.png'), join(other, 'a.png'));
        await input(page).setInputFiles(other);
        await start(page).click();
        const alert = page.locator('.plan-check [role=alert]');
        await alert.getByText('Correct the folder and choose it again').waitFor();
        assert.match(await alert.innerText(), /COLMAP|transforms\.json/);
        assert.doesNotMatch(await alert.innerText(), /\/tmp|data-dir/);
        await accessible(page, 'no scene');
        await picture(page, 'no-scene');

        // A photograph as a JPEG that ends too early.
        const broken = join(folder, 'broken');
        cpSync(data, broken, { recursive: true });
        const jpeg = await page.evaluate(async () => {
            const canvas = new OffscreenCanvas(96, 72);
            canvas.getContext('2d')!.fillRect(10, 10, 40, 30);
            const blob = await canvas.convertToBlob({ type: 'image/jpeg' });
            return [...new Uint8Array(await blob.arrayBuffer())];
        });
        rmSync(join(broken, 'images', 'v0003.png'));
        writeFileSync(
            join(broken, 'images', 'v0003.jpg'),
            Uint8Array.from(jpeg).subarray(0, jpeg.length - 30),
        );
        const list = join(broken, 'sparse', '0', 'images.bin');
        writeFileSync(
            list,
            Buffer.from(readFileSync(list).toString('latin1').replace('v0003.png', 'v0003.jpg'), 'latin1'),
        );
        await input(page).setInputFiles(broken);
        await listed(page, 'broken: ');
        assert.equal(
            await page.locator('.plan-check').isVisible(),
            false,
            'the check of the other folder is gone',
        );
        await start(page).click();
        await alert.getByText('v0003.jpg').waitFor();
        await picture(page, 'broken');
        // As the service says, so that the same photograph can be found.
        writeFileSync(join(broken, 'images', 'v0003.jpg'), Uint8Array.from(jpeg));
        await input(page).setInputFiles(broken);
        await start(page).click();
        await page.getByText('Uploaded as "broken-2".').waitFor();
        await page.locator('.plan-check-facts').waitFor();
        for (const id of ['holiday', 'broken', 'broken-2']) {
            service.run(tokens.ana, 'dataset', 'delete', id, '--coordinator', service.url);
        }
        await finish(opened, /412|400/);
    },
);

test('a dropped folder is taken, and files are not', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/new');
    const { page } = opened;
    await page.getByRole('button', { name: 'Create the job' }).waitFor();
    const session = await page.context().newCDPSession(page);
    const drop = async (...files: readonly string[]): Promise<void> => {
        const dragged = { x: 200, y: 200, data: { items: [], files: [...files], dragOperationsMask: 1 } };
        for (const type of ['dragEnter', 'dragOver', 'drop'] as const) {
            await session.send('Input.dispatchDragEvent', { type, ...dragged });
        }
    };
    await drop(join(data, 'survey.bin'));
    await page.getByText('These are files. Drop the folder').waitFor({ state: 'attached' });
    // More than one batch of entries.
    const many = join(folder, 'many');
    mkdirSync(join(many, 'deep', 'er'), { recursive: true });
    for (let at = 0; at < 250; at += 1) {
        writeFileSync(join(many, 'deep', 'er', `${at}.txt`), String(at));
    }
    writeFileSync(join(many, 'b.txt'), 'b');
    await drop(many);
    await listed(page, 'many: 251 files');
    await drop(join(data, 'images'), join(data, 'sparse'));
    await listed(page, `What you dropped: ${VIEWS + 3} files`);
    // A file with holes, so that it takes no room.
    writeFileSync(join(many, 'points3D.bin'), '');
    truncateSync(join(many, 'points3D.bin'), 256 * 1024 * 1024 + 1);
    await drop(many);
    await page.getByText('"points3D.bin" is larger than 256 MiB').waitFor();
    await page.getByText('Send this folder with "fathom dataset upload" instead.').waitFor();
    assert.equal(await start(page).isDisabled(), true);
    await accessible(page, 'a file that is too large');
    await finish(opened);
});

test(
    'an uploaded dataset is checked with the settings of the form, which become a job that trains',
    { skip, ...TIMEOUT },
    async () => {
        const opened = await open('#/new');
        const { page } = opened;
        await page.getByLabel('Dataset').selectOption('reef-sud');
        await page.getByLabel('Iterations').fill('60');
        await page.getByLabel('Most Gaussians').fill('1000');
        await page.getByRole('button', { name: 'Check', exact: true }).click();
        await page.locator('.plan-check-facts').waitFor();
        await page.getByLabel('Partitions', { exact: true }).selectOption('grid');
        await page.getByText('The settings have changed since this check.').waitFor();
        await page.getByLabel('Columns', { exact: true }).fill('2');
        await page.getByLabel('Rows', { exact: true }).fill('1');
        await page.getByText('Advanced settings', { exact: true }).click();
        const advanced = page.getByLabel('Advanced settings, JSON by section');
        await advanced.fill('{"train": {"ssim_weight": 3}}');
        await page.getByRole('button', { name: 'Check again' }).click();
        await page.getByText('The service refuses these settings.').waitFor();
        assert.equal(await advanced.getAttribute('aria-invalid'), 'true');
        await accessible(page, 'a check with a wrong setting');
        await picture(page, 'wrong-setting');
        await advanced.fill('{"data": {"max_resolution": 48}}');
        await page.getByRole('button', { name: 'Check again' }).click();
        const flags = [
            '--partitions',
            '2x1',
            '--iterations',
            '60',
            '--max-gaussians',
            '1000',
            '--max-resolution',
            '48',
        ];
        const said = inspect(data, ...flags);
        assert.ok(said.warnings.some((text) => text.includes('tend to overfit')), 'a warning to be shown');
        await page.locator('.plan-check-facts').waitFor();
        await agrees(page, said);
        await page.getByText('The settings have changed since this check.').waitFor({ state: 'hidden' });
        await accessible(page, 'a check of two partitions');
        await picture(page, 'two-partitions');

        // The plan itself, and not only its numbers.
        const configJson = JSON.stringify({
            partition: { auto: false, columns: 2, rows: 1 },
            train: { iterations: 60, max_gaussians: 1000 },
            data: { max_resolution: 48 },
        });
        const inspection = await client().inspectDataset({ datasetId: 'reef-sud', configJson });
        const pieces: Uint8Array[] = [];
        for await (const piece of client().readBlob({ digest: inspection.plan!.digest })) {
            pieces.push(piece.data);
        }
        const plan = JSON.parse(Buffer.concat(pieces).toString()) as InspectJson['plan'];
        const views = (one: InspectJson['plan']) => one.partitions.map(({ base_views: base }) => base);
        assert.deepEqual([views(plan), plan.held_out], [views(said.plan), said.plan.held_out]);

        let sent = '';
        await page.route('**/fathom.v1.JobService/CreateJob', async (route) => {
            sent = route.request().postDataBuffer()!.toString('latin1');
            await route.continue();
        });
        service.startWorker(tokens.worker, 'gpu-1');
        await page.getByRole('button', { name: 'Create the job' }).click();
        await page.getByRole('heading', { name: 'reef-sud' }).waitFor();
        assert.ok(sent.includes(inspection.manifest!.digest), 'the job has the manifest of the inspection');
        const id = /#\/jobs\/([^/]+)$/.exec(page.url())?.[1] ?? '';
        await until(
            'the job has succeeded',
            async () => (await service.api<JobJson>(tokens.ana, `jobs/${id}`)).state !== 'running',
            100,
        );
        const job = await service.api<JobJson>(tokens.ana, `jobs/${id}`);
        assert.deepEqual([job.state, job.partitions, job.error], ['succeeded', 2, null]);
        await finish(opened, /400/);
    },
);

test('a folder fits a phone, also in the dark', { skip, ...TIMEOUT }, async () => {
    const opened = await open('#/new', PHONE);
    const { page } = opened;
    await page.getByLabel('Dataset').waitFor();
    await picture(page, 'phone-dataset');
    await input(page).setInputFiles(data);
    await listed(page, 'Reef Süd: ');
    await fitsWindow(page, 'a chosen folder');
    await accessible(page, 'a chosen folder on a phone');
    await picture(page, 'phone-chosen');
    await start(page).click();
    await page.locator('.plan-check-facts').waitFor();
    await page.getByRole('application').waitFor();
    await fitsWindow(page, 'a check');
    await accessible(page, 'a check on a phone');
    await picture(page, 'phone-checked');
    await finish(opened);
});
