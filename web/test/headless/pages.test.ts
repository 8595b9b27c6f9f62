// The built pages in a browser, before a real service with tokens. What they show is compared with what the JSON
// interface says.
//
// FATHOM names the program, PAGES the built pages (default: dist). Without FATHOM the tests are skipped.

import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import type { Browser, BrowserContextOptions, Locator, Page } from 'playwright-core';

import { brief } from '../../src/pages/parts/format.ts';
import { WIDE_WINDOW, launch, newPage } from './browser.ts';
import { type Picture, psnr } from './pictures.ts';
import { type JobJson, Service, serveWith } from './service.ts';
import { type Opened, accessible, finish as finishAll, fitsWindow, openAs, sleep, until } from './steps.ts';

const FATHOM = process.env['FATHOM'] ?? '';
const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const skip = FATHOM === '' ? 'FATHOM does not name the program' : false;
const SETTINGS = ['--partitions', '2x2', '--iterations', '160', '--max-gaussians', '1000'];
const TIMEOUT = { timeout: 60_000 };

/** So many lines of a log are compared: elements of their own are those in sight. */
const FIRST_LINES = 12;

type Three<T> = readonly [T, T, T];
interface WaterJson {
    readonly beta_d: Three<number>;
    readonly beta_b: Three<number>;
    readonly b_inf: Three<number>;
    readonly standard_error: Readonly<Record<'beta_d' | 'beta_b' | 'b_inf', Three<number | null> | null>> | null;
}

interface LogLine {
    readonly task: string;
    readonly level: string;
    readonly message: string;
}

let folder = '';
let data = '';
let service: Service;
let serving: Awaited<ReturnType<typeof serveWith>>;
let browser: Browser;
/** Tokens: a submitter and a viewer of one tenant, and a submitter of another. */
const tokens = { ana: '', vera: '', otto: '', worker: '' };
/** The job that is followed to its end. */
let reef = '';

const jobOf = (id: string): Promise<JobJson> => service.api<JobJson>(service.operator, `jobs/${id}`);

const open = (route: string, token = '', options: BrowserContextOptions = {}): Promise<Opened> =>
    openAs(browser, `${serving.address}/${route}`, token, options);

const textOf = async (locator: Locator): Promise<string> => ((await locator.textContent()) ?? '').trim();
const header = (page: Page): Locator => page.locator('.job-head');
const stateOf = (page: Page): Promise<string> => textOf(header(page).locator('.chip'));
const finish = (page: Page, complaints: string[], allowed: RegExp | null = null): Promise<void> =>
    finishAll({ page, complaints }, allowed);
/** What Chromium itself writes when a server is away. */
const BROKEN = /net::ERR_|Failed to load resource/;

before(async () => {
    if (skip !== false) {
        return;
    }
    folder = mkdtempSync(join(tmpdir(), 'fathom-pages-'));
    data = join(folder, 'reef');
    service = await Service.start(FATHOM, folder);
    execFileSync(FATHOM, ['synth', data, '--views', '20', '--size', '96x72'], { stdio: 'ignore' });
    tokens.ana = service.token('ana', '--role', 'submitter', '--tenant', 'reef');
    tokens.vera = service.token('vera', '--role', 'viewer', '--tenant', 'reef');
    tokens.otto = service.token('otto', '--role', 'submitter', '--tenant', 'wreck');
    tokens.worker = service.token('gpu', '--role', 'worker');
    serving = await serveWith(PAGES, service.webPort);
    browser = await launch();
}, TIMEOUT);

after(async () => {
    await browser?.close();
    serving?.close();
    await service?.stop();
    if (folder !== '') {
        rmSync(folder, { recursive: true, force: true });
    }
});

