// What the pages and previews cost a job: pairs of the same job, once without previews and with no page open,
// once with previews at their usual cadence and the page of the job open.
//
//     FATHOM=PROGRAM node test/headless/cost.ts [PAIRS]
//
// Counts the CPU time of the coordinator and the worker, not that of the browser. A pair takes 3 minutes on
// 2 cores. Other work on the machine changes the result: leave it idle.

import { execFileSync } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';

import { launch } from './browser.ts';
import { type JobJson, Service, serveWith } from './service.ts';
import { openAs, sleep } from './steps.ts';

const FATHOM = process.env['FATHOM'] ?? '';
const PAGES = process.env['PAGES'] ?? join(import.meta.dirname, '../../dist');
const pairs = Number(process.argv[2] ?? 4);
if (FATHOM === '' || !Number.isInteger(pairs) || pairs < 2 || pairs % 2 !== 0) {
    throw new Error('FATHOM names the program, and the argument an even number of pairs');
}
/** A tick of /proc/PID/stat on Linux, seconds. */
const TICK_S = 0.01;
const WORKER = 'worker-1';
const JOB = ['--partitions', '2x1', '--iterations', '800', '--max-gaussians', '8000'];

const work = mkdtempSync(join(tmpdir(), 'fathom-cost-'));
const service = await Service.start(FATHOM, work);
const serving = await serveWith(PAGES, service.webPort);
const browser = await launch();

/** CPU time that a process and its ended children have taken, seconds. */
function cpuSeconds(pid: number): number {
    // The name of the program is in brackets and may contain spaces.
    const fields = readFileSync(`/proc/${pid}/stat`, 'utf8').split(') ').at(-1)!.split(' ');
    return fields.slice(11, 15).reduce((sum, ticks) => sum + Number(ticks), 0) * TICK_S;
}

try {
    const scene = join(work, 'scene');
    execFileSync(FATHOM, ['synth', scene, '--views', '40', '--size', '320x240'], { stdio: 'ignore' });
    const ana = service.token('ana', '--role', 'submitter', '--tenant', 'survey');
    service.run(ana, 'dataset', 'upload', scene, '--id', 'scene', '--coordinator', service.url);
    const worker = service.startWorker(service.token('workers', '--role', 'worker'), WORKER);
    const pids = [service.coordinatorPid, worker.pid!];

    /** Runs the job; returns its CPU time and how long it took, seconds. */
    const run = async (shown: boolean): Promise<{ cpu: number; wall: number }> => {
        const before = pids.map(cpuSeconds);
        const began = Date.now();
        const flags = ['--dataset', 'scene', '--coordinator', service.url, ...JOB];
        const previews = shown ? [] : ['--set', 'train.preview_seconds=0'];
        const id = service.run(ana, 'submit', ...flags, ...previews).split('\n').at(-1)!;
        const opened = shown ? await openAs(browser, `${serving.address}/#/jobs/${id}`, ana) : null;
        for (;;) {
            const { state } = await service.api<JobJson>(ana, `jobs/${id}`);
            if (state === 'succeeded') {
                break;
            }
            if (state === 'failed' || state === 'cancelled') {
                throw new Error(`the job has ${state}`);
            }
            await sleep(2000);
        }
        const cpu = pids.reduce((sum, pid, index) => sum + cpuSeconds(pid) - before[index]!, 0);
        await opened?.page.context().close();
        return { cpu, wall: (Date.now() - began) / 1000 };
    };

    // The first run fills the cache of the worker.
    await run(false);
    const all = new Map<boolean, number[]>([[false, []], [true, []]]);
    for (let pair = 0; pair < pairs; pair++) {
        // Each comes first every other time: the second run of a pair takes about a tenth more, whichever it is.
        const order = pair % 2 === 0 ? [false, true] : [true, false];
        const of = new Map<boolean, { cpu: number; wall: number }>();
        for (const shown of order) {
            of.set(shown, await run(shown));
            all.get(shown)!.push(of.get(shown)!.cpu);
        }
        const [without, shown] = [of.get(false)!, of.get(true)!];
        const said = [without, shown].map(({ cpu, wall }) => `${cpu.toFixed(1)} s in ${wall.toFixed(0)} s`);
        console.log(`pair ${pair + 1}: CPU time without ${said[0]}, with ${said[1]}: ${(shown.cpu / without.cpu).toFixed(3)}`);
    }
    const [without, shown] = [false, true].map((kind) => all.get(kind)!.reduce((sum, cpu) => sum + cpu, 0));
    console.log(`all: ${without!.toFixed(1)} s without, ${shown!.toFixed(1)} s with: ${(shown! / without!).toFixed(3)}`);
} finally {
    await browser.close();
    serving.close();
    await service.stop();
    rmSync(work, { recursive: true, force: true });
}
