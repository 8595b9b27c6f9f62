// A job that fails and is retried, before a real service: a photograph is damaged on the disk of the
// coordinator, and sent again. While the job goes on, the map of its plan and its curves are compared with what
// the JSON interface says. Afterwards its timeline is, and its curves once more after the coordinator died.
//
// FATHOM names the program, PAGES the built pages (default: dist). Without FATHOM the tests are skipped.

import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { chmodSync, mkdtempSync, readFileSync, readdirSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, test } from 'node:test';
import type { Browser, Page } from 'playwright-core';

import { areaOf, cameraAt, placeCameras, project } from '../../src/pages/parts/plan-layout.ts';
import type { ManifestContent, MapCamera, PlanContent, PlanPartition, Projection } from '../../src/pages/parts/plan-layout.ts';
import { launch } from './browser.ts';
import { type JobJson, Service, serveWith } from './service.ts';
import { type Opened, accessible, askAgain, finish, openAs, sleep, until } from './steps.ts';

const FATHOM = process.env['FATHOM'] ?? '';
const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const skip = FATHOM === '' ? 'FATHOM does not name the program' : false;
const SETTINGS = ['--partitions', '2x1', '--iterations', '240', '--max-gaussians', '1000', '--eval-every', '100'];
const TIMEOUT = { timeout: 120_000 };
/** The coordinator stores new points of histories every 5 s. */
const KEPT_AFTER_MS = 7000;
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
/** What the JSON interface says of a task. */
interface TaskJson {
    readonly task: string;
    readonly stage: string;
    readonly partition: number | null;
    readonly attempts: number;
    readonly worker: string | null;
    readonly iteration: number;
    readonly iterations: number;
    readonly last_errors: readonly string[];
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
/** What the task said that failed. */
let failure = '';
/** Two pages of the same job, open from the failure to the end. */
let overview: Opened;
let curves: Opened;

const open = (section: string): Promise<Opened> => openAs(browser, `${serving.address}/#/jobs/${job}${section}`, ana);
const jobNow = (): Promise<JobJson> => service.api<JobJson>(ana, `jobs/${job}`);
const tasksNow = async (): Promise<readonly TaskJson[]> =>
    (await service.api<{ tasks: readonly TaskJson[] }>(ana, `jobs/${job}`)).tasks;
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
    const told = (await tasksNow()).flatMap(({ last_errors: errors }) => errors).at(-1) ?? '';
    assert.ok(told.startsWith('attempt 1 on gpu-1: ') && told.includes(PHOTOGRAPH), `a task has the error: ${told}`);
    failure = told.slice(told.indexOf(': ') + 2);
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
});

/** The name of a task in the timeline. */
function rowOf({ stage, partition }: TaskJson): string {
    const names: Readonly<Record<string, string>> = { plan: 'Plan', global: 'Coarse model', partition: 'Partition', merge: 'Merge' };
    const name = names[stage] ?? stage[0]!.toUpperCase() + stage.slice(1);
    return partition === null ? name : `${name} ${partition}`;
}

test('the timeline has a bar for each attempt, and says why one failed', { skip, ...TIMEOUT }, async () => {
    const { page } = overview;
    const expected = (await tasksNow()).map((task) => `${rowOf(task)}: ${task.attempts}`).toSorted();
    const rows = page.locator('.fp-time-rows > li');
    const shown = (): Promise<string[]> =>
        rows.evaluateAll((all) =>
            all
                .map((row) => `${row.querySelector('.fp-time-label')?.textContent}: ${row.querySelectorAll('.fp-time-bar').length}`)
                .toSorted(),
        );
    await until('a bar for each attempt', async () => JSON.stringify(await shown()) === JSON.stringify(expected), 10).catch(() => {});
    assert.deepEqual(await shown(), expected);
    const bars = rows.filter({ hasText: 'Coarse model' }).locator('.fp-time-bar');
    const outcomes = await bars.evaluateAll((all) => all.map((bar) => (bar as HTMLElement).dataset['outcome']));
    assert.deepEqual(outcomes, ['failed', 'done']);
    const label = (await bars.first().getAttribute('aria-label')) ?? '';
    assert.ok(label.startsWith('global, attempt 1 on gpu-1,') && label.endsWith(failure), label);
    // The latest comes first.
    const notes = await page.locator('.fp-notes li').allTextContents();
    assert.ok(notes.some((text) => text.includes(`global Attempt 1 on gpu-1 failed, and no other will follow: ${failure}`)), notes.join('\n'));
});