test('a wrong token is refused, and a right one signs in', { skip, ...TIMEOUT }, async () => {
    const { page, complaints } = await open('#/jobs');
    await page.getByLabel('Token').fill('fathom_0123_wrong');
    await page.getByRole('button', { name: 'Sign in' }).click();
    await page.getByText('The service does not accept this token.').waitFor();
    await accessible(page, 'sign in');
    await page.getByLabel('Token').fill(tokens.worker);
    await page.keyboard.press('Enter');
    await page.getByText('This is the token of a worker.').waitFor();
    await page.getByLabel('Token').fill(tokens.ana);
    await page.keyboard.press('Enter');
    await page.getByRole('heading', { name: 'No jobs yet' }).waitFor();
    assert.match(await page.getByLabel('Command').inputValue(), /^fathom submit /);
    await accessible(page, 'an empty list');
    const kept = await page.evaluate(() => [Object.values(localStorage), Object.values(sessionStorage)]);
    assert.deepEqual(kept, [[], [tokens.ana]], 'the token is in the session of the tab only');
    await page.reload();
    await page.getByRole('heading', { name: 'No jobs yet' }).waitFor();
    await page.getByRole('button', { name: 'Sign out' }).click();
    await page.getByLabel('Token').waitFor();
    assert.equal(await page.evaluate(() => sessionStorage.length), 0);
    await page.reload();
    await page.getByLabel('Token').waitFor();
    await finish(page, complaints);
});

test('a link with a token signs in, and the token leaves the address', { skip, ...TIMEOUT }, async () => {
    const { page, complaints } = await open(`#/jobs?token=${tokens.ana}`);
    await page.getByRole('heading', { name: 'Jobs', exact: true }).waitFor();
    assert.equal(new URL(page.url()).hash, '#/jobs');
    await finish(page, complaints);
});

test('a job appears in the list with what it waits for', { skip, ...TIMEOUT }, async () => {
    const { page, complaints } = await open('#/jobs', tokens.ana);
    await page.getByRole('heading', { name: 'No jobs yet' }).waitFor();
    reef = service.submit(tokens.ana, data, ...SETTINGS, '--name', 'Reef & wreck <1>');
    const row = page.getByRole('row', { name: 'Reef & wreck <1>' });
    await row.waitFor();
    await row.getByText('Waiting').waitFor();
    await accessible(page, 'a list');
    await page.getByLabel('Name contains').fill('nothing of this name');
    await page.getByRole('heading', { name: 'No job matches' }).waitFor();
    await page.getByRole('button', { name: 'Show all jobs' }).click();
    await page.getByLabel('State').selectOption('failed');
    await page.getByRole('heading', { name: 'No job matches' }).waitFor();
    await page.getByLabel('State').selectOption('running');
    await row.getByRole('link').click();
    const job = await jobOf(reef);
    assert.ok(job.waiting_reason);
    await header(page).getByText(job.waiting_reason).waitFor();
    assert.equal(await stateOf(page), 'Waiting');
    assert.equal(await textOf(page.locator('h1')), job.name);
    await finish(page, complaints);
});

test('the queue names what a waiting job lacks', { skip, ...TIMEOUT }, async () => {
    const { page, complaints } = await open('#/service/queue', service.operator);
    const row = page.getByRole('row', { name: 'Reef & wreck <1>' });
    const { waiting_reason: reason, priority } = await jobOf(reef);
    assert.ok(reason);
    const cells = row.locator('th, td');
    await until('what is lacking', async () => (await textOf(cells.last())).startsWith(`${reason} (`));
    const [name, state, , , tenant, shownPriority] = await cells.allTextContents();
    assert.deepEqual([name, state, tenant, shownPriority], ['Reef & wreck <1>', 'Waiting', 'reef', String(priority)]);
    await page.getByText('1 open job, 1 waiting for a worker').waitFor();
    await accessible(page, 'a queue');
    await finish(page, complaints);
});

