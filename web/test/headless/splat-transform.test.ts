// An independent program, @playcanvas/splat-transform, and the viewer read what the other wrote: the compressed
// copy that `fathom export` makes, and a .sog and a .compressed.ply of the test model.
//
// The program comes from the npm registry, in the version that scripts/splat-transform.sh takes. It is no
// dependency of the pages: with what it needs it has 113 MB. Needs Chromium and scripts/make-test-data.sh too.

import assert from 'node:assert/strict';
import { execFile } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync, statSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { type TestContext, after, before, test } from 'node:test';
import { promisify } from 'node:util';
import type { Browser } from 'playwright-core';

import type { CameraEntry, Mode } from '../../src/viewer/index.ts';
import { SMALL_WINDOW, launch, newPage, shrinkViewer } from './browser.ts';
import { psnr, readPng } from './pictures.ts';
import { serve } from './server.ts';

const WEB = join(import.meta.dirname, '../..');
const DATA = process.env['VIEWER_DATA'] ?? join(WEB, 'test-data');
const MODEL = join(DATA, 'pixel/model.ply');
const COPY = join(DATA, 'handover/model.compressed.ply');
const SCRIPT = join(WEB, '../scripts/splat-transform.sh');
/** Least PSNR to `fathom render` of the model, dB. A .sog takes colours and shapes from tables of 256. */
const GOALS: Readonly<Record<string, number>> = { 'a.sog': 42, 'a.compressed.ply': 40 };
const TIMEOUT = { timeout: 300_000 };

const run = promisify(execFile);
const work = mkdtempSync(join(tmpdir(), 'splat-transform-'));
/** Why the program is not there; empty if it is. */
let missing = '';
let browser: Browser;

async function transform(...args: readonly string[]): Promise<void> {
    const found = /@playcanvas\/splat-transform@[\d.]+/.exec(readFileSync(SCRIPT, 'utf8'));
    await run('npx', ['--yes', found![0], ...args]);
}

before(async () => {
    await transform('--version').catch((error: unknown) => {
        missing = `npm cannot fetch splat-transform: ${String(error).slice(0, 200)}`;
    });
    browser = await launch();
}, TIMEOUT);

after(async () => {
    await browser?.close();
    rmSync(work, { recursive: true, force: true });
});

/** Skips a test where the program is not there, unless it must be. */
function isMissing(t: TestContext): boolean {
    assert.ok(missing === '' || process.env['FATHOM_TEST_REQUIRE_BROWSER'] !== '1', missing);
    if (missing !== '') {
        t.skip(missing);
    }
    return missing !== '';
}

/** The centres of a PLY of floats, x y z after each other. */
function centresOf(path: string): Float64Array {
    const bytes = readFileSync(path);
    const end = bytes.indexOf('end_header\n') + 'end_header\n'.length;
    const lines = bytes.toString('latin1', 0, end).split('\n');
    const count = Number(/^element vertex (\d+)$/m.exec(lines.join('\n'))?.[1]);
    const properties = lines.filter((line) => line.startsWith('property ')).map((line) => line.split(' '));
    assert.ok(properties.every(([, type]) => type === 'float'), `${path} has floats only`);
    const names = properties.map(([, , name]) => name);
    const [x, y, z] = ['x', 'y', 'z'].map((name) => names.indexOf(name));
    const centres = new Float64Array(3 * count);
    for (let i = 0; i < count; i++) {
        [x!, y!, z!].forEach((column, axis) => {
            centres[3 * i + axis] = bytes.readFloatLE(end + 4 * (i * names.length + column));
        });
    }
    return centres;
}

test('splat-transform reads the Gaussians of the compressed copy', TIMEOUT, async (t) => {
    if (isMissing(t)) {
        return;
    }
    const read = join(work, 'read.ply');
    await transform('-q', '-w', COPY, read);
    const [theirs, ours] = [centresOf(read), centresOf(MODEL)];
    assert.equal(theirs.length, ours.length, 'the number of Gaussians');
    // The copy has another order, so each centre is compared with the nearest of the model.
    const apart = Array.from({ length: theirs.length / 3 }, (_, i) => {
        let least = Infinity;
        for (let j = 0; j < ours.length; j += 3) {
            const [x, y, z] = [0, 1, 2].map((axis) => theirs[3 * i + axis]! - ours[j + axis]!) as [number, number, number];
            least = Math.min(least, x * x + y * y + z * z);
        }
        return Math.sqrt(least);
    }).toSorted((a, b) => a - b);
    const at = (share: number): number => apart[Math.floor(share * (apart.length - 1))]!;
    const told = `${apart.length} Gaussians, apart: median ${at(0.5).toFixed(5)}, 99th percentile ${at(0.99).toFixed(5)}`;
    t.diagnostic(`${told}, most ${at(1).toFixed(5)}`);
    // The wreck is about 16 units long.
    assert.ok(at(0.5) < 0.004 && at(0.99) < 0.01, told);
});

for (const [name, goal] of Object.entries(GOALS)) {
    test(`${name} by splat-transform opens and looks like the model`, TIMEOUT, async (t) => {
        if (isMissing(t)) {
            return;
        }
        const path = join(work, name);
        // On the CPU: there may be no graphics card.
        await transform('-q', '-w', '-g', 'cpu', MODEL, path);
        const cameras = JSON.parse(readFileSync(join(DATA, 'pixel/cameras.json'), 'utf8')) as CameraEntry[];
        // These files keep no comments, so the water comes with the scene.
        const water = JSON.parse(readFileSync(join(DATA, 'pixel/water.json'), 'utf8')) as unknown;
        const serving = await serve(join(WEB, 'dist'), () => ({
            'scene.json': Buffer.from(JSON.stringify({ name, model: name, cameras, water })),
            [name]: path,
        }));
        const { page, complaints } = await newPage(browser, { viewport: SMALL_WINDOW });
        await page.goto(`${serving.address}/other/view.html`);
        await page.waitForFunction(() => document.querySelector<HTMLElement>('#viewer')?.fathomViewer, null, TIMEOUT);
        await shrinkViewer(page);
        for (const mode of ['clear', 'water'] as const) {
            const values: number[] = [];
            for (const camera of cameras.filter((_, i) => i % 2 === 0)) {
                const reference = readPng(join(DATA, 'renders/pixel', mode, camera.img_name));
                const base64 = await page.evaluate(
                    async ({ entry, shown }) => {
                        const viewer = document.querySelector<HTMLElement>('#viewer')!.fathomViewer!;
                        const { width, height } = entry;
                        const { data } = await viewer.picture({ width, height, camera: entry, mode: shown });
                        return btoa(Array.from(data, (byte) => String.fromCharCode(byte)).join(''));
                    },
                    { entry: camera, shown: mode as Mode },
                );
                const { width, height } = reference;
                values.push(psnr({ width, height, data: Buffer.from(base64, 'base64') }, reference));
            }
            const mean = values.reduce((sum, value) => sum + value, 0) / values.length;
            const least = Math.min(...values);
            const told = `${name} ${mode}: mean ${mean.toFixed(2)} dB, least ${least.toFixed(2)} dB, ${values.length} pictures`;
            console.log(`${told}, ${statSync(path).size} of ${statSync(MODEL).size} bytes`);
            assert.ok(least >= goal, `${told}, expected ${goal} dB`);
        }
        assert.deepEqual(complaints, []);
        await page.context().close();
        serving.close();
    });
}