test('the map says who trained each partition, and how well', { skip, ...TIMEOUT }, async () => {
    const { page } = overview;
    const { tasks: histories } = await service.api<HistoryJson>(ana, `jobs/${job}/history`);
    for (const { task, partition, worker, attempts, iteration, iterations } of await tasksNow()) {
        if (partition === null) {
            continue;
        }
        const measured = histories.find((one) => one.task === task)?.points.findLast((point) => point.held_out)?.held_out?.psnr;
        assert.ok(worker !== null, `${task} was trained by a worker`);
        // A part of a scene need not be measured.
        const quality = measured === undefined ? undefined : `${measured.toFixed(2)} dB`;
        const work = `${iteration} of ${iterations}`;
        const row = page.getByRole('table', { name: 'Partitions of the plan' }).locator('tbody tr').nth(partition);
        const expected = [String(partition), 'done', worker, work, String(attempts), quality ?? ''];
        const cells = async (): Promise<string[]> => (await row.locator('td, th').allTextContents()).slice(0, 6);
        // An event says that a task is done; what it reached comes with the snapshot after it.
        await until('the row of the partition', async () => JSON.stringify(await cells()) === JSON.stringify(expected), 10).catch(() => {});
        assert.deepEqual(await cells(), expected);
        await row.getByRole('button', { name: String(partition), exact: true }).click();
        const details = page.locator('.fp-plan-details');
        await details.locator('h3', { hasText: `Partition ${partition} done` }).waitFor();
        const [names, values] = [await details.locator('dt').allTextContents(), await details.locator('dd').allTextContents()];
        const facts = Object.fromEntries(names.map((name, at) => [name, values[at]]));
        assert.deepEqual([facts['Last worker'], facts['Iterations'], facts['PSNR']], [worker, `${work}, 100 %`, quality]);
    }
});

/** Where the map draws what the plan says, pixels of its canvas. */
async function mapped(page: Page): Promise<{ plan: PlanContent; cameras: readonly MapCamera[]; projection: Projection }> {
    const plan = await service.api<PlanContent>(ana, `jobs/${job}/files/plan.json`);
    const list = await service.api<ManifestContent & readonly never[]>(ana, `jobs/${job}/files/cameras.json`);
    const cameras = placeCameras(plan, list);
    const area = areaOf(plan, cameras);
    const [width, height] = await page.locator('.fp-plan-canvas').evaluate((canvas) => [canvas.clientWidth, canvas.clientHeight]);
    const view = { zoom: 1, x: (area.x0 + area.x1) / 2, z: (area.z0 + area.z1) / 2 };
    return { plan, cameras, projection: project(area, width!, height!, view) };
}

/** The share of the box around what a partition trains that is drawn in the colour of what is chosen. */
const boxDrawn = (page: Page, projection: Projection, { extended_box: { min, max } }: PlanPartition): Promise<number> =>
    page.locator('.fp-plan-canvas').evaluate(
        (element, [left, top, right, bottom]) => {
            const canvas = element as HTMLCanvasElement;
            // Of a copy, since the page does not expect that its canvas is read.
            const copy = document.createElement('canvas');
            [copy.width, copy.height] = [canvas.width, canvas.height];
            const context = copy.getContext('2d', { willReadFrequently: true })!;
            context.drawImage(canvas, 0, 0);
            const swatch = document.createElement('canvas').getContext('2d', { willReadFrequently: true })!;
            swatch.fillStyle = getComputedStyle(canvas).getPropertyValue('--accent');
            swatch.fillRect(0, 0, 1, 1);
            const accent = swatch.getImageData(0, 0, 1, 1).data;
            const isDrawn = (x: number, y: number): boolean => {
                const around = context.getImageData(Math.round(x) - 2, Math.round(y) - 2, 4, 4).data;
                return Array.from({ length: 16 }, (_, at) => at * 4).some((at) =>
                    [0, 1, 2].every((i) => Math.abs(around[at + i]! - accent[i]!) < 70),
                );
            };
            const along = Array.from({ length: 200 }, (_, at) => (at + 0.5) / 200);
            const points = along.flatMap((share) => {
                const [x, y] = [left! + share * (right! - left!), top! + share * (bottom! - top!)];
                return [[x, top!], [x, bottom!], [left!, y], [right!, y]] as const;
            });
            return points.filter(([x, y]) => isDrawn(x, y)).length / points.length;
        },
        [projection.x(min[0]), projection.y(max[2]), projection.x(max[0]), projection.y(min[2])],
    );