test('another tenant does not find the job, and a viewer cannot change it', { skip, ...TIMEOUT }, async () => {
    const other = await open(`#/jobs/${reef}`, tokens.otto);
    await other.page.getByRole('heading', { name: 'Job not found' }).waitFor();
    assert.ok(!(await other.page.content()).includes('Reef'));
    await accessible(other.page, 'a job that is not found');
    await finish(other.page, other.complaints);
    const viewer = await open(`#/jobs/${reef}`, tokens.vera);
    await viewer.page.getByRole('heading', { name: 'Reef & wreck <1>' }).waitFor();
    assert.equal(await header(viewer.page).getByRole('button').count(), 0);
    assert.equal(await viewer.page.getByRole('link', { name: 'Service' }).count(), 0);
    await viewer.page.goto(`${serving.address}/#/service`);
    await viewer.page.getByRole('heading', { name: 'There is no such page' }).waitFor();
    await finish(viewer.page, viewer.complaints);
});

test('a job is paused, changed, resumed, and cancelled', { skip, ...TIMEOUT }, async () => {
    const id = service.submit(tokens.ana, data, ...SETTINGS, '--name', 'To cancel');
    const { page, complaints } = await open(`#/jobs/${id}`, tokens.ana);
    await header(page).getByRole('button', { name: 'Pause' }).click();
    await accessible(page, 'a question');
    await page.getByLabel('Reason (optional)').fill('the generator is needed elsewhere');
    await page.getByRole('dialog').getByRole('button', { name: 'Pause' }).click();
    await header(page).getByText('Paused: the generator is needed elsewhere').waitFor();
    let job = await jobOf(id);
    assert.deepEqual([job.state, job.pause_reason, await stateOf(page)], ['paused', 'the generator is needed elsewhere', 'Paused']);

    await header(page).getByRole('button', { name: 'Priority' }).click();
    await page.getByLabel('Priority', { exact: true }).fill('5');
    await page.getByLabel('Tasks at a time').fill('2');
    await page.getByRole('button', { name: 'Save' }).click();
    await header(page).getByText('priority 5 · at most 2 tasks at a time').waitFor();
    job = await jobOf(id);
    assert.deepEqual([job.priority, job.max_parallel], [5, 2]);

    await header(page).getByRole('button', { name: 'Resume' }).click();
    await until('the job goes on', async () => (await stateOf(page)) === 'Waiting');
    assert.equal((await jobOf(id)).state, 'running');

    await header(page).getByRole('button', { name: 'Cancel' }).click();
    await page.keyboard.press('Escape');
    assert.equal((await jobOf(id)).state, 'running', 'Escape asks for nothing');
    await header(page).getByRole('button', { name: 'Cancel' }).click();
    await page.getByLabel('Reason (optional)').fill('wrong photographs');
    await page.getByRole('button', { name: 'Cancel the job' }).click();
    await until('the job is cancelled', async () => (await stateOf(page)) === 'Cancelled');
    job = await jobOf(id);
    assert.equal(job.state, 'cancelled');
    assert.match(job.error ?? '', /wrong photographs/);
    await header(page).getByText(job.error ?? '').waitFor();

    await header(page).getByRole('button', { name: 'Delete' }).click();
    await page.getByRole('button', { name: 'Delete the job' }).click();
    await page.getByRole('row', { name: 'Reef & wreck <1>' }).waitFor();
    assert.equal(await page.getByRole('row', { name: 'To cancel' }).count(), 0);
    await finish(page, complaints, /404/);
});

