// The built page in a browser, under the strict policy: how it is used. What it draws is compared with
// `fathom render` in compared.test.ts.
//
// Needs Chromium and the models of scripts/make-test-data.sh.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { join } from 'node:path';
import { test } from 'node:test';
import type { Page } from 'playwright-core';

import type { Mode } from '../../src/viewer/index.ts';
import { VIEWER_WINDOW, WIDE_WINDOW, launch, newPage } from './browser.ts';
import { type Picture, cropped, psnr, readPng } from './pictures.ts';
import { accessible, accessibleInDark, fitsWindow } from './steps.ts';
import {
    DATA,
    PHOTOGRAPH_WINDOW,
    TIMEOUT,
    browser,
    camerasOf,
    extra,
    needs,
    open,
    openForPictures,
    picture,
    sceneOf,
    screen,
    serving,
    settled,
} from './viewer-page.ts';

/** Files by other programs, if they are there. */
const FOREIGN = process.env['VIEWER_FOREIGN'] ?? '';

/** The text of the error that the page shows. */
async function errorOf(name: string, prepare?: (page: Page) => Promise<void>, by = browser): Promise<string> {
    const { page } = await newPage(by);
    await prepare?.(page);
    await page.goto(`${serving.address}/${name}/view.html`);
    const error = page.locator('.fv-error');
    await error.waitFor(TIMEOUT);
    const text = await error.innerText();
    await page.context().close();
    return text;
}

