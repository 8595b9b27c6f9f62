// What `fathom export` writes for viewing: the compressed copy of a model, and the page in one file, opened from
// the disk without a network. Both are compared with `fathom render` of the full model.
//
// Needs Chromium and the models of scripts/make-test-data.sh.

import assert from 'node:assert/strict';
import { existsSync, readFileSync, statSync } from 'node:fs';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import { pathToFileURL } from 'node:url';
import type { Browser, Page } from 'playwright-core';

import type { CameraEntry, Mode } from '../../src/viewer/index.ts';
import {
    SMALL_WINDOW,
    VIEWER_WINDOW,
    WIDE_WINDOW,
    launch,
    newPage,
    shrinkViewer,
    unshrinkViewer,
} from './browser.ts';
import { type Picture, decodePng, psnr, readPng } from './pictures.ts';
import { serve } from './server.ts';
import { accessible, accessibleInDark, fitsWindow } from './steps.ts';

const WEB = join(import.meta.dirname, '../..');
const DATA = process.env['VIEWER_DATA'] ?? join(WEB, 'test-data');
const COPY = join(DATA, 'handover/model.compressed.ply');
/** Of a result in the folder `<script>wreck & co`, with credits and photographs. */
const PAGE = join(DATA, 'handover/page.html');
const CREDITS = '</script><script>document.title = "taken"</script> Photographs: <b>us</b> & co. CC BY 4.0';
/** Least PSNR between the compressed copy and the full model, dB. */
const GOAL = 38;
const TIMEOUT = { timeout: 180_000 };

const cameras = (): CameraEntry[] => JSON.parse(readFileSync(join(DATA, 'pixel/cameras.json'), 'utf8')) as CameraEntry[];
let browser: Browser;

before(async () => {
    for (const path of [COPY, PAGE]) {
        assert.ok(existsSync(path), `${path} is missing: run scripts/make-test-data.sh`);
    }
    browser = await launch();
});

after(() => browser?.close());

const waitForViewer = (page: Page): Promise<unknown> =>
    page.waitForFunction(() => document.querySelector<HTMLElement>('#viewer')?.fathomViewer, null, TIMEOUT);

async function picture(page: Page, camera: CameraEntry, mode: Mode): Promise<Picture> {
    const { width, height } = camera;
    const base64 = await page.evaluate(
        async ({ entry, shown }) => {
            const viewer = document.querySelector<HTMLElement>('#viewer')!.fathomViewer!;
            const image = await viewer.picture({ width: entry.width, height: entry.height, camera: entry, mode: shown });
            return btoa(Array.from(image.data, (byte) => String.fromCharCode(byte)).join(''));
        },
        { entry: camera, shown: mode },
    );
    return { width, height, data: Buffer.from(base64, 'base64') };
}

/** Compares every other camera with `fathom render` of the full model. */
async function compare(page: Page, what: string, goal: number): Promise<void> {
    await shrinkViewer(page);
    for (const mode of ['clear', 'water'] as const) {
        const values: number[] = [];
        for (const camera of cameras().filter((_, i) => i % 2 === 0)) {
            const reference = readPng(join(DATA, 'renders/pixel', mode, camera.img_name));
            values.push(psnr(await picture(page, camera, mode), reference));
        }
        const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
        const least = Math.min(...values);
        console.log(`${what} ${mode}: mean ${mean.toFixed(2)} dB, least ${least.toFixed(2)} dB, ${values.length} pictures`);
        assert.ok(least >= goal, `${what} ${mode}: ${least} dB, expected ${goal}`);
    }
}

const settled = (page: Page): Promise<void> =>
    page.evaluate(() => document.querySelector<HTMLElement>('#viewer')!.fathomViewer!.settled());

async function screen(page: Page): Promise<Picture> {
    await settled(page);
    return decodePng(await page.locator('.fv-canvas').screenshot(TIMEOUT));
}

test('a compressed copy shows what the model shows, with the water in its header', TIMEOUT, async () => {
    const [small, large] = [COPY, join(DATA, 'pixel/model.ply')].map((path) => statSync(path).size);
    console.log(`compressed copy: ${small} of ${large} bytes`);
    assert.ok(small! < large! / 3, `${small} of ${large} bytes`);
    const scene = { name: 'copy', model: 'model.compressed.ply', cameras: cameras() };
    const serving = await serve(join(WEB, 'dist'), () => ({
        'scene.json': Buffer.from(JSON.stringify(scene)),
        'model.compressed.ply': COPY,
    }));
    const { page, complaints } = await newPage(browser, { viewport: SMALL_WINDOW });
    await page.goto(`${serving.address}/copy/view.html`);
    await waitForViewer(page);
    await compare(page, 'compressed copy', GOAL);
    assert.deepEqual(complaints, []);
    await page.context().close();
    serving.close();
});

