// Takes the pictures of the pages for docs/using: a real service with two workers, a job that has succeeded,
// one that runs and two that wait.
//
//     FATHOM=PROGRAM node test/headless/take-pictures.ts FOLDER
//
// About 6 minutes on 2 cores. The pictures show times and measured values, so they differ from run to run.

import { execFileSync } from 'node:child_process';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import type { Locator, Page } from 'playwright-core';

import { launch } from './browser.ts';
import { type JobJson, Service, serveWith } from './service.ts';
import { openAs, sleep, until } from './steps.ts';

const FATHOM = process.env['FATHOM'] ?? '';
const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const [folder] = process.argv.slice(2);
if (FATHOM === '' || folder === undefined) {
    throw new Error('FATHOM names the program, and the argument the folder to write to');
}
const WIDTH = 1040;
const HEIGHT = 760;
const PHONE_WIDTH = 390;
/** Around what is shown, pixels. */
const MARGIN = 16;
/** Of a picture, bytes: smaller ones lose sharpness that a reader sees. */
const MOST_BYTES = 80_000;
const SCALED = ['--max-gaussians', '6000', '--eval-every', '50', '--set', 'train.preview_seconds=2'];
const SOON_S = 1200;

const work = mkdtempSync(join(tmpdir(), 'fathom-pictures-'));
const service = await Service.start(FATHOM, work);
const serving = await serveWith(PAGES, service.webPort);
const browser = await launch();

/** Writes a page from the top of an element, or its own, to the end of another; as sharp as the limit allows. */
async function take(page: Page, name: string, last: Locator, first: Locator | null = null, width = WIDTH): Promise<void> {
    await page.setViewportSize({ width, height: HEIGHT });
    await page.evaluate(() => (document.activeElement as HTMLElement | null)?.blur());
    // Nothing is under the pointer.
    await page.mouse.move(0, 0);
    // Charts and maps take the new size.
    await sleep(1000);
    const topOf = (element: Locator): Promise<number> => element.evaluate((one) => one.getBoundingClientRect().top + scrollY);
    const endOf = (element: Locator): Promise<number> => element.evaluate((one) => one.getBoundingClientRect().bottom + scrollY);
    const y = first === null ? 0 : (await topOf(first)) - MARGIN;
    const clip = { x: 0, y, width, height: (await endOf(last)) + MARGIN - y };
    let bytes: Buffer = Buffer.alloc(0);
    for (let quality = 90; quality >= 40 && (bytes.length === 0 || bytes.length > MOST_BYTES); quality -= 5) {
        bytes = await page.screenshot({ type: 'jpeg', quality, fullPage: true, clip });
    }
    writeFileSync(join(folder!, `${name}.jpg`), bytes);
    console.log(`${name}.jpg: ${clip.height} pixels high, ${bytes.length} bytes`);
}

