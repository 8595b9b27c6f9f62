// Prints how long frames and sorts take in Chromium without a graphics card:
//
//   npx node test/headless/times.ts MODEL.ply...

import { basename } from 'node:path';

import { launch, newPage } from './browser.ts';
import { serve } from './server.ts';

const FRAMES = 12;
/** Stage of 512 x 384 beside the panel of 304 pixels. */
const VIEWPORT = { width: 816, height: 384 };

const median = (values: number[]): string => values.toSorted((a, b) => a - b)[values.length >> 1]!.toFixed(1);

const models = process.argv.slice(2);
const serving = await serve(new URL('../../dist', import.meta.url).pathname, (name) => ({
    'scene.json': Buffer.from(JSON.stringify({ name, model: 'model.ply' })),
    'model.ply': models[Number(name)] ?? '',
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