test('the page opens from the disk without a network and shows the model', TIMEOUT, async () => {
    const { page, complaints } = await newPage(browser, { viewport: SMALL_WINDOW });
    await page.context().setOffline(true);
    const requests: string[] = [];
    page.on('request', (request) => requests.push(request.url()));
    const address = pathToFileURL(PAGE).href;
    await page.goto(address);
    await waitForViewer(page);
    await compare(page, 'page', GOAL);
    await unshrinkViewer(page);
    await page.setViewportSize(VIEWER_WINDOW);

    // Nothing that was put in is markup.
    assert.equal(await page.title(), '<script>wreck & co - Fathom');
    assert.equal(await page.locator('.fv-head h1').innerText(), '<script>wreck & co');
    assert.equal(await page.locator('.fv-credits').innerText(), CREDITS);

    const first = await screen(page);
    await page.getByRole('radio', { name: 'Without water' }).check();
    const clear = await screen(page);
    assert.ok(psnr(first, clear) < 30, 'the water is shown first and can be taken away');
    await page.getByRole('radio', { name: 'Under water' }).check();
    assert.ok(psnr(await screen(page), first) > 45);

    const views = page.getByRole('button', { name: /^View \d$/ });
    assert.equal(await views.count(), 6);
    await views.nth(1).click();
    const second = await screen(page);
    await views.nth(2).click();
    assert.ok(psnr(await screen(page), second) < 35, 'views differ');
    await page.getByRole('radio', { name: 'Without water' }).check();
    await views.nth(1).click();
    assert.ok(await page.getByRole('radio', { name: 'Without water' }).isChecked(), 'a view keeps the water as it was');

    await page.getByRole('button', { name: 'Compare with the photograph' }).click();
    await page.waitForFunction(() => document.querySelector<HTMLImageElement>('.fv-photograph')?.complete, null, TIMEOUT);
    assert.ok(await page.locator('.fv-photograph').evaluate((image: HTMLImageElement) => image.naturalWidth > 0));
    await screen(page);
    const elsewhere = requests.filter((url) => url.split('#')[0] !== address && !url.startsWith('blob:'));
    assert.deepEqual(elsewhere, []);
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('the page begins with the view of a link and offers the views kept in it', TIMEOUT, async () => {
    const { page, complaints } = await newPage(browser, { viewport: VIEWER_WINDOW });
    await page.goto(pathToFileURL(join(DATA, 'handover/views.html')).href);
    await waitForViewer(page);
    assert.ok(await page.getByRole('radio', { name: 'Without water' }).isChecked());
    assert.equal(await page.getByRole('button', { name: /^View \d$/ }).count(), 0);
    const first = await screen(page);
    await page.getByRole('button', { name: 'Bow <1>', exact: true }).click();
    assert.ok(await page.getByRole('radio', { name: 'Under water' }).isChecked());
    assert.ok(psnr(await screen(page), first) < 30);
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('nothing is wrong with the page for people who cannot see or point, in light and dark', TIMEOUT, async () => {
    const { page, complaints } = await newPage(browser, { viewport: VIEWER_WINDOW });
    await page.goto(pathToFileURL(PAGE).href);
    await waitForViewer(page);
    await page.getByRole('button', { name: 'Compare with the photograph' }).scrollIntoViewIfNeeded();
    await page.getByRole('button', { name: 'View 2', exact: true }).click();
    await page.getByLabel('Compare with', { exact: true }).selectOption('photograph');
    await page.getByText('Mouse, touch and keys').click();
    const sizes = { wide: WIDE_WINDOW, phone: { width: 360, height: 640 } };
    for (const [size, viewport] of Object.entries(sizes)) {
        await page.setViewportSize(viewport);
        for (const colorScheme of ['light', 'dark'] as const) {
            await page.emulateMedia({ colorScheme });
            await settled(page);
            const what = `the page, ${size}, ${colorScheme}`;
            await (colorScheme === 'light' ? accessible(page, what) : accessibleInDark(page, what));
            await fitsWindow(page, what);
        }
    }
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('a damaged page says so', TIMEOUT, async () => {
    const { page } = await newPage(browser);
    await page.route('http://page.test/', (route) => {
        const html = readFileSync(PAGE, 'utf8').replace(/data-file="model[^"]*">/, (tag) => `${tag}*`);
        return route.fulfill({ contentType: 'text/html', body: html });
    });
    await page.goto('http://page.test/');
    const error = page.locator('.fv-error');
    await error.waitFor(TIMEOUT);
    assert.match(await error.innerText(), /page is damaged: model\.compressed\.ply cannot be decoded[^]*Copy the file again/);
    await page.context().close();
});