test('a job is followed to its end, across a restart of the coordinator', { skip, timeout: 90_000 }, async () => {
    const { page, complaints } = await open(`#/jobs/${reef}`, tokens.ana);
    await page.getByRole('heading', { name: 'Reef & wreck <1>' }).waitFor();
    await page.evaluate(() => {
        (window as unknown as { isSamePage: boolean }).isSamePage = true;
    });
    service.startWorker(tokens.worker, 'gpu-1');
    await until('the job runs', async () => (await stateOf(page)) === 'Running');
    await until('progress is shown', async () => {
        const shown = Number.parseInt(await textOf(header(page).locator('.job-progress strong')), 10);
        return shown >= 10;
    });
    await accessible(page, 'a job that runs');

    await service.kill();
    await page.getByText('Connection lost; trying again').waitFor();
    await accessible(page, 'a lost connection');
    await service.startCoordinator();
    await page.getByText('Connection lost; trying again').waitFor({ state: 'detached' });

    await until('the job succeeds', async () => (await stateOf(page)) === 'Succeeded', 70);
    const job = await jobOf(reef);
    assert.equal(job.state, 'succeeded');
    assert.equal(await textOf(header(page).locator('.job-progress strong')), '100 %');
    assert.ok((await textOf(header(page))).includes(`${job.partitions} partitions`));
    await page.getByText('Tasks as a list').click();
    const rows = page.getByRole('table', { name: 'Tasks' }).getByRole('row');
    await until('all tasks are shown', async () => (await rows.count()) === job.tasks.length + 1);
    const shown = await page.getByRole('table', { name: 'Tasks' }).locator('.chip').allTextContents();
    assert.deepEqual(shown, job.tasks.map(() => 'Done'));
    assert.equal(await page.evaluate(() => (window as unknown as { isSamePage?: boolean }).isSamePage), true, 'no reload');
    await finish(page, complaints, BROKEN);
});

