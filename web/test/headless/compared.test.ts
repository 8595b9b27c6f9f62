// The built page in a browser, under the strict policy: what it draws is compared with `fathom render`.
//
// Needs Chromium and the models of scripts/make-test-data.sh.

import assert from 'node:assert/strict';
import { existsSync } from 'node:fs';
import { join } from 'node:path';
import { test } from 'node:test';

import type { CameraEntry, Mode } from '../../src/viewer/index.ts';
import { pinholeOf, poseOf, resized } from '../../src/viewer/camera.ts';
import { readFragment } from '../../src/viewer/link.ts';
import { Cells } from '../../src/viewer/partitions.ts';
import { type Vec3, add, cross, dot, length, rotate, scale, sub, unit } from '../../src/viewer/vector.ts';
import { type WaterRecord, openWater } from '../../src/viewer/water.ts';
import { fitWater, readNpy } from './fit-water.ts';
import { type Picture, psnr, readPng } from './pictures.ts';
import { until } from './steps.ts';
import {
    DATA,
    TIMEOUT,
    camerasOf,
    needs,
    open,
    openForPictures,
    picture,
    read,
    sceneOf,
    screen,
    settled,
    stemOf,
} from './viewer-page.ts';

const MODELS = ['pixel', 'gaussian', 'gaussian_linear', 'maps', 'open', 'aligned', 'air', 'over_black'] as const;
/**
 * Least PSNR, dB. Differences are those of half floats in the engine's textures, and of rounding to 8 bits. A
 * normal changes by a right angle where two scales are equal but for their rounding.
 */
const GOALS: Readonly<Record<string, number>> = { clear: 48, water: 48, veil: 55, alpha: 50, normal: 28 };

/** Compares pictures with those of `fathom render`, each `every`-th that it made. */
async function compareWithRender(name: string, every: number): Promise<void> {
    const { page, complaints } = await openForPictures(name);
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

/** The place in a table of the colour nearest to this one. Of thousands for thousands of pixels, so it is plain. */
function nearest(table: readonly Vec3[], red: number, green: number, blue: number): number {
    let [found, least] = [0, Infinity];
    for (let at = 0; at < table.length; at += 1) {
        const colour = table[at]!;
        const apart = (colour[0] - red) ** 2 + (colour[1] - green) ** 2 + (colour[2] - blue) ** 2;
        if (apart < least) {
            [found, least] = [at, apart];
        }
    }
    return found;
}

test('the colours of the range, read with the legend, are the ranges of fathom render', needs('pixel'), async (t) => {
    // The legend is that of the screen, which has the aspect ratio of the photographs.
    const { page, complaints } = await openForPictures('pixel', 120, 90);
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
                const found = nearest(table, data[4 * at]!, data[4 * at + 1]!, data[4 * at + 2]!) / (table.length - 1);
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
    const { page, complaints } = await openForPictures('pixel');
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

test('F turns about what is in the middle of the picture, as a double click there does', TIMEOUT, async (t) => {
    const { page, complaints } = await openForPictures('pixel', 240, 180);
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