try {
    const [wreck, reef] = [join(work, 'wreck'), join(work, 'reef')];
    execFileSync(FATHOM, ['synth', wreck, '--views', '40', '--size', '320x240'], { stdio: 'ignore' });
    execFileSync(FATHOM, ['synth', reef, '--views', '40', '--size', '240x180', '--look', 'forward'], { stdio: 'ignore' });
    const ana = service.token('ana', '--role', 'submitter', '--tenant', 'survey');
    const worker = service.token('workers', '--role', 'worker');
    for (const [data, id] of [[wreck, 'wreck-2026'], [reef, 'reef-7']] as const) {
        service.run(ana, 'dataset', 'upload', data, '--id', id, '--coordinator', service.url);
    }
    const submit = (id: string, name: string, ...flags: readonly string[]): string =>
        service.run(ana, 'submit', '--dataset', id, '--name', name, '--coordinator', service.url, ...SCALED, ...flags).split('\n').at(-1)!;
    const jobOf = (id: string): Promise<JobJson> => service.api<JobJson>(ana, `jobs/${id}`);
    ['gpu-1', 'gpu-2'].forEach((name) => service.startWorker(worker, name));

    const slope = submit('reef-7', 'Reef slope', '--partitions', '2x1', '--iterations', '240');
    await until('the first job succeeds', async () => (await jobOf(slope)).state === 'succeeded', SOON_S);
    const wreckJob = submit('wreck-2026', 'Wreck, whole', '--partitions', '2x2', '--iterations', '700');
    submit('wreck-2026', 'Wreck, finer', '--partitions', '4x2', '--iterations', '9000', '--priority', '-5');
    const paused = submit('reef-7', 'Reef slope, joint water', '--set', 'water.partitions=joint', '--partitions', '2x1');
    service.run(ana, 'pause', paused, '--reason', 'after the survey of Friday', '--coordinator', service.url);

    const signIn = await openAs(browser, `${serving.address}/#/jobs`, '', { viewport: { width: WIDTH, height: HEIGHT }, colorScheme: 'light' });
    await signIn.page.getByLabel('Token').waitFor();
    await take(signIn.page, 'sign-in', signIn.page.locator('main'));
    await signIn.page.context().close();

    const { page } = await openAs(browser, `${serving.address}/#/jobs`, ana, { viewport: { width: WIDTH, height: HEIGHT }, colorScheme: 'light' });
    const tabs = page.getByRole('navigation', { name: 'Sections of the job' });
    const show = async (route: string): Promise<void> => {
        await page.evaluate((hash) => (location.hash = hash), `#/${route}`);
        await page.locator('.section .loading').waitFor({ state: 'detached' });
        await sleep(1500);
    };

    // The new job, before anything has to be waited for.
    await show('new');
    await page.getByLabel('Name').fill('Wreck, second survey');
    await page.getByLabel('Dataset').selectOption('wreck-2026');
    await take(page, 'new-job', page.locator('main .card:visible').first());

    await show('datasets');
    await page.getByRole('row', { name: 'reef-7' }).waitFor();
    await take(page, 'datasets', page.locator('main .card').last());
    await show('new');
    await page.getByLabel('Dataset').waitFor();
    await page.locator('input[webkitdirectory]').setInputFiles(reef);
    await page.getByLabel('Upload as').fill('reef-again');
    await page.getByRole('button', { name: 'Upload and check' }).click();
    await page.locator('.plan-check-facts').waitFor({ timeout: 180_000 });
    await page.getByRole('application').waitFor();
    await take(page, 'folder', page.locator('.plan-check'));

    // What is left of a job that has succeeded.
    await show(`jobs/${slope}/views`);
    await page.locator('.fp-compare-stage img').first().waitFor();
    await take(page, 'views', page.locator('.section .card').last(), tabs);
    for (const name of ['seams', 'log', 'files'] as const) {
        await show(`jobs/${slope}/${name}`);
        await take(page, name, page.locator('.section'), tabs);
    }
    await show(`jobs/${slope}/viewer`);
    await page.waitForFunction(() => document.querySelector<HTMLElement>('.viewer-host')?.fathomViewer !== undefined);
    await take(page, 'job-viewer', page.locator('.viewer-host'), tabs);

    await show(`jobs/${slope}/water`);
    await page.getByRole('heading', { name: 'Attenuation of direct light' }).waitFor();
    await take(page, 'water', page.locator('.section .card').last(), tabs);

    // While it trains: about half of its partitions are done.
    await until('half of the job', async () => (await jobOf(wreckJob)).progress > 0.45, SOON_S);
    await show(`jobs/${wreckJob}`);
    await page.locator('.fp-plan-canvas').waitFor();
    await take(page, 'job', page.locator('.section .card').nth(1));
    await take(page, 'stages', page.locator('.fp-time'), page.getByRole('heading', { name: 'Stages' }));
    await show('jobs');
    await take(page, 'jobs', page.locator('main .card').last());
    await show(`jobs/${wreckJob}/curves`);
    await page.locator('.fp-curves canvas').first().waitFor();
    await take(page, 'curves', page.locator('.fp-curve-grid'), tabs);
    await show(`jobs/${wreckJob}/views`);
    await page.locator('.fp-compare-stage img').first().waitFor();
    await take(page, 'previews', page.locator('.section .card'), tabs);
    const operator = await openAs(browser, `${serving.address}/#/service`, service.operator, { viewport: { width: WIDTH, height: HEIGHT }, colorScheme: 'light' });
    await operator.page.getByRole('row', { name: 'gpu-2' }).waitFor();
    await take(operator.page, 'service', operator.page.locator('main .card').last());
    for (const name of ['queue', 'tenants', 'tokens'] as const) {
        await operator.page.evaluate((hash) => (location.hash = hash), `#/service/${name}`);
        await operator.page.locator('main table').waitFor();
        await take(operator.page, `service-${name}`, operator.page.locator('main .card').last());
    }

    const small = { viewport: { width: PHONE_WIDTH, height: HEIGHT } };
    const phone = await openAs(browser, `${serving.address}/#/jobs/${wreckJob}`, ana, { ...small, colorScheme: 'light' });
    await phone.page.locator('.fp-plan-canvas').waitFor();
    await take(phone.page, 'job-phone', phone.page.locator('.section .card').nth(1), null, PHONE_WIDTH);
    const dark = await openAs(browser, `${serving.address}/#/jobs/${wreckJob}`, ana, { colorScheme: 'dark' });
    await dark.page.locator('.fp-plan-canvas').waitFor();
    await take(dark.page, 'job-dark', dark.page.locator('.section .card').nth(1));
} finally {
    await browser.close();
    serving.close();
    await service.stop();
    rmSync(work, { recursive: true, force: true });
}
