// The built page in a browser, under the strict policy, compared with `fathom render`.
//
// Needs Chromium and the models of scripts/make-test-data.sh.

import assert from 'node:assert/strict';
import { existsSync, readFileSync } from 'node:fs';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import type { Browser, Page } from 'playwright-core';

import type { CameraEntry, Mode, Scene } from '../../src/viewer/index.ts';
import { pinholeOf, poseOf, resized } from '../../src/viewer/camera.ts';
import { readFragment } from '../../src/viewer/link.ts';
import { Cells } from '../../src/viewer/partitions.ts';
import { type Vec3, add, cross, dot, length, rotate, scale, sub, unit } from '../../src/viewer/vector.ts';
import { type WaterRecord, openWater } from '../../src/viewer/water.ts';
import { SMALL_WINDOW, launch, newPage } from './browser.ts';
import { fitWater, readNpy } from './fit-water.ts';
import { type Picture, cropped, decodePng, psnr, readPng } from './pictures.ts';
import { type Serving, serve } from './server.ts';
import { accessible, fitsWindow, until } from './steps.ts';

const WEB = join(import.meta.dirname, '../..');
const DATA = process.env['VIEWER_DATA'] ?? join(WEB, 'test-data');
/** Files by other programs, if they are there. */
const FOREIGN = process.env['VIEWER_FOREIGN'] ?? '';
const MODELS = ['pixel', 'gaussian', 'gaussian_linear', 'maps', 'open', 'aligned', 'air', 'over_black'] as const;
/**
 * Least PSNR, dB. Differences are those of half floats in the engine's textures, and of rounding to 8 bits. A
 * normal changes by a right angle where two scales are equal but for their rounding.
 */
const GOALS: Readonly<Record<string, number>> = { clear: 48, water: 48, veil: 55, alpha: 50, normal: 28 };
const TIMEOUT = { timeout: 180_000 };

/** The name of a photograph without its ending. */
const stemOf = ({ img_name }: CameraEntry): string => img_name.replace(/\.[^.]+$/, '');

type Files = Record<string, string | Buffer>;
const extra = new Map<string, Files>();
let browser: Browser;
let serving: Serving;

const read = <T>(path: string): T => JSON.parse(readFileSync(path, 'utf8')) as T;
const camerasOf = (name: string): CameraEntry[] => read(join(DATA, name, 'cameras.json'));