test('the sections of a job show its log, files, settings and pictures', { skip, ...TIMEOUT }, async () => {
    const { page, complaints } = await open(`#/jobs/${reef}`, tokens.vera);
    const section = async (name: string): Promise<void> => {
        await page.getByRole('navigation', { name: 'Sections of the job' }).getByRole('link', { name }).click();
        await page.locator('.section .loading').waitFor({ state: 'detached' });
    };
    await page.getByRole('heading', { name: 'Stages' }).waitFor();
    await accessible(page, 'the overview of a job that has ended');

    await section('Log');
    const { lines } = await service.api<{ lines: LogLine[] }>(tokens.vera, `jobs/${reef}/logs?limit=10000`);
    await page.getByText(new RegExp(`^${lines.length} lines$`)).waitFor();
    const last = page.locator('.log-line').last();
    await until('the last line is in sight', async () => (await textOf(last.locator('.log-message'))) === lines.at(-1)?.message);
    await page.getByLabel('Level').selectOption('Warnings and errors');
    const warnings = lines.filter(({ level }) => level === 'warn' || level === 'error').length;
    await page.getByText(`${warnings} of ${lines.length} lines`).waitFor();
    await page.getByLabel('Level').selectOption('All');
    const shownLines = (): Promise<string[]> => page.locator('.log-line .log-message').allTextContents();
    const inSight = async (wanted: readonly LogLine[], what: string): Promise<void> => {
        assert.ok(wanted.length > 0 && wanted.length < lines.length, `${what}: ${wanted.length} of ${lines.length} lines`);
        await page.getByText(`${wanted.length} of ${lines.length} lines`, { exact: true }).waitFor();
        await page.locator('.log').evaluate((log) => (log.scrollTop = 0));
        const most = wanted.slice(0, FIRST_LINES).map(({ message }) => message);
        await until(what, async () => JSON.stringify((await shownLines()).slice(0, FIRST_LINES)) === JSON.stringify(most), 5).catch(() => {});
        assert.deepEqual((await shownLines()).slice(0, FIRST_LINES), most, what);
    };
    for (const task of new Set(lines.map((line) => line.task))) {
        await page.getByLabel('Task', { exact: true }).selectOption(task);
        await inSight(lines.filter((line) => line.task === task), task);
    }
    await page.getByLabel('Task', { exact: true }).selectOption('All tasks');
    // Capitals do not matter. Of the words of the log, one that not every line has.
    const wordOf = ({ message }: LogLine): string => /[a-z]{5,}/.exec(message)?.[0] ?? '';
    const having = (word: string): readonly LogLine[] => lines.filter(({ message }) => message.toLowerCase().includes(word));
    const word = lines.map(wordOf).find((one) => one !== '' && having(one).length < lines.length) ?? '';
    await page.getByLabel('Message contains').fill(word.toUpperCase());
    await inSight(having(word), word);
    const [{ task: taskOfWord }] = having(word) as [LogLine];
    await page.getByLabel('Task', { exact: true }).selectOption(taskOfWord);
    await inSight(having(word).filter(({ task }) => task === taskOfWord), `${word} of ${taskOfWord}`);
    await page.getByLabel('Message contains').fill('no line has these words');
    await page.getByText(`0 of ${lines.length} lines`).waitFor();
    assert.deepEqual(await shownLines(), []);
    await accessible(page, 'the log');

    await section('Files');
    const { files } = await service.api<{ files: { path: string; bytes: number; digest: string }[] }>(tokens.vera, `jobs/${reef}/files`);
    await page.getByText('Pictures of held-out views').click();
    const names = page.locator('.files .name .mono');
    await until('the pictures are listed too', async () => (await names.count()) === files.length, 5).catch(() => {});
    assert.deepEqual((await names.allTextContents()).toSorted(), files.map(({ path }) => path).toSorted());
    const downloading = page.waitForEvent('download');
    await page.getByRole('button', { name: 'Download model.ply' }).click();
    const download = await downloading;
    assert.equal(download.suggestedFilename(), 'model.ply');
    assert.equal(readFileSync(await download.path()).length, files.find(({ path }) => path === 'model.ply')?.bytes);
    await accessible(page, 'the files');

    await section('Settings');
    const { config } = await service.api<{ config: { train: { iterations: number } } }>(tokens.vera, `jobs/${reef}`);
    const iterations = page.locator('.settings > div').filter({ has: page.getByText('iterations', { exact: true }) }).first();
    assert.equal(await textOf(iterations.locator('dd')), String(config.train.iterations));
    await accessible(page, 'the settings');

    await section('Water');
    await page.getByRole('heading', { name: 'Attenuation of direct light' }).waitFor();
    const water = await service.api<WaterJson>(tokens.vera, `jobs/${reef}/files/water.json`);
    const errors: (number | null)[] = [];
    for (const parameter of ['beta_d', 'beta_b', 'b_inf'] as const) {
        const rows = page.locator('.fp-water-parameter').filter({ has: page.locator('code', { hasText: parameter }) }).locator('tbody tr');
        const shown = await rows.evaluateAll((all) => all.map((row) => [...row.children].slice(0, 3).map(({ textContent }) => textContent)));
        const expected = ['Red', 'Green', 'Blue'].map((channel, at) => {
            const error = water.standard_error?.[parameter]?.[at] ?? null;
            errors.push(error);
            return [channel, brief(water[parameter][at]!), error === null ? '–' : brief(error, 2)];
        });
        assert.deepEqual(shown, expected, parameter);
    }
    assert.ok(errors.some((error) => error !== null), 'an error is known');
    await accessible(page, 'the water');

    await section('Views');
    await until('a picture is shown', () =>
        page.evaluate(() => [...document.querySelectorAll<HTMLImageElement>('.section img')].some(({ naturalWidth }) => naturalWidth > 0)),
    );
    const metrics = await service.api<{ views: { name: string; psnr: number }[] }>(tokens.vera, `jobs/${reef}/files/metrics.json`);
    const worstFirst = metrics.views.toSorted((a, b) => a.psnr - b.psnr);
    assert.ok(worstFirst.length > 1);
    const entries = await page
        .locator('.fp-compare-list .fp-compare-words')
        .evaluateAll((all) => all.map(({ children }) => [...children].map(({ textContent }) => textContent)));
    assert.deepEqual(entries, worstFirst.map((view) => [view.name, `${view.psnr.toFixed(2)} dB`]));
    await accessible(page, 'the held-out views');

    await section('Curves');
    await page.locator('.fp-curves canvas').first().waitFor();
    await accessible(page, 'the curves');

    // Without a graphics card the viewer draws slowly.
    await page.setViewportSize(WIDE_WINDOW);
    await section('Viewer');
    const gaussians = await page
        .waitForFunction(() => document.querySelector<HTMLElement>('.viewer-host')?.fathomViewer?.gaussians, null, TIMEOUT)
        .then((handle) => handle.jsonValue());
    const { gaussians: expected } = await service.api<{ gaussians: number }>(tokens.vera, `jobs/${reef}/files/metrics.json`);
    assert.equal(gaussians, expected);
    const taken = async (mode: 'clear' | 'water'): Promise<Picture> => {
        const size = { width: 96, height: 72 };
        const pixels = await page.evaluate(
            async ({ width, height, shown }) => {
                const viewer = document.querySelector<HTMLElement>('.viewer-host')!.fathomViewer!;
                return [...(await viewer.picture({ width, height, mode: shown })).data];
            },
            { ...size, shown: mode },
        );
        return { ...size, data: Uint8Array.from(pixels) };
    };
    const [clear, under] = [await taken('clear'), await taken('water')];
    for (const one of [clear, under]) {
        assert.ok(new Set(one.data).size > 40, 'a picture of something');
    }
    const apart = psnr(clear, under);
    assert.ok(apart < 25, `the water changes the picture: ${apart} dB`);
    await accessible(page, 'the viewer');
    // Chromium says so when it draws on the CPU.
    await finish(page, complaints, /GPU stall|WebGL/);
});

