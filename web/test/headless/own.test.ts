// The pages as the program itself serves them: those of a coordinator, of `fathom view`, and behind the link that
// `fathom train --web` prints. The other tests serve the built pages of this working tree instead.
//
// FATHOM names the program. Without it the tests are skipped.

import assert from 'node:assert/strict';
import { type ChildProcess, execFileSync, spawn } from 'node:child_process';
import { mkdtempSync, readFileSync, readdirSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import type { Browser, Page } from 'playwright-core';

import { VIEWER_WINDOW, WIDE_WINDOW, launch, newPage } from './browser.ts';
import { POLICY } from './server.ts';
import { type JobJson, Service } from './service.ts';
import { finish, openAs, until } from './steps.ts';

const FATHOM = process.env['FATHOM'] ?? '';
const skip = FATHOM === '' ? 'FATHOM does not name the program' : false;
const TIMEOUT = { timeout: 120_000 };
/** Chromium says so when it draws on the CPU. */
const DRAWING = /GPU stall|WebGL/;

let folder = '';
let data = '';
let service: Service;
let browser: Browser;
let ana = '';
let job = '';
const children: ChildProcess[] = [];

/** Starts a command, and waits until it has printed an address. */
async function addressOf(command: ChildProcess, pattern: RegExp): Promise<string> {
    children.push(command);
    let printed = '';
    for (const stream of [command.stdout!, command.stderr!]) {
        stream.setEncoding('utf8').on('data', (text: string) => (printed += text));
    }
    await until(`an address: ${pattern}`, async () => {
        assert.equal(command.exitCode, null, printed);
        return pattern.test(printed);
    });
    return pattern.exec(printed)![1]!;
}

const run = (...args: readonly string[]): ChildProcess => spawn(FATHOM, args, { stdio: ['ignore', 'pipe', 'pipe'] });

/** The program serves the page under the policy with which the other tests serve theirs. */
async function keepsPolicy(address: string): Promise<void> {
    const { headers } = await fetch(address);
    assert.equal(headers.get('content-security-policy'), POLICY);
}

const gaussiansOf = (page: Page, host: string): Promise<number | undefined> =>
    page
        .waitForFunction((where) => document.querySelector<HTMLElement>(where)?.fathomViewer?.gaussians, host, TIMEOUT)
        .then((handle) => handle.jsonValue());

before(async () => {
    if (skip !== false) {
        return;
    }
    folder = mkdtempSync(join(tmpdir(), 'fathom-own-'));
    data = join(folder, 'reef');
    service = await Service.start(FATHOM, folder);
    execFileSync(FATHOM, ['synth', data, '--views', '20', '--size', '96x72'], { stdio: 'ignore' });
    ana = service.token('ana', '--role', 'submitter', '--tenant', 'reef');
    job = service.submit(ana, data, '--iterations', '60', '--max-gaussians', '500', '--name', 'Embedded');
    service.startWorker(service.token('gpu', '--role', 'worker'), 'gpu-1');
    browser = await launch();
}, TIMEOUT);

after(async () => {
    await browser?.close();
    children.forEach((child) => child.kill('SIGKILL'));
    await service?.stop();
    if (folder !== '') {
        rmSync(folder, { recursive: true, force: true });
    }
});

test('the page that a coordinator serves shows its jobs, their views, logs and models', { skip, ...TIMEOUT }, async () => {
    const address = `http://127.0.0.1:${service.webPort}/`;
    await keepsPolicy(address);
    const opened = await openAs(browser, `${address}#/jobs`, ana, { viewport: WIDE_WINDOW });
    const { page } = opened;
    await page.getByRole('row', { name: 'Embedded' }).getByRole('link').click();
    const shown = page.locator('.job-head .chip');
    await until('the job succeeds', async () => (await shown.textContent()) === 'Succeeded');
    assert.equal((await service.api<JobJson>(ana, `jobs/${job}`)).state, 'succeeded');
    const section = async (name: string): Promise<void> => {
        await page.getByRole('navigation', { name: 'Sections of the job' }).getByRole('link', { name }).click();
        await page.locator('.section .loading').waitFor({ state: 'detached' });
    };
    await section('Views');
    await page.waitForFunction(() => (document.querySelector<HTMLImageElement>('.fp-compare-stage img')?.naturalWidth ?? 0) > 0);
    await section('Log');
    const { lines } = await service.api<{ lines: unknown[] }>(ana, `jobs/${job}/logs?limit=10000`);
    await page.getByText(new RegExp(`^${lines.length} lines$`)).waitFor();
    await section('Viewer');
    const { gaussians } = await service.api<{ gaussians: number }>(ana, `jobs/${job}/files/metrics.json`);
    assert.equal(await gaussiansOf(page, '.viewer-host'), gaussians);
    await finish(opened, DRAWING);
});

test('the page of fathom view shows the model', { skip, ...TIMEOUT }, async () => {
    const result = join(folder, 'result');
    service.run(ana, 'download', job, '-o', result, '--coordinator', service.url);
    const [, vertices] = /element vertex (\d+)/.exec(readFileSync(join(result, 'model.ply'), 'latin1'))!;
    const viewing = run('view', result, '--photographs', data);
    const address = await addressOf(viewing, /is at (http:\/\/\S+)/);
    await keepsPolicy(address);
    const opened = await newPage(browser, { viewport: VIEWER_WINDOW });
    await opened.page.goto(address);
    assert.equal(await gaussiansOf(opened.page, '#viewer'), Number(vertices));
    await opened.page.getByRole('button', { name: 'Next photograph' }).click();
    await opened.page.getByRole('button', { name: 'Compare with the photograph' }).click();
    await opened.page.waitForFunction(() => (document.querySelector<HTMLImageElement>('.fv-photograph')?.naturalWidth ?? 0) === 96);
    await finish(opened, DRAWING);
    viewing.kill('SIGKILL');
});

/** The part of a token that is secret. */
const secretOf = (token: string): string => token.split('_').at(-1)!;

/** Files below a folder that contain a text. */
function filesWith(below: string, text: string): string[] {
    return readdirSync(below, { recursive: true, withFileTypes: true })
        .filter((entry) => entry.isFile())
        .map((entry) => join(entry.parentPath, entry.name))
        .filter((path) => readFileSync(path).includes(text));
}

test('the link of fathom train shows the run, and no log has its token', { skip, ...TIMEOUT }, async () => {
    const result = join(folder, 'trained');
    // Far too long: it is ended as soon as the page was seen.
    const training = run('train', data, '-o', result, '--allow-cpu', '--web=true', '--iterations', '9000', '--max-gaussians', '500');
    const link = await addressOf(training, /see the run at (http:\/\/\S+#(?:token|invitation)=\S+)/);
    await keepsPolicy(link);
    const opened = await newPage(browser);
    const { page } = opened;
    await page.goto(link);
    await page.getByRole('heading', { name: 'reef', exact: true }).waitFor();
    await until('the run is shown', async () => (await page.locator('.job-head .chip').textContent()) === 'Running');
    assert.match(new URL(page.url()).hash, /^#\/jobs\/[0-9a-f]+$/, 'the token leaves the address');
    await page.getByRole('link', { name: 'Curves' }).click();
    await page.locator('.fp-curves canvas').first().waitFor();
    const used = await page.evaluate(() => sessionStorage.getItem('fathom.token') ?? '');
    assert.match(used, /^fathom_/);
    await finish(opened);
    const ended = new Promise((done) => training.once('exit', done));
    training.kill('SIGINT');
    await ended;

    const logs = readdirSync(join(result, 'logs'));
    assert.ok(logs.includes('coordinator.log') && logs.includes('worker-0.log'), logs.join(', '));
    for (const secret of [secretOf(used), secretOf(link)]) {
        assert.ok(secret.length >= 32, 'a secret');
        assert.deepEqual(filesWith(result, secret).filter((path) => !path.endsWith('.token')), []);
    }
});

test('no file of a coordinator and its workers has the secret of a token', { skip, ...TIMEOUT }, () => {
    const log = readFileSync(service.logPath, 'utf8');
    assert.ok(log.includes(job), 'the coordinator logs what it does');
    for (const secret of [ana, service.operator].map(secretOf)) {
        assert.deepEqual(filesWith(folder, secret).filter((path) => !path.endsWith('operator.token')), []);
    }
});