function sceneOf(name: string): Scene {
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
async function open(name: string, options = {}, hash = ''): Promise<{ page: Page; complaints: string[] }> {
    const { page, complaints } = await newPage(browser, options);
    await page.goto(`${serving.address}/${name}/view.html${hash}`);
    await page.waitForFunction(() => document.querySelector<HTMLElement>('#viewer')?.fathomViewer, null, TIMEOUT);
    return { page, complaints };
}

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

async function picture(page: Page, size: Picture, camera: CameraEntry, mode: Mode): Promise<Picture> {
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

const settled = (page: Page): Promise<void> =>
    page.evaluate(() => document.querySelector<HTMLElement>('#viewer')!.fathomViewer!.settled());

/** What is on the screen in the rectangle of the picture. */
async function screen(page: Page): Promise<Picture> {
    await settled(page);
    return decodePng(await page.locator('.fv-canvas').screenshot());
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
const needs = (name: string): { timeout: number; skip: string | false } => ({
    ...TIMEOUT,
    skip: !existsSync(join(DATA, name, 'model.ply')) && `the model "${name}" was not made`,
});

/** Compares pictures with those of `fathom render`, each `every`-th that it made. */
async function compareWithRender(name: string, every: number): Promise<void> {
    const { page, complaints } = await open(name, { viewport: SMALL_WINDOW });
    for (const [mode, goal] of Object.entries(GOALS)) {
        const folder = mode === 'alpha' || mode === 'normal' ? `clear/${mode}` : mode;
        const pictures = camerasOf(name)
            .map((camera) => ({ camera, file: join(DATA, 'renders', name, folder, `${stemOf(camera)}.png`) }))
            .filter(({ file }, i) => i % every === 0 && existsSync(file));
        const values: number[] = [];
        for (const { camera, file } of pictures) {
            const reference = readPng(file);
            values.push(psnr(await picture(page, reference, camera, mode as Mode), reference));
        }
        if (values.length > 0) {
            const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
            const least = Math.min(...values);
            console.log(`${name} ${mode}: mean ${mean.toFixed(2)} dB, least ${least.toFixed(2)} dB, ${values.length} pictures`);
            assert.ok(least >= goal, `${name} ${mode}: ${least} dB, expected ${goal}`);
        }
    }
    assert.deepEqual(complaints, []);
    await page.context().close();
}

for (const name of MODELS) {
    test(`the pictures of "${name}" are those of fathom render`, needs(name), () => compareWithRender(name, 3));
}

const noSurvey =
    !existsSync(join(DATA, 'renders/sesa/water')) && 'shared/scenes/sesa-wreck was not there, or the test data is quick';
test('the pictures of a real wreck are those of fathom render', { ...TIMEOUT, skip: noSurvey }, () =>
    compareWithRender('sesa', 1),
);

/** What a pixel of `fathom render --maps range,alpha` sees, where something opaque covers it. */
interface SeenPoint {
    readonly at: number;
    readonly range: number;
    readonly point: Vec3;
}

/** The points that the middle of each pixel sees, for a camera of the maps in `renders/NAME/ranges`. */
function pointsSeen(name: string, camera: CameraEntry): { size: Picture; points: SeenPoint[] } {
    const folder = join(DATA, 'renders', name, 'ranges');
    const size = readPng(join(folder, `alpha/${stemOf(camera)}.png`));
    const ranges = readNpy(join(folder, `range/${stemOf(camera)}.npy`));
    const { pose, lens } = { pose: poseOf(camera), lens: resized(pinholeOf(camera), size.width, size.height) };
    const points: SeenPoint[] = [];
    for (const [at, range] of ranges.entries()) {
        if (range > 0 && size.data[4 * at]! > 245) {
            const [x, y] = [at % size.width, Math.floor(at / size.width)];
            const ray = unit([(x + 0.5 - lens.cx) / lens.fx, (y + 0.5 - lens.cy) / lens.fy, 1]);
            points.push({ at, range, point: add(pose.position, scale(rotate(pose.rotation, ray), range)) });
        }
    }
    return { size, points };
}

const mix = (a: Vec3, b: Vec3, share: number): Vec3 => add(scale(a, 1 - share), scale(b, share));

/** The colours of the legend, from near (0) to far (1), as the page states them. */
function colourOfRange(t: number): Vec3 {
    const colours: readonly Vec3[] = [
        [0.99, 0.95, 0.79],
        [0.96, 0.66, 0.42],
        [0.8, 0.33, 0.36],
        [0.38, 0.2, 0.45],
        [0.07, 0.1, 0.24],
    ];
    const part = Math.min(3, Math.floor(4 * t));
    const within = 4 * t - part;
    return scale(mix(colours[part]!, colours[part + 1]!, within * within * (3 - 2 * within)), 255);
}

test('the colours of the range, read with the legend, are the ranges of fathom render', needs('pixel'), async (t) => {
    const { page, complaints } = await open('pixel', { viewport: { width: 904, height: 450 } });
    const table = Array.from({ length: 2001 }, (_, i) => colourOfRange(i / 2000));
    for (const camera of camerasOf('pixel').filter((_, i) => i % 6 === 0)) {
        await page.evaluate((entry) => {
            const viewer = document.querySelector<HTMLElement>('#viewer')!.fathomViewer!;
            viewer.setCamera(entry);
            viewer.setModes('range');
        }, camera);
        await settled(page);
        const [near, far] = (await page.locator('.fv-legend > span').allTextContents())
            .filter((text) => text !== '')
            .map((text) => Number(/^([\d.e+-]+) (units|m)$/.exec(text)?.[1])) as [number, number];
        const { size, points } = pointsSeen('pixel', camera);
        const { data } = await picture(page, size, camera, 'range');
        // Beyond its ends the legend has one colour.
        const within = points.filter(({ range }) => range > near && range < far);
        const errors = within
            .filter((_, i) => i % 29 === 0)
            .map(({ at, range }) => {
                const apart = table.map((colour) => length(sub(colour, [data[4 * at]!, data[4 * at + 1]!, data[4 * at + 2]!])));
                const found = apart.indexOf(Math.min(...apart)) / (table.length - 1);
                return Math.abs(near + found * (far - near) - range) / (far - near);
            })
            .toSorted((a, b) => a - b);
        const at = (share: number): number => errors[Math.floor(share * (errors.length - 1))]!;
        const told = `${camera.img_name}, ${near} to ${far}: median ${(100 * at(0.5)).toFixed(2)} %, ` +
            `99th percentile ${(100 * at(0.99)).toFixed(2)} % of the legend, ${errors.length} pixels`;
        t.diagnostic(told);
        assert.ok(within.length > 0.8 * points.length, `${told}; the legend holds most of the picture`);
        assert.ok(errors.length > 1000 && at(0.5) < 0.005 && at(0.99) < 0.025, told);
    }
    assert.deepEqual(complaints, []);
    await page.context().close();
});

/** The hue of a partition: the wheel that the page takes, without brightness. */
function hueOf(partition: number): Vec3 {
    const hue = (0.08 + partition * 0.61803398875) % 1;
    const wheel = [0, 2 / 3, 1 / 3].map((shift) =>
        Math.min(1, Math.max(0, Math.abs(((hue + shift) % 1) * 6 - 3) - 1)),
    );
    return unit(mix([0.95, 0.95, 0.95], wheel as unknown as Vec3, 0.55));
}

test('partitions have two colours, where the plan has two cells', needs('pixel'), async (t) => {
    const { page, complaints } = await open('pixel', { viewport: SMALL_WINDOW });
    const cells = new Cells(sceneOf('pixel').plan!);
    // What covers a pixel may belong to a Gaussian whose centre is a little aside.
    const aside: readonly Vec3[] = [[0.4, 0, 0], [-0.4, 0, 0], [0, 0, 0.4], [0, 0, -0.4]];
    const seen = [0, 0];
    const right = [0, 0];
    for (const camera of camerasOf('pixel').filter((_, i) => i % 3 === 0)) {
        const { size, points } = pointsSeen('pixel', camera);
        const { data } = await picture(page, size, camera, 'partition');
        for (const { at, point } of points) {
            const cell = cells.at(...point);
            if (aside.every((step) => cells.at(...add(point, step)) === cell)) {
                const colour = unit([data[4 * at]!, data[4 * at + 1]!, data[4 * at + 2]!]);
                seen[cell]! += 1;
                right[cell]! += dot(colour, hueOf(cell)) > dot(colour, hueOf(1 - cell)) ? 1 : 0;
            }
        }
    }
    const shares = seen.map((count, i) => right[i]! / count);
    const told = shares.map((share, i) => `cell ${i}: ${(100 * share).toFixed(2)} % of ${seen[i]} pixels`).join(', ');
    t.diagnostic(told);
    assert.ok(seen.every((count) => count > 20_000) && shares.every((share) => share > 0.98), told);
    assert.deepEqual(complaints, []);
    await page.context().close();
});

for (const name of ['pixel', 'open'] as const) {
    test(`water fitted back from the screen is that of "${name}"`, needs(name), async (t) => {
        const [camera] = camerasOf(name);
        const { page, complaints } = await open(name, { viewport: { width: 904, height: 450 } });
        const shownAs = async (mode: Mode): Promise<Picture> => {
            await page.evaluate(
                ({ entry, left }) => {
                    const viewer = document.querySelector<HTMLElement>('#viewer')!.fathomViewer!;
                    viewer.setCamera(entry);
                    viewer.setModes(left, 'none');
                },
                { entry: camera!, left: mode },
            );
            return screen(page);
        };
        const [clear, water] = [await shownAs('clear'), await shownAs('water')];
        const [folder, file] = [join(DATA, 'renders', name, 'ranges'), stemOf(camera!)];
        const range = readNpy(join(folder, `range/${file}.npy`));
        const trained = read<WaterRecord>(join(DATA, name, 'water.json'));
        // The change of open water with direction is taken as known, and its colour in the middle is fitted.
        const { pose, lens } = { pose: poseOf(camera!), lens: resized(pinholeOf(camera!), clear.width, clear.height) };
        const openAt = (x: number, y: number): number[] => {
            const ray = rotate(pose.rotation, unit([(x + 0.5 - lens.cx) / lens.fx, (y + 0.5 - lens.cy) / lens.fy, 1]));
            return openWater(trained, ray).map((value, i) => value / trained.b_inf[i as 0 | 1 | 2]);
        };
        const fitted = fitWater(clear, water, readPng(join(folder, `alpha/${file}.png`)), range, openAt);
        fitted.forEach(({ beta_d, beta_b, b_inf, pixels, left }, i) => {
            const d = beta_d / trained.beta_d[i as 0 | 1 | 2] - 1;
            const b = beta_b / trained.beta_b[i as 0 | 1 | 2] - 1;
            const infinity = b_inf - trained.b_inf[i as 0 | 1 | 2];
            const apart = `beta_d ${(100 * d).toFixed(2)} %, beta_b ${(100 * b).toFixed(2)} %, b_inf ${infinity.toFixed(5)}`;
            t.diagnostic(`channel ${i}: ${apart}; ${pixels} pixels, ${left.toFixed(2)} of 255 left`);
            assert.ok(Math.abs(d) < 0.02 && Math.abs(b) < 0.02 && Math.abs(infinity) < 0.002, `channel ${i}: ${apart}`);
        });
        assert.deepEqual(complaints, []);
        await page.context().close();
    });
}

test('the screen shows the camera of a photograph exactly, left and right of the divider', TIMEOUT, async () => {
    const { page, complaints } = await open('pixel', { viewport: { width: 904, height: 450 } });
    const [camera] = camerasOf('pixel');
    await page.evaluate((entry) => {
        const viewer = document.querySelector<HTMLElement>('#viewer')!.fathomViewer!;
        viewer.setCamera(entry!);
        viewer.setModes('clear', 'water', 0.5);
    }, camera);
    // The stage is 600 x 450 beside the panel of 304 pixels: the aspect ratio of the photograph.
    const shown = await screen(page);
    assert.deepEqual([shown.width, shown.height], [600, 450]);
    const size = { width: 600, height: 450, data: new Uint8Array() };
    const clear = await picture(page, size, camera!, 'clear');
    const water = await picture(page, size, camera!, 'water');
    // Beside the divider and above its labels.
    const half = (of: Picture, x: number): Picture => cropped(of, x, 0, 240, 400);
    const [left, right] = [psnr(half(shown, 20), half(clear, 20)), psnr(half(shown, 340), half(water, 340))];
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
    const { page, complaints } = await open('pixel', { viewport: { width: 904, height: 450 } });
    await page.getByRole('button', { name: 'Next photograph' }).click();
    await page.getByRole('button', { name: 'Compare with the photograph' }).click();
    await page.getByRole('slider', { name: 'Divider' }).press('Home');
    await page.waitForFunction(() => document.querySelector<HTMLImageElement>('.fv-photograph')?.complete, null, TIMEOUT);
    const shown = await screen(page);
    const [camera] = camerasOf('pixel');
    const render = await picture(page, shown, camera!, 'water');
    const apart = psnr(cropped(shown, 40, 0, 500, 400), cropped(render, 40, 0, 500, 400));
    // The held-out PSNR of such a small model is about 20 dB. A wrong camera gives less than 14.
    assert.ok(apart > 17 && apart < 40, `${apart} dB`);
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('no water is left at 0 times the usual distance, and more at 10', TIMEOUT, async () => {
    const { page } = await open('gaussian', { viewport: SMALL_WINDOW });
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

test('F turns about what is in the middle of the picture, as a double click there does', TIMEOUT, async (t) => {
    const { page, complaints } = await open('pixel', { viewport: { width: 904, height: 450 } });
    // A camera that sees something smooth in the middle.
    const nearMiddle = (camera: CameraEntry): number[] => {
        const { size, points } = pointsSeen('pixel', camera);
        const [x, y] = [size.width / 2, size.height / 2];
        return points
            .filter(({ at }) => Math.abs((at % size.width) - x) < 3 && Math.abs(Math.floor(at / size.width) - y) < 3)
            .map(({ range }) => range);
    };
    const smooth = camerasOf('pixel').find((entry) => {
        const ranges = nearMiddle(entry);
        return ranges.length >= 25 && Math.max(...ranges) < 1.03 * Math.min(...ranges);
    })!;
    const range = nearMiddle(smooth).toSorted((a, b) => a - b)[12]!;

    const poseNow = () => readFragment(new URL(page.url()).hash).view?.pose;
    /** The pose after something moved the camera; the address follows a moment later. */
    const poseAfter = async (act: () => Promise<void>) => {
        const hash = new URL(page.url()).hash;
        await act();
        await until('the address follows', async () => new URL(page.url()).hash !== hash);
        await page.waitForTimeout(600);
        await settled(page);
        return poseNow()!;
    };
    const toCamera = async (): Promise<void> => {
        await page.evaluate((entry) => document.querySelector<HTMLElement>('#viewer')!.fathomViewer!.setCamera(entry), smooth);
        await settled(page);
    };
    /** Where two lines of sight come nearest: the way along the first, and how far they are apart there. */
    const meeting = (a: { position: Vec3; forward: Vec3 }, b: { position: Vec3; forward: Vec3 }) => {
        const across = cross(a.forward, b.forward);
        const between = sub(b.position, a.position);
        const along = dot(cross(between, b.forward), across) / dot(across, across);
        return { along, apart: Math.abs(dot(between, across)) / length(across) };
    };
    const sight = (pose: NonNullable<ReturnType<typeof poseNow>>) => ({
        position: pose.position,
        forward: rotate(pose.rotation, [0, 0, 1]),
    });

    await poseAfter(toCamera);
    await page.locator('.fv-canvas').focus();
    const first = await poseAfter(() => page.keyboard.press('f'));
    assert.ok(length(sub(first.position, smooth.position as Vec3)) < 1e-5, 'the camera stays where it is');
    const turned = await poseAfter(async () => {
        for (let i = 0; i < 20; i++) {
            await page.keyboard.press('ArrowLeft');
        }
    });
    const { along, apart } = meeting(sight(first), sight(turned));
    t.diagnostic(`turns about ${along.toFixed(3)} ahead, ${apart.toFixed(4)} aside; fathom render: ${range.toFixed(3)}`);
    assert.ok(length(sub(turned.position, first.position)) > 0.1 * range, 'the camera turned');
    assert.ok(Math.abs(along / range - 1) < 0.03 && apart < 0.01 * range, `${along} of ${range}, ${apart} aside`);

    await poseAfter(toCamera);
    const box = (await page.locator('.fv-canvas').boundingBox())!;
    const clicked = await poseAfter(() => page.mouse.dblclick(box.x + box.width / 2, box.y + box.height / 2));
    const off = Math.acos(Math.min(1, dot(sight(clicked).forward, sight(first).forward)));
    assert.ok(off < 0.002, `${off} radians between the key and the double click`);

    await page.getByText('Mouse, touch and keys').click();
    await page.getByText('turn about what is in the middle', { exact: true }).waitFor();
    assert.deepEqual(complaints, []);
    await page.context().close();
});

test('nothing is wrong with the page for people who cannot see or point, in light and dark', TIMEOUT, async () => {
    const { page, complaints } = await open('pixel');
    await page.getByRole('button', { name: 'Next photograph' }).click();
    await page.getByLabel('Name of this view').fill('Bow');
    await page.getByRole('button', { name: 'Keep' }).click();
    await page.getByText('Mouse, touch and keys').click();
    for (const colorScheme of ['light', 'dark'] as const) {
        for (const [size, viewport] of Object.entries({ wide: { width: 1200, height: 850 }, phone: { width: 360, height: 640 } })) {
            await page.emulateMedia({ colorScheme });
            await page.setViewportSize(viewport);
            for (const right of ['none', 'range'] as const) {
                await page.evaluate(
                    (side) => document.querySelector<HTMLElement>('#viewer')!.fathomViewer!.setModes('water', side),
                    right,
                );
                await settled(page);
                await accessible(page, `view.html, ${right}, ${size}, ${colorScheme}`);
                await fitsWindow(page, `view.html, ${right}, ${size}, ${colorScheme}`);
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
    const { page, complaints } = await newPage(browser);
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
