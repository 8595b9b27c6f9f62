// The workers of a service.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import { type Worker, WorkerState } from '../../rpc/fathom/admin/v1/admin_pb.ts';
import { type Context, problemOf } from '../context.ts';
import { ask } from '../dialog.ts';
import { Table, chip, h, only, setAttribute, setText } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { agoText, bytesText, timeText } from '../format.ts';
import { brief } from '../parts/format.ts';
import { poll } from '../poll.ts';
import { jobLink } from '../route.ts';
import { capital, taskLabel, workerStateWord } from '../words.ts';

const EVERY_MS = 3000;
const REASON = { kind: 'text', label: 'Reason (optional)', maximum: 300 } as const;

function showHeld(cell: HTMLElement, worker: Worker): void {
    const key = worker.held.map(({ jobId, taskId, attempt }) => `${jobId} ${taskId} ${attempt}`).join('\n');
    if (cell.dataset['shown'] === key) {
        return;
    }
    cell.dataset['shown'] = key;
    const lines = worker.held.map(({ jobId, taskId }) => h('div', {}, h('a', { href: jobLink(jobId) }, taskLabel(taskId))));
    cell.replaceChildren(...lines);
}

function showState(cell: HTMLElement, worker: Worker): void {
    const word = workerStateWord(worker);
    const box = only(cell, () => h('div', {}, h('span'), h('div', { class: 'soft' })));
    chip(box.children[0] as HTMLElement, word, capital(word));
    setText(box.children[1] as HTMLElement, worker.reason);
}

/** Iterations per second in three digits; nothing where nothing is trained. */
export const rateText = (perSecond: number): string =>
    Number.isFinite(perSecond) && perSecond > 0 ? `${brief(perSecond)} /s` : '';

/** The latest line of a worker, and when it logged it: as text, since a title is for the mouse only. */
function showLastWords(cell: HTMLElement, { lastWords, lastWordsTime }: Worker, now: number): void {
    if (lastWords === '') {
        cell.replaceChildren();
        return;
    }
    const box = only(cell, () => h('div', {}, h('span'), ' ', h('time', { class: 'soft' })));
    const [words, time] = [box.children[0] as HTMLElement, box.children[1] as HTMLElement];
    setText(words, lastWords);
    const at = lastWordsTime === undefined ? null : timestampMs(lastWordsTime);
    setText(time, at === null ? '' : agoText(at, now));
    setAttribute(time, 'datetime', at === null ? null : new Date(at).toISOString());
    setAttribute(time, 'title', at === null ? null : timeText(at));
}

function makeButtons(context: Context, worker: () => Worker, changed: () => void): HTMLElement {
    const { admin } = context.session.api;
    const cordon = (): Promise<boolean> =>
        ask({
            title: `Cordon ${worker().name}?`,
            text: 'It is assigned no further task, and finishes those that it has.',
            fields: { reason: REASON },
            action: 'Cordon',
            act: async ({ reason }) => {
                await admin.cordonWorker({ workerId: worker().workerId, reason });
                changed();
                return null;
            },
        });
    const drain = (): Promise<boolean> =>
        ask({
            title: `Drain ${worker().name}?`,
            text: 'It saves what it has trained, gives its tasks back, and is assigned no further one. Other workers continue.',
            fields: { reason: REASON },
            action: 'Drain',
            act: async ({ reason }) => {
                await admin.drainWorker({ workerId: worker().workerId, reason });
                changed();
                return null;
            },
        });
    const uncordon = async (): Promise<void> => {
        try {
            await admin.uncordonWorker({ workerId: worker().workerId });
            changed();
        } catch (error) {
            context.say(faultOf(error).message);
        }
    };
    return h(
        'div',
        { class: 'row' },
        h('button', { type: 'button', onclick: () => void cordon() }, 'Cordon'),
        h('button', { type: 'button', onclick: () => void drain() }, 'Drain'),
        h('button', { type: 'button', onclick: () => void uncordon() }, 'Uncordon'),
    );
}

export function showWorkers(container: HTMLElement, context: Context): void {
    const { session, signal } = context;
    let now = Date.now();
    const current = new Map<string, Worker>();
    const showButtons = (cell: HTMLElement, worker: Worker): void => {
        const { workerId, state, name } = worker;
        const buttons = only(cell, () => makeButtons(context, () => current.get(workerId) ?? worker, () => polling.now()));
        const isShown = [state === WorkerState.ACTIVE, state !== WorkerState.DRAINING, state !== WorkerState.ACTIVE];
        [...buttons.children].forEach((button, index) => {
            (button as HTMLElement).hidden = !isShown[index];
            setAttribute(button, 'aria-label', `${button.textContent} ${name}`);
        });
    };
    const table = new Table<Worker>(
        'Workers',
        'workers',
        [
            {
                title: 'Name',
                kind: 'name',
                isHeader: true,
                show: (cell, { name, workerId, buildVersion }) =>
                    void only(cell, () => h('div', {}, name === '' ? workerId : name, h('div', { class: 'soft' }, `version ${buildVersion}`))),
            },
            { title: 'State', kind: 'state', show: showState },
            { title: 'Adapter', show: (cell, worker) => setText(cell, worker.adapter) },
            {
                title: 'Memory',
                kind: 'number',
                show: (cell, { memoryBytes }) => setText(cell, memoryBytes === 0n ? 'not reported' : bytesText(memoryBytes)),
            },
            { title: 'Works on', show: showHeld },
            { title: 'Rate', kind: 'number', show: (cell, worker) => setText(cell, rateText(worker.iterationsPerSecond)) },
            { title: 'Last words', kind: 'words', show: (cell, worker) => showLastWords(cell, worker, now) },
            {
                title: 'Last seen',
                kind: 'number',
                show: (cell, { lastSeen }) => setText(cell, lastSeen === undefined ? 'never' : agoText(timestampMs(lastSeen), now)),
            },
            { title: 'Actions', kind: 'act', show: showButtons },
        ],
        ({ workerId }) => workerId,
    );
    const summary = h('p', { class: 'soft', role: 'status' }, 'Loading the workers …');
    const content = h('div', { class: 'card flush', hidden: true });
    container.append(summary, content);
    const polling = poll(() => EVERY_MS, signal, async () => {
        try {
            const { workers } = await session.api.admin.listWorkers({}, { signal });
            now = Date.now();
            current.clear();
            workers.forEach((worker) => current.set(worker.workerId, worker));
            content.hidden = false;
            if (workers.length === 0) {
                setText(summary, '');
                content.replaceChildren(
                    h('div', { class: 'empty' }, h('h2', {}, 'No workers'), h('p', {}, 'Start one on each machine with a GPU: ', h('code', {}, 'fathom worker --coordinator URL'))),
                );
                return;
            }
            table.show(workers);
            if (table.element.parentElement !== content) {
                content.replaceChildren(table.element);
            }
            const busy = workers.filter(({ held }) => held.length > 0).length;
            const silent = workers.filter(({ connected }) => !connected).length;
            const one = workers.length === 1 ? '1 worker' : `${workers.length} workers`;
            setText(summary, `${one}, ${busy} at work${silent === 0 ? '' : `, ${silent} silent`}`);
        } catch (error) {
            const shown = problemOf('The workers cannot be listed', faultOf(error));
            if (shown !== null) {
                setText(summary, '');
                content.hidden = false;
                content.replaceChildren(shown);
            }
        }
    });
}
