// What tests of `view.html` share: a server with the built page and the models of scripts/make-test-data.sh, under
// the strict policy, and a browser.

import assert from 'node:assert/strict';
import { existsSync, readFileSync } from 'node:fs';
import { join } from 'node:path';
import { after, before } from 'node:test';
import type { Browser, Page } from 'playwright-core';

import type { CameraEntry, Mode, Scene } from '../../src/viewer/index.ts';
import { SMALL_WINDOW, VIEWER_WINDOW, launch, newPage, shrinkViewer } from './browser.ts';
import { type Picture, decodePng } from './pictures.ts';
import { type Serving, serve } from './server.ts';

const WEB = join(import.meta.dirname, '../..');
export const DATA = process.env['VIEWER_DATA'] ?? join(WEB, 'test-data');
export const TIMEOUT = { timeout: 180_000 };
/** The picture is 360 x 270 beside the panel of 304 pixels: the aspect ratio of the photographs. */
export const PHOTOGRAPH_WINDOW = { width: 664, height: 270 };

/** The name of a photograph without its ending. */
export const stemOf = ({ img_name }: CameraEntry): string => img_name.replace(/\.[^.]+$/, '');

type Files = Record<string, string | Buffer>;
export const extra = new Map<string, Files>();
export let browser: Browser;
export let serving: Serving;

export const read = <T>(path: string): T => JSON.parse(readFileSync(path, 'utf8')) as T;
export const camerasOf = (name: string): CameraEntry[] => read(join(DATA, name, 'cameras.json'));

export function sceneOf(name: string): Scene {
    const plan = join(DATA, name, 'plan.json');
    const cameras = camerasOf(name);
    return {
        name: `Scene ${name}`,
        model: 'model.ply',
        // The water is read from the header of the model.
        water: null,
        cameras,
        plan: existsSync(plan) ? read(plan) : null,
        photographs: Object.fromEntries(cameras.map(({ img_name }) => [img_name, `photographs/${img_name}`])),
        credits: 'Made by fathom synth.',
    };
}

function filesOf(name: string): Files {
    const known = extra.get(name);
    if (known !== undefined) {
        return known;
    }
    if (!existsSync(join(DATA, name, 'model.ply'))) {
        return {};
    }
    const images = join(DATA, name === 'open' || name === 'aligned' ? 'reef' : 'wreck', 'images');
    const photographs = camerasOf(name).map(({ img_name }) => [`photographs/${img_name}`, join(images, img_name)]);
    return {
        'scene.json': Buffer.from(JSON.stringify(sceneOf(name))),
        'model.ply': join(DATA, name, 'model.ply'),
        ...Object.fromEntries(photographs),
    };
}

/** Opens the page and waits for the viewer. */
export async function open(name: string, options = {}, hash = ''): Promise<{ page: Page; complaints: string[] }> {
    const { page, complaints } = await newPage(browser, { viewport: VIEWER_WINDOW, ...options });
    await page.goto(`${serving.address}/${name}/view.html${hash}`);
    await page.waitForFunction(() => document.querySelector<HTMLElement>('#viewer')?.fathomViewer, null, TIMEOUT);
    return { page, complaints };
}

/** Opens the page for pictures of any size; what it shows itself has this one. */
export async function openForPictures(name: string, width?: number, height?: number): ReturnType<typeof open> {
    const opened = await open(name, { viewport: SMALL_WINDOW });
    await shrinkViewer(opened.page, width, height);
    return opened;
}

export async function picture(page: Page, size: Picture, camera: CameraEntry, mode: Mode): Promise<Picture> {
    const base64 = await page.evaluate(
        async ({ width, height, entry, shown }) => {
            const viewer = document.querySelector<HTMLElement>('#viewer')!.fathomViewer!;
            const image = await viewer.picture({ width, height, camera: entry, mode: shown });
            return btoa(Array.from(image.data, (byte) => String.fromCharCode(byte)).join(''));
        },
        { width: size.width, height: size.height, entry: camera, shown: mode },
    );
    return { width: size.width, height: size.height, data: Buffer.from(base64, 'base64') };
}

export const settled = (page: Page): Promise<void> =>
    page.evaluate(() => document.querySelector<HTMLElement>('#viewer')!.fathomViewer!.settled());

/** What is on the screen in the rectangle of the picture. */
export async function screen(page: Page): Promise<Picture> {
    await settled(page);
    return decodePng(await page.locator('.fv-canvas').screenshot(TIMEOUT));
}

before(async () => {
    assert.ok(existsSync(join(WEB, 'dist/view.html.gz')), 'run `npm run build` first');
    assert.ok(existsSync(join(DATA, 'pixel/model.ply')), `no models in ${DATA}: run scripts/make-test-data.sh`);
    serving = await serve(join(WEB, 'dist'), filesOf);
    browser = await launch();
});

after(async () => {
    await browser?.close();
    serving?.close();
});

/** Options of a test that needs this model: make-test-data.sh makes two of them when it is asked to be quick. */
export const needs = (name: string): { timeout: number; skip: string | false } => ({
    ...TIMEOUT,
    skip: !existsSync(join(DATA, name, 'model.ply')) && `the model "${name}" was not made`,
});