test('a link to one job shows that job and nothing else', { skip, ...TIMEOUT }, async (t) => {
    const { page, complaints } = await open(`#/jobs/${reef}`, tokens.ana);
    await header(page).getByRole('button', { name: 'Share' }).click();
    await page.getByRole('button', { name: 'Make a link' }).click();
    const field = page.getByLabel('Link', { exact: true });
    const alert = page.getByRole('dialog').getByRole('alert');
    await until('an answer', async () => (await field.count()) > 0 || (await alert.isVisible()));
    if (await alert.isVisible()) {
        t.skip(await textOf(alert));
        await page.context().close();
        return;
    }
    await page.getByText('The link is shown only once').waitFor();
    await accessible(page, 'a link');
    const link = await field.inputValue();
    await page.getByRole('button', { name: 'Done', exact: true }).click();
    await finish(page, complaints);

    const guest = await newPage(browser, {});
    await guest.page.goto(link);
    await guest.page.getByRole('heading', { name: 'Reef & wreck <1>' }).waitFor();
    assert.equal(new URL(guest.page.url()).hash, `#/jobs/${reef}`);
    assert.equal(await header(guest.page).getByRole('button').count(), 0);
    assert.equal(await guest.page.getByRole('link', { name: 'Jobs' }).count(), 0);
    await guest.page.evaluate(() => (location.hash = '#/jobs'));
    await until('the shared job stays', async () => new URL(guest.page.url()).hash === `#/jobs/${reef}`);
    await accessible(guest.page, 'a shared job');
    await finish(guest.page, guest.complaints);
});

