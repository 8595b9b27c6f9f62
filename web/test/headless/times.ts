// Prints how long frames and sorts take in Chromium without a graphics card:
//
//   npx node test/headless/times.ts MODEL.ply...
//   npx node test/headless/times.ts 1000000        a made-up sea floor with so many Gaussians of degree 3

import { basename } from 'node:path';

import { launch, newPage } from './browser.ts';
import { serve } from './server.ts';

const FRAMES = 12;
/** Stage of 512 x 384 beside the panel of 304 pixels. */
const VIEWPORT = { width: 816, height: 384 };

const median = (values: number[]): string => values.toSorted((a, b) => a - b)[values.length >> 1]!.toFixed(1);

/** Uneven ground of 16 x 16 units, covered with Gaussians that hide each other as in a trained model. */
function seaFloor(count: number): Buffer {
    const rest = Array.from({ length: 45 }, (_, i) => `f_rest_${i}`);
    const names = ['x', 'y', 'z', 'f_dc_0', 'f_dc_1', 'f_dc_2', ...rest, 'opacity'];
    const properties = [...names, 'scale_0', 'scale_1', 'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3'];
    const lines = properties.map((name) => `property float ${name}\n`).join('');
    const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${count}\n${lines}end_header\n`;
    const rows = new Float32Array(count * properties.length);
    // The same numbers each time: a linear congruential generator.
    let state = 1;
    const random = (): number => {
        state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
        return state / 2 ** 32;
    };
    const size = Math.log(16 / Math.sqrt(count));
    for (let i = 0; i < count; i++) {
        const [x, z] = [16 * random() - 8, 16 * random() - 8];
        const y = 0.4 * Math.sin(1.3 * x) * Math.cos(0.9 * z) + 0.05 * random();
        const colours = Array.from({ length: 48 }, (_, j) => (random() - 0.5) * (j < 3 ? 2 : 0.1));
        const shape = [size + random() - 0.5, size - 1.5, size + random() - 0.5];
        rows.set([x, y, z, ...colours, 4 * random() - 1, ...shape, 1, random() - 0.5, 0, random() - 0.5], i * properties.length);
    }
    return Buffer.concat([Buffer.from(header), Buffer.from(rows.buffer)]);
}

const models = process.argv.slice(2);
const contents = models.map((model) => (/^\d+$/.test(model) ? seaFloor(Number(model)) : model));
const serving = await serve(new URL('../../dist', import.meta.url).pathname, (name) => ({
    'scene.json': Buffer.from(JSON.stringify({ name, model: 'model.ply' })),
    'model.ply': contents[Number(name)] ?? '',
}));
const browser = await launch();
for (const [index, model] of models.entries()) {
    const { page } = await newPage(browser, { viewport: VIEWPORT });
    const started = Date.now();
    await page.goto(`${serving.address}/${index}/view.html`);
    await page.waitForFunction(() => document.querySelector<HTMLElement>('#viewer')?.fathomViewer, null, { timeout: 300_000 });
    const opened = Date.now() - started;
    for (const right of ['none', 'range', 'normal'] as const) {
        const result = await page.evaluate(
            async ({ count, side }) => {
                const viewer = document.querySelector<HTMLElement>('#viewer')!.fathomViewer!;
                viewer.setModes('clear', side);
                return { gaussians: viewer.gaussians, ...(await viewer.measure(count)) };
            },
            { count: FRAMES, side: right },
        );
        const times = `frame ${median(result.frame)} ms, sort ${median(result.sort)} ms, opened in ${opened} ms`;
        console.log(`${basename(model)}, ${result.gaussians} Gaussians, colour | ${right}: ${times}`);
    }
    await page.context().close();
}
await browser.close();
serving.close();
