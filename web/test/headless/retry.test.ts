// A job that fails and is retried, before a real service: a photograph is damaged on the disk of the
// coordinator, and sent again. While the job goes on, the map of its plan and its curves are compared with what
// the JSON interface says.
//
// FATHOM names the program, PAGES the built pages (default: dist). Without FATHOM the tests are skipped.

import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { chmodSync, mkdtempSync, readFileSync, readdirSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import type { Browser, Page } from 'playwright-core';

import { launch } from './browser.ts';
import { type JobJson, Service, serveWith } from './service.ts';
import { type Opened, accessible, finish, openAs, sleep, until } from './steps.ts';

const FATHOM = process.env['FATHOM'] ?? '';
const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const skip = FATHOM === '' ? 'FATHOM does not name the program' : false;
const SETTINGS = ['--partitions', '2x1', '--iterations', '240', '--max-gaussians', '1000', '--eval-every', '100'];
const TIMEOUT = { timeout: 120_000 };
const PHOTOGRAPH = 'v0005.png';

interface Point {
    readonly attempt: number;
    readonly iteration: number;
    readonly loss: number;
    readonly gaussians: number;
    readonly iterations_per_second: number;
    readonly memory_bytes: number;
    readonly held_out: { readonly psnr: number } | null;
}
interface HistoryJson {
    readonly tasks: readonly { readonly task: string; readonly points: readonly Point[] }[];
}

let folder = '';
let data = '';
let service: Service;
let serving: Awaited<ReturnType<typeof serveWith>>;
let browser: Browser;
let job = '';
let ana = '';
/** Two pages of the same job, open from the failure to the end. */
let overview: Opened;
let curves: Opened;

const open = (section: string): Promise<Opened> => openAs(browser, `${serving.address}/#/jobs/${job}${section}`, ana);
const jobNow = (): Promise<JobJson> => service.api<JobJson>(ana, `jobs/${job}`);
const stateOf = (page: Page): Promise<string | null> => page.locator('.job-head .chip').textContent();

/** Changes one byte of the file that the coordinator keeps of a photograph, as a bad disk would. */
function damage(photograph: string): void {
    const kept = join(folder, 'data');
    const content = readFileSync(join(data, 'images', photograph));
    const found = readdirSync(kept, { recursive: true, withFileTypes: true })
        .filter((entry) => entry.isFile())
        .map((entry) => join(entry.parentPath, entry.name))
        .filter((path) => readFileSync(path).equals(content));
    assert.equal(found.length, 1, 'the coordinator keeps the photograph once');
    content[content.length >> 1]! ^= 1;
    chmodSync(found[0]!, 0o644);
    writeFileSync(found[0]!, content);
}

before(async () => {
    if (skip !== false) {
        return;
    }
    folder = mkdtempSync(join(tmpdir(), 'fathom-retry-'));
    data = join(folder, 'reef');
    service = await Service.start(FATHOM, folder);
    execFileSync(FATHOM, ['synth', data, '--views', '20', '--size', '96x72'], { stdio: 'ignore' });
    ana = service.token('ana', '--role', 'submitter', '--tenant', 'reef');
    serving = await serveWith(PAGES, service.webPort);
    browser = await launch();
    job = service.submit(ana, data, ...SETTINGS, '--name', 'Damaged');
    damage(PHOTOGRAPH);
    service.startWorker(service.token('gpu', '--role', 'worker'), 'gpu-1');
}, TIMEOUT);

after(async () => {
    await browser?.close();
    serving?.close();
    await service?.stop();
    if (folder !== '') {
        rmSync(folder, { recursive: true, force: true });
    }
});

test('a job that failed shows why, and offers Retry', { skip, ...TIMEOUT }, async () => {
    overview = await open('');
    curves = await open('/curves');
    const { page } = overview;
    await until('the job fails', async () => (await stateOf(page)) === 'Failed');
    const { error, state } = await jobNow();
    assert.equal(state, 'failed');
    assert.ok(error?.includes(PHOTOGRAPH), `the error names the photograph: ${error}`);
    assert.equal(await page.locator('.job-head').getByRole('alert').textContent(), error);
    await page.locator('.job-head').getByRole('button', { name: 'Retry' }).waitFor();
    await curves.page.getByText('No curves yet.').waitFor();
    await accessible(page, 'a job that failed');
    for (const one of [overview.page, curves.page]) {
        await one.evaluate(() => ((window as unknown as { isSamePage: boolean }).isSamePage = true));
    }
});

/** The states of the partitions as the map names them, from the tasks of the JSON interface. */
async function cellsOf(): Promise<string[]> {
    const { tasks } = await jobNow();
    const words: Readonly<Record<string, string>> = { blocked: 'waiting', ready: 'waiting' };
    return tasks.filter(({ task }) => task.startsWith('partition-')).map(({ state }) => words[state] ?? state);
}

/** What the map says, in its table and in its name. */
const mapOf = (page: Page): Promise<{ cells: string[]; name: string }> =>
    page.evaluate(() => ({
        cells: [...document.querySelectorAll('.fp-plan tbody .fp-state')].map(({ textContent }) => textContent ?? ''),
        name: document.querySelector('.fp-plan-canvas')?.getAttribute('aria-label') ?? '',
    }));

test('after Retry the job goes on, and the map follows its tasks', { skip, ...TIMEOUT }, async (t) => {
    const { page } = overview;
    await page.getByText('The plan as a table').click();
    const whileFailed = await cellsOf();
    await until('the map of the failed job', async () => JSON.stringify((await mapOf(page)).cells) === JSON.stringify(whileFailed));
    // The photograph is sent again.
    service.run(ana, 'dataset', 'upload', data, '--id', 'reef-again', '--coordinator', service.url);
    await page.locator('.job-head').getByRole('button', { name: 'Retry' }).click();
    await page.getByText('The job is tried again.').waitFor();
    await page.locator('.job-head').getByRole('alert').waitFor({ state: 'hidden' });

    const seen = new Set<string>();
    let state = '';
    while (state !== 'succeeded') {
        const cells = await cellsOf();
        await until(`the map shows ${cells.join(', ')}`, async () => {
            const shown = await mapOf(page);
            const isSame = JSON.stringify(shown.cells) === JSON.stringify(cells);
            if (isSame) {
                for (const word of new Set(cells)) {
                    const count = cells.filter((one) => one === word).length;
                    assert.ok(shown.name.includes(`${count} ${word}`), `${cells.join(', ')}: ${shown.name}`);
                }
                seen.add(cells.join(' '));
            }
            // What the job has left behind meanwhile need not be shown any more.
            return isSame || JSON.stringify(await cellsOf()) !== JSON.stringify(cells);
        });
        ({ state } = await jobNow());
        assert.ok(state === 'running' || state === 'succeeded', state);
        await sleep(50);
    }
    t.diagnostic(`states of the map: ${[...seen].join('; ')}`);
    const mixed = [...seen].filter((cells) => cells.includes('running') && cells.includes('waiting'));
    assert.ok(mixed.length > 0, 'the map was seen while some partitions ran and others waited');
    assert.ok([...seen].some((cells) => cells.includes('done') && cells.includes('running')), 'and while some were done');
    await until('the page shows the success', async () => (await stateOf(page)) === 'Succeeded');
    const { error, tasks } = await jobNow();
    assert.equal(error, null);
    assert.equal(tasks.find(({ task }) => task === 'global')?.attempts, 2);
    assert.equal(await page.evaluate(() => (window as unknown as { isSamePage?: boolean }).isSamePage), true, 'no reload');
    await finish(overview);
});

/** The name of a task on the page. */
function labelOf(task: string): string {
    const [name = '', number] = task.split('-');
    const labels: Readonly<Record<string, string>> = { global: 'Coarse model', partition: 'Partition', evaluate: 'Evaluation' };
    return number === undefined ? labels[name]! : `${labels[name]} ${Number(number)}`;
}

/** A number in the words of the page, such as "1,234", "0.136" or "3.41 MiB"; null where there is none. */
function numberOf(text: string): number | null {
    const match = /^(\d[\d,.]*)(?: (B|KiB|MiB|GiB))?$/.exec(text);
    const power = { B: 0, KiB: 1, MiB: 2, GiB: 3 }[match?.[2] ?? 'B'];
    return match === null ? null : Number(match[1]!.replaceAll(',', '')) * 1024 ** power!;
}

test('curves end with the last point of the history', { skip, ...TIMEOUT }, async () => {
    const { page } = curves;
    const { tasks } = await service.api<HistoryJson>(ana, `jobs/${job}/history`);
    assert.ok(tasks.length >= 4, 'every task that trains or evaluates has a history');
    const valuesOf = (point: Point): (number | null)[] => [
        point.loss > 0 ? point.loss : null,
        point.held_out?.psnr ?? null,
        point.gaussians,
        point.iterations_per_second > 0 ? point.iterations_per_second : null,
        point.memory_bytes > 0 ? point.memory_bytes : null,
    ];
    // Three digits are shown, of a PSNR four.
    const isShown = (text: string, value: number | null): boolean => {
        const shown = numberOf(text);
        return value === null || shown === null ? shown === value : Math.abs(shown - value) <= 0.0051 * Math.abs(value);
    };
    const wrong = async (): Promise<string[]> => {
        const [rows, charts] = await page.evaluate(() => {
            const texts = (elements: Iterable<Element>): string[] => [...elements].map(({ textContent }) => textContent ?? '');
            return [
                [...document.querySelectorAll('.fp-curves tbody tr')].map((row) => texts(row.children)),
                [...document.querySelectorAll('.fp-curve-readout')].map((chart) => texts(chart.children)),
            ] as const;
        });
        const found: string[] = rows.length === tasks.length ? [] : [`${rows.length} rows of ${tasks.length}`];
        for (const { task, points } of tasks) {
            const label = labelOf(task);
            const point = points.at(-1)!;
            const values = valuesOf(point);
            const [, , attempt, iteration, ...shown] = rows.find(([name]) => name === label) ?? [];
            if (numberOf(attempt ?? '') !== point.attempt || numberOf(iteration ?? '') !== point.iteration) {
                found.push(`${task}: attempt ${attempt}, iteration ${iteration} for ${JSON.stringify(point)}`);
            }
            values.forEach((value, column) => {
                const text = charts[column]?.find((line) => line.startsWith(`${label} `))?.slice(label.length + 1);
                // A chart shows the latest value that there is.
                const inChart = value ?? points.map((one) => valuesOf(one)[column]).findLast((one) => one !== null) ?? null;
                if (!isShown(shown[column] ?? '', value) || !isShown(text ?? '–', inChart)) {
                    found.push(`${task}, column ${column}: "${shown[column]}" and "${text}" for ${value}`);
                }
            });
        }
        return found;
    };
    await page.getByText('The latest values as a table').click();
    await until('the last points are shown', async () => (await wrong()).length === 0, 20).catch(() => {});
    assert.deepEqual(await wrong(), []);
    assert.ok(tasks.some(({ points }) => points.at(-1)?.held_out), 'a PSNR is among them');
    assert.equal(await page.evaluate(() => (window as unknown as { isSamePage?: boolean }).isSamePage), true, 'no reload');
    await finish(curves);
});