test('operators see workers, tenants, the queue and tokens', { skip, ...TIMEOUT }, async () => {
    const { page, complaints } = await open('#/service', service.operator);
    const { workers } = await service.api<{ workers: { name: string; state: string; adapter: string }[] }>(service.operator, 'workers');
    assert.equal(workers.length, 1);
    const row = page.getByRole('row', { name: workers[0]!.name });
    await row.waitFor();
    assert.ok((await textOf(row)).includes(workers[0]!.adapter));
    await row.getByRole('button', { name: 'Cordon' }).first().click();
    await page.getByLabel('Reason (optional)').fill('new driver');
    await page.getByRole('dialog').getByRole('button', { name: 'Cordon' }).click();
    await row.getByText('Cordoned').waitFor();
    await row.getByText('new driver').waitFor();
    const cordoned = await service.api<{ workers: { state: string }[] }>(service.operator, 'workers');
    assert.equal(cordoned.workers[0]?.state, 'cordoned');
    await accessible(page, 'workers');
    await row.getByRole('button', { name: 'Uncordon' }).click();
    await row.getByText('Active').waitFor();

    const sections = page.getByRole('navigation', { name: 'Sections of the service' });
    await sections.getByRole('link', { name: 'Queue' }).click();
    await page.getByRole('heading', { name: 'The queue is empty' }).waitFor();
    await accessible(page, 'an empty queue');
    await sections.getByRole('link', { name: 'Tenants' }).click();
    const { tenants } = await service.api<{ tenants: { tenant: string }[] }>(service.operator, 'tenants');
    await page.getByRole('rowheader', { name: 'reef' }).waitFor();
    assert.deepEqual(await page.locator('.tenants tbody th.name').allTextContents(), tenants.map(({ tenant }) => tenant));
    await accessible(page, 'tenants');

    await sections.getByRole('link', { name: 'Tokens' }).click();
    await page.getByRole('button', { name: 'Issue a token' }).click();
    await page.getByLabel('Name of its holder').fill('museum');
    await page.getByLabel('Role').selectOption('viewer');
    await page.getByRole('button', { name: 'Issue', exact: true }).click();
    // A viewer needs a tenant, and the dialog says so.
    await page.getByRole('dialog').getByRole('alert').waitFor();
    await page.getByLabel('Tenant').fill('reef');
    await page.getByRole('button', { name: 'Issue', exact: true }).click();
    const field = page.getByLabel('Token', { exact: true });
    await field.waitFor();
    const secret = await field.inputValue();
    await accessible(page, 'a new token');
    assert.equal((await service.api<{ jobs: unknown[] }>(secret, 'jobs')).jobs.length, 1);
    await page.getByRole('button', { name: 'Done' }).click();
    await page.locator('dialog').waitFor({ state: 'detached' });
    assert.ok(!(await page.content()).includes(secret), 'the secret is gone');
    const token = page.getByRole('row', { name: 'museum' });
    await token.getByText('Valid').waitFor();

    const holder = await open('#/jobs', secret);
    await holder.page.getByRole('row', { name: 'Reef & wreck <1>' }).waitFor();
    await token.getByRole('button', { name: 'Revoke' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Revoke' }).click();
    await token.getByText('Revoked').waitFor();
    assert.ok((await service.api<{ error?: unknown }>(secret, 'jobs')).error);
    await holder.page.getByText('You are signed out: the token has expired or was revoked.').waitFor();
    await finish(holder.page, holder.complaints, /401/);

    // The last operator is revoked only after a second question.
    await page.getByRole('row', { name: 'first operator' }).getByRole('button', { name: 'Revoke' }).click();
    await page.getByRole('dialog').getByRole('button', { name: 'Revoke' }).click();
    await page.getByRole('heading', { name: 'This is the last operator' }).waitFor();
    await page.getByRole('button', { name: 'Keep it' }).click();
    await page.getByRole('row', { name: 'first operator' }).getByText('Valid').waitFor();
    await accessible(page, 'tokens');
    await finish(page, complaints);
});

test('a phone shows a job without sideways scrolling, in the dark too', { skip, ...TIMEOUT }, async () => {
    const { page, complaints } = await open(`#/jobs/${reef}`, tokens.ana, { viewport: { width: 360, height: 740 }, colorScheme: 'dark' });
    await page.getByRole('heading', { name: 'Stages' }).waitFor();
    for (const section of ['', '/files', '/settings', '/log', '/water', '/views']) {
        await page.evaluate((hash) => (location.hash = hash), `#/jobs/${reef}${section}`);
        await page.locator('.section .loading').waitFor({ state: 'detached' });
        await sleep(300);
        await fitsWindow(page, section);
        await accessible(page, `a phone, ${section}`);
    }
    await finish(page, complaints);
});