test('the screen shows the camera of a photograph exactly, left and right of the divider', TIMEOUT, async () => {
    const { page, complaints } = await open('pixel', { viewport: PHOTOGRAPH_WINDOW });
    const [camera] = camerasOf('pixel');
    await page.evaluate((entry) => {
        const viewer = document.querySelector<HTMLElement>('#viewer')!.fathomViewer!;
        viewer.setCamera(entry!);
        viewer.setModes('clear', 'water', 0.5);
    }, camera);
    const shown = await screen(page);
    assert.deepEqual([shown.width, shown.height], [360, 270]);
    const size = { width: 360, height: 270, data: new Uint8Array() };
    const clear = await picture(page, size, camera!, 'clear');
    const water = await picture(page, size, camera!, 'water');
    // Beside the divider and above its labels.
    const half = (of: Picture, x: number): Picture => cropped(of, x, 0, 144, 220);
    const [left, right] = [psnr(half(shown, 12), half(clear, 12)), psnr(half(shown, 204), half(water, 204))];
    assert.ok(left > 50 && right > 50, `left ${left} dB, right ${right} dB`);
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('the divider moves by keyboard and by pointer', TIMEOUT, async () => {
    const { page } = await open('pixel');
    await page.getByLabel('Compare with', { exact: true }).selectOption('water');
    const divider = page.getByRole('slider', { name: 'Divider' });
    assert.equal(await divider.getAttribute('aria-valuenow'), '50');
    await divider.press('ArrowLeft');
    assert.equal(await divider.getAttribute('aria-valuenow'), '48');
    await divider.press('End');
    assert.equal(await divider.getAttribute('aria-valuenow'), '100');
    const box = (await page.locator('.fv-canvas').boundingBox())!;
    await divider.press('Home');
    await page.mouse.move(box.x + 2, box.y + 200);
    await page.mouse.down();
    await page.mouse.move(box.x + box.width * 0.3, box.y + 200, { steps: 4 });
    await page.mouse.up();
    assert.equal(await divider.getAttribute('aria-valuenow'), '30');
    await page.context().close();
});

test('a photograph is compared with the render of its own camera', TIMEOUT, async () => {
    const { page, complaints } = await open('pixel', { viewport: PHOTOGRAPH_WINDOW });
    await page.getByRole('button', { name: 'Next photograph' }).click();
    await page.getByRole('button', { name: 'Compare with the photograph' }).click();
    await page.getByRole('slider', { name: 'Divider' }).press('Home');
    await page.waitForFunction(() => document.querySelector<HTMLImageElement>('.fv-photograph')?.complete, null, TIMEOUT);
    const shown = await screen(page);
    const [camera] = camerasOf('pixel');
    const render = await picture(page, shown, camera!, 'water');
    const apart = psnr(cropped(shown, 40, 0, 300, 220), cropped(render, 40, 0, 300, 220));
    // The held-out PSNR of such a small model is about 20 dB. A wrong camera gives less than 14.
    assert.ok(apart > 17 && apart < 40, `${apart} dB`);
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('no water is left at 0 times the usual distance, and more at 10', TIMEOUT, async () => {
    const { page } = await openForPictures('gaussian');
    const [camera] = camerasOf('gaussian');
    const size = { width: 200, height: 150, data: new Uint8Array() };
    const at = async (amount: number, mode: Mode): Promise<Picture> => {
        await page.evaluate((value) => document.querySelector<HTMLElement>('#viewer')!.fathomViewer!.setAmount(value), amount);
        return picture(page, size, camera!, mode);
    };
    const clear = await at(1, 'clear');
    const none = psnr(await at(0, 'water'), clear);
    const usual = psnr(await at(1, 'water'), clear);
    const much = psnr(await at(10, 'water'), clear);
    assert.ok(none > 45 && usual < 25 && much < usual, `${none}, ${usual}, ${much} dB`);
    await page.context().close();
});

test('keys move the camera, the address follows, and its link shows the same view', needs('open'), async () => {
    const { page } = await open('open');
    const first = await screen(page);
    await page.locator('.fv-canvas').focus();
    for (const key of ['ArrowLeft', 'ArrowLeft', 'w', 'w', 'ArrowUp', 'e']) {
        await page.keyboard.press(key);
    }
    await page.getByLabel('Name of this view').fill('Reef');
    await page.getByRole('button', { name: 'Keep' }).click();
    const moved = await screen(page);
    assert.ok(psnr(first, moved) < 35, 'the view changed');
    await page.waitForFunction(() => location.hash.includes('b=Reef'), null, TIMEOUT);
    const { hash } = new URL(page.url());
    const { page: other, complaints } = await open('open', {}, hash);
    const again = psnr(await screen(other), moved);
    assert.ok(again > 45, `${again} dB`);
    await other.getByRole('button', { name: 'First view' }).click();
    assert.ok(psnr(await screen(other), first) > 45);
    await other.getByRole('button', { name: 'Reef', exact: true }).click();
    assert.ok(psnr(await screen(other), moved) > 45);
    assert.deepEqual(complaints, []);
    await page.context().close();
    await other.context().close();
});

test('nothing is wrong with the page for people who cannot see or point, in light and dark', TIMEOUT, async () => {
    const { page, complaints } = await open('pixel');
    await page.getByRole('button', { name: 'Next photograph' }).click();
    await page.getByLabel('Name of this view').fill('Bow');
    await page.getByRole('button', { name: 'Keep' }).click();
    await page.getByText('Mouse, touch and keys').click();
    const sizes = { wide: WIDE_WINDOW, phone: { width: 360, height: 640 } };
    for (const [size, viewport] of Object.entries(sizes)) {
        await page.setViewportSize(viewport);
        for (const right of ['none', 'range'] as const) {
            await page.evaluate(
                (side) => document.querySelector<HTMLElement>('#viewer')!.fathomViewer!.setModes('water', side),
                right,
            );
            for (const colorScheme of ['light', 'dark'] as const) {
                await page.emulateMedia({ colorScheme });
                await settled(page);
                const what = `view.html, ${right}, ${size}, ${colorScheme}`;
                await (colorScheme === 'light' ? accessible(page, what) : accessibleInDark(page, what));
                await fitsWindow(page, what);
            }
        }
    }
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('a still is saved as PNG, and it is what the screen shows', TIMEOUT, async () => {
    const { page } = await open('pixel');
    const waiting = page.waitForEvent('download', TIMEOUT);
    await page.getByRole('button', { name: 'Save picture' }).click();
    const download = await waiting;
    assert.equal(download.suggestedFilename(), 'Scene_pixel.png');
    const saved = readPng(await download.path());
    const shown = await screen(page);
    assert.ok(psnr(saved, shown) > 45);
    await page.context().close();
});

test('the picture returns after the browser took the graphics memory away', TIMEOUT, async () => {
    const { page } = await open('pixel');
    const shown = await screen(page);
    await page.evaluate(async () => {
        const gl = document.querySelector<HTMLCanvasElement>('.fv-canvas')!.getContext('webgl2')!;
        const extension = gl.getExtension('WEBGL_lose_context')!;
        extension.loseContext();
        await new Promise((done) => setTimeout(done, 500));
        extension.restoreContext();
        await new Promise((done) => setTimeout(done, 500));
    });
    assert.ok(await page.locator('.fv-lost').isHidden());
    assert.ok(psnr(await screen(page), shown) > 45);
    await page.context().close();
});

test('a viewer that is removed leaves nothing behind', TIMEOUT, async () => {
    const { page, complaints } = await open('pixel');
    const left = await page.evaluate(async () => {
        const container = document.querySelector<HTMLElement>('#viewer')!;
        container.fathomViewer!.destroy();
        await new Promise((done) => setTimeout(done, 700));
        return { children: container.children.length, handle: 'fathomViewer' in container };
    });
    assert.deepEqual(left, { children: 0, handle: false });
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('every control has a name and is reached by the Tab key', TIMEOUT, async () => {
    const { page } = await open('pixel');
    await page.getByLabel('Compare with', { exact: true }).selectOption('water');
    const nameless = await page.evaluate(() =>
        [...document.querySelectorAll<HTMLInputElement>('button, input, select, [tabindex], summary')]
            .filter((element) => !(element.getAttribute('aria-label') ?? element.labels?.[0]?.textContent ?? element.textContent)?.trim())
            .map((element) => element.outerHTML),
    );
    assert.deepEqual(nameless, []);
    const reached = new Set<string>();
    await page.evaluate(() => document.querySelector<HTMLElement>('.fv-canvas')!.focus());
    for (let i = 0; i < 40; i++) {
        reached.add(
            await page.evaluate(() => {
                const element = document.activeElement as HTMLInputElement | null;
                return element?.name && element.type === 'radio' ? element.name : (element?.id || element?.getAttribute('aria-label') || element?.textContent || '');
            }),
        );
        await page.keyboard.press('Tab');
    }
    const expected = await page.evaluate(() =>
        [...document.querySelectorAll<HTMLInputElement>('button:not(:disabled), input, select, summary, .fv-divider')].map((element) =>
            element.type === 'radio' ? element.name : element.id || element.getAttribute('aria-label') || element.textContent || '',
        ),
    );
    assert.deepEqual(expected.filter((name) => !reached.has(name)), []);
    await page.context().close();
});

test('the page fits a phone, in the dark', TIMEOUT, async () => {
    const phone = { viewport: { width: 360, height: 640 }, hasTouch: true, colorScheme: 'dark' as const };
    const { page, complaints } = await open('pixel', phone);
    await page.getByRole('button', { name: 'Controls' }).click();
    const widths = await page.evaluate(() => [document.documentElement.scrollWidth, document.querySelector('.fv-canvas')!.clientHeight]);
    assert.ok(widths[0]! <= 360 && widths[1]! > 200, String(widths));
    const shown = await screen(page);
    const box = (await page.locator('.fv-canvas').boundingBox())!;
    await page.touchscreen.tap(box.x + 50, box.y + 50);
    assert.ok(psnr(await screen(page), shown) > 45, 'a tap moves nothing');
    const touches = await page.context().newCDPSession(page);
    const touch = (type: 'touchStart' | 'touchMove' | 'touchEnd', ...xs: number[]): Promise<unknown> =>
        touches.send('Input.dispatchTouchEvent', {
            type,
            touchPoints: xs.map((x, id) => ({ x: box.x + x, y: box.y + 100, id })),
        });
    // Two fingers go apart about the middle: everything grows about the middle of the picture.
    await touch('touchStart', 160, 200);
    await touch('touchMove', 140, 220);
    await touch('touchMove', 120, 240);
    await touch('touchEnd');
    const nearer = await screen(page);
    await touch('touchStart', 180);
    await touch('touchMove', 150);
    await touch('touchMove', 90);
    await touch('touchEnd');
    const turned = await screen(page);
    assert.ok(psnr(nearer, shown) < 35, 'a pinch comes nearer');
    assert.ok(psnr(turned, nearer) < 35, 'a finger turns');
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('errors say what is wrong, where, and what to do', TIMEOUT, async () => {
    const model = readFileSync(join(DATA, 'pixel/model.ply'));
    const scene = (change: object): Buffer => Buffer.from(JSON.stringify({ ...sceneOf('pixel'), ...change }));
    extra.set('no-scene', {});
    extra.set('not-json', { 'scene.json': Buffer.from('{') });
    extra.set('no-model', { 'scene.json': scene({}) });
    extra.set('cut', { 'scene.json': scene({}), 'model.ply': model.subarray(0, 100_000) });
    extra.set('picture', { 'scene.json': scene({ model: 'a.png' }), 'a.png': Buffer.from('89504e470d0a1a0a', 'hex') });
    extra.set('sog', { 'scene.json': scene({ model: 'a.sog' }), 'a.sog': Buffer.from('504b0304'.repeat(20), 'hex') });
    extra.set('wrong-water', { 'scene.json': scene({ water: { format: 1 } }), 'model.ply': model });
    assert.match(await errorOf('no-scene'), /scene\.json cannot be fetched: the server answers 404[^]*beside this page/);
    assert.match(await errorOf('not-json'), /scene\.json is not JSON/);
    assert.match(await errorOf('no-model'), /model\.ply cannot be fetched: the server answers 404[^]*exactly this name/);
    assert.match(await errorOf('cut'), /model\.ply is incomplete: it has 100000 bytes[^]*Download the model again/);
    assert.match(await errorOf('picture'), /a\.png is not a model[^]*\.compressed\.ply/);
    assert.match(await errorOf('sog'), /a\.sog cannot be read as a model[^]*\.compressed\.ply/);
    assert.match(await errorOf('wrong-water'), /format 1[^]*water\.json/);
    const noFloats = (page: Page): Promise<void> =>
        page
            .addInitScript(() => {
                const get = WebGL2RenderingContext.prototype.getExtension as (name: string) => unknown;
                WebGL2RenderingContext.prototype.getExtension = function (this: WebGL2RenderingContext, name: string) {
                    return name.includes('color_buffer') ? null : get.call(this, name);
                } as typeof WebGL2RenderingContext.prototype.getExtension;
            })
            .then(() => {});
    assert.match(await errorOf('pixel', noFloats), /float textures[^]*EXT_color_buffer_float/);
    const without = await launch(['--no-sandbox', '--disable-3d-apis']);
    assert.match(await errorOf('pixel', undefined, without), /no WebGL2[^]*hardware acceleration/);
    await without.close();
});

test('phones that cannot blend floats keep the range in half floats', TIMEOUT, async () => {
    const { page, complaints } = await newPage(browser, { viewport: VIEWER_WINDOW });
    await page.addInitScript(() => {
        const get = WebGL2RenderingContext.prototype.getExtension as (name: string) => unknown;
        WebGL2RenderingContext.prototype.getExtension = function (this: WebGL2RenderingContext, name: string) {
            return name === 'EXT_float_blend' ? null : get.call(this, name);
        } as typeof WebGL2RenderingContext.prototype.getExtension;
    });
    await page.goto(`${serving.address}/pixel/view.html`);
    await page.waitForFunction(() => document.querySelector<HTMLElement>('#viewer')?.fathomViewer, null, TIMEOUT);
    const [camera] = camerasOf('pixel');
    const reference = readPng(join(DATA, 'renders/pixel/water', camera!.img_name));
    const apart = psnr(await picture(page, reference, camera!, 'water'), reference);
    assert.ok(apart > 45, `${apart} dB`);
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('files of other programs open', { ...TIMEOUT, skip: FOREIGN === '' && 'VIEWER_FOREIGN is not set' }, async () => {
    for (const path of FOREIGN.split(':').filter((file) => file !== '')) {
        const model = path.split('/').at(-1)!;
        const name = `foreign-${model}`;
        extra.set(name, { 'scene.json': Buffer.from(JSON.stringify({ name: model, model })), [model]: path });
        const { page, complaints } = await open(name);
        const { data } = await screen(page);
        const levels = new Set(data);
        assert.ok(levels.size > 40, `${model} shows something: ${levels.size} different values`);
        assert.deepEqual(complaints, []);
        await page.context().close();
    }
});