test('the map draws what a chosen partition trains, and shows the photograph of a camera', { skip, ...TIMEOUT }, async () => {
    const { page } = overview;
    const canvas = page.locator('.fp-plan-canvas');
    await canvas.focus();
    await page.keyboard.press('Escape');
    await canvas.scrollIntoViewIfNeeded();
    const { plan, cameras, projection } = await mapped(page);
    // With the keyboard: the first partition, then the one beside it.
    for (const [key, chosen] of [['ArrowRight', 0], ['ArrowRight', 1]] as const) {
        await page.keyboard.press(key);
        await page.locator('.fp-plan-details h3', { hasText: `Partition ${chosen}` }).waitFor();
        const drawn = (): Promise<number[]> => Promise.all(plan.partitions.map((one) => boxDrawn(page, projection, one)));
        // Dashes of 7 pixels with gaps of 5; sides that both boxes share count for both.
        await until('the box is drawn', async () => (await drawn())[chosen]! > 0.5, 5).catch(() => {});
        const shares = await drawn();
        assert.ok(shares[chosen]! > 0.5 && shares[1 - chosen]! < shares[chosen]! - 0.15, `partition ${chosen}: ${shares}`);
    }

    // The bytes behind the address of a picture; the policy lets no script read them there.
    await page.evaluate(() => {
        const made = new Map<string, Blob>();
        (window as unknown as { made: Map<string, Blob> }).made = made;
        const make = URL.createObjectURL.bind(URL);
        URL.createObjectURL = (blob: Blob) => {
            const address = make(blob);
            made.set(address, blob);
            return address;
        };
    });
    const shows = async (name: string): Promise<void> => {
        const picture = page.getByAltText(`Photograph ${name}`);
        await picture.waitFor();
        await page.locator('.fp-tip strong', { hasText: name }).waitFor();
        const bytes = await picture.evaluate(async (image) => {
            const blob = (window as unknown as { made: Map<string, Blob> }).made.get((image as HTMLImageElement).src);
            return [...new Uint8Array((await blob?.arrayBuffer()) ?? new ArrayBuffer())];
        });
        assert.ok(readFileSync(join(data, 'images', name)).equals(Buffer.from(bytes)), `${name}: ${bytes.length} bytes`);
    };
    // With the keyboard: the first camera of the partition.
    await page.keyboard.press('Tab');
    const focused = await page.evaluate(() => document.activeElement?.textContent ?? '');
    assert.match(focused, /^v\d+\.png$/);
    await shows(focused);
    // With the pointer: another one.
    const camera = cameras.find(({ name }) => name !== focused)!;
    const [x, y] = [projection.x(camera.x), projection.y(camera.z)];
    assert.equal(cameraAt(cameras, projection, x, y, 12), camera);
    await canvas.hover({ position: { x, y } });
    await shows(camera.name);
    await page.mouse.move(0, 0);
    await page.locator('.fp-tip').waitFor({ state: 'hidden' });
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

/** What the curves and their table show differently from the history. */
async function wrongCurves(page: Page, tasks: HistoryJson['tasks']): Promise<string[]> {
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
}

test('curves end with the last point of the history', { skip, ...TIMEOUT }, async () => {
    const { page, complaints } = curves;
    const { tasks } = await service.api<HistoryJson>(ana, `jobs/${job}/history`);
    assert.ok(tasks.length >= 4, 'every task that trains or evaluates has a history');
    await page.getByText('The latest values as a table').click();
    await until('the last points are shown', async () => (await wrongCurves(page, tasks)).length === 0, 20).catch(() => {});
    assert.deepEqual(await wrongCurves(page, tasks), []);
    assert.ok(tasks.some(({ points }) => points.at(-1)?.held_out), 'a PSNR is among them');
    assert.equal(await page.evaluate(() => (window as unknown as { isSamePage?: boolean }).isSamePage), true, 'no reload');
    assert.deepEqual(complaints, []);
});

test('curves are the same after the coordinator was killed and started again', { skip, ...TIMEOUT }, async () => {
    const { page } = curves;
    const history = (): Promise<HistoryJson> => service.api<HistoryJson>(ana, `jobs/${job}/history`);
    // News of the last seconds are lost in a crash.
    const { ended_unix_seconds: ended } = await service.api<{ ended_unix_seconds: number }>(ana, `jobs/${job}`);
    await sleep(Math.max(0, ended * 1000 + KEPT_AFTER_MS - Date.now()));
    const kept = await history();
    await service.kill();
    // Of a job that has ended a page asks seldom.
    await askAgain(page);
    await page.getByText('Connection lost; trying again').waitFor();
    assert.deepEqual(await wrongCurves(page, kept.tasks), [], 'what was shown stays');
    await service.startCoordinator();
    await askAgain(page);
    await page.getByText('Connection lost; trying again').waitFor({ state: 'detached' });
    await page.reload();
    const { tasks } = await history();
    assert.deepEqual(tasks, kept.tasks);
    await page.getByText('The latest values as a table').click();
    await until('the curves are shown again', async () => (await wrongCurves(page, tasks)).length === 0, 20).catch(() => {});
    assert.deepEqual(await wrongCurves(page, tasks), []);
    // What Chromium itself writes when a server is away.
    await finish(curves, /net::ERR_|Failed to load resource/);
});
