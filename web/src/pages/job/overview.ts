// What a job does now: its plan from above, its stages in time, and its tasks.

import { type Task, type TaskHistory, TaskState } from '../../rpc/fathom/v1/job_pb.ts';
import { Table, chip, h, only, setText } from '../dom.ts';
import { countText, durationText } from '../format.ts';
import type { ManifestContent, PlanContent } from '../parts/plan-layout.ts';
import { planMap } from '../parts/plan-map.ts';
import { timeline } from '../parts/timeline.ts';
import { capital, hasEnded, taskLabel, taskStateWord } from '../words.ts';
import { Addresses } from './addresses.ts';
import { boundsBar } from './bounds-bar.ts';
import { verdictOfJob } from './bounds.ts';
import { followHistory } from './history.ts';
import { Photographs } from './photographs.ts';
import { withPreviews } from './preview-series.ts';
import type { JobContext, Section } from './section.ts';

/**
 * The map and the timeline are drawn this often at most, and this often while nothing happens, milliseconds.
 */
const DRAW_EVERY_MS = 250;
const TICK_MS = 1000;
/** What bounds the job is counted anew this often, and the history that it needs is asked for, milliseconds. */
const COUNT_EVERY_MS = 3000;
const HISTORY_EVERY_MS = 15_000;
/** After a failure the plan is asked for again, but not at once. */
const ASK_AGAIN_MS = 3000;
const STATE_LABELS: Readonly<Record<string, string>> = { blocked: 'Waits for others', ready: 'Waits for a worker' };

function workText(task: Task): string {
    if (task.state === TaskState.DONE) {
        return task.seconds > 0 ? `took ${durationText(task.seconds)}` : '';
    }
    const { progress } = task;
    return progress === undefined || progress.iterations === 0 ? '' : `${countText(progress.iteration)} of ${countText(progress.iterations)}`;
}

function attemptsText(task: Task): string {
    const parts = [
        task.attempts === 0 ? '' : String(task.attempts),
        task.errors === 0 ? '' : `${task.errors} with errors`,
        task.losses === 0 ? '' : `${task.losses} lost`,
    ];
    return parts.filter((part) => part !== '').join(', ');
}

/** The name of a task, and its latest error below it. */
function showName(cell: HTMLElement, task: Task): void {
    const box = only(cell, () => h('div', {}, taskLabel(task.taskId), h('div', { class: 'bad-text' })));
    setText(box.lastElementChild as HTMLElement, task.state === TaskState.DONE ? '' : (task.lastErrors.at(-1) ?? ''));
}

function showState(cell: HTMLElement, task: Task): void {
    const word = taskStateWord(task.state);
    chip(cell, word, STATE_LABELS[word] ?? capital(word));
}

const makeTable = (): Table<Task> =>
    new Table<Task>(
        'Tasks',
        'tasks',
        [
            { title: 'Task', kind: 'name', isHeader: true, show: showName },
            { title: 'State', kind: 'state', show: showState },
            { title: 'Work', kind: 'number', show: (cell, task) => setText(cell, workText(task)) },
            { title: 'Worker', show: (cell, task) => setText(cell, [task.worker, task.secondWorker].filter((name) => name !== '').join(', ')) },
            { title: 'Attempts', show: (cell, task) => setText(cell, attemptsText(task)) },
        ],
        ({ taskId }) => taskId,
    );

export function open(container: HTMLElement, context: JobContext): Section {
    const { id, record, session, signal } = context;
    const mapHost = h('div', { class: 'card' });
    const timelineHost = h('div', { class: 'card' });
    const table = makeTable();
    const details = h('details', { class: 'more', ontoggle: () => draw() }, h('summary', {}, 'Tasks as a list'), h('div', { class: 'card flush' }, table.element));
    const bounds = boundsBar();
    container.append(bounds.element, h('h2', {}, 'Plan'), mapHost, h('h2', {}, 'Stages'), timelineHost, details);

    const addresses = new Addresses();
    const photographs = new Photographs(context);
    const map = planMap(mapHost, {
        onPhotograph: async (name) => {
            const content = await photographs.fetch(name);
            if (content === null) {
                throw new Error(`${name} is not among the photographs of the job.`);
            }
            return addresses.of(content);
        },
    });
    const line = timeline(timelineHost);
    let plan: PlanContent | null = null;
    let manifest: ManifestContent | null = null;
    let isAsked = false;
    let histories: readonly TaskHistory[] | null = null;

    const ask = async (digest: string): Promise<void> => {
        isAsked = true;
        try {
            const manifestDigest = context.job.manifest?.digest ?? '';
            const [planned, described] = await Promise.all([
                session.api.json(digest, id, signal),
                // Without the cameras the map shows the partitions.
                manifestDigest === '' ? null : session.api.json(manifestDigest, id, signal).catch(() => null),
            ]);
            plan = planned as PlanContent;
            manifest = described as ManifestContent | null;
            draw();
        } catch {
            setTimeout(() => (isAsked = false), ASK_AGAIN_MS);
        }
    };

    function draw(): void {
        timer = 0;
        if (signal.aborted) {
            return;
        }
        const { job } = context;
        if (!isAsked && job.plan !== undefined) {
            void ask(job.plan.digest);
        }
        const { tasks } = record;
        map.update({ plan, cameras: manifest, tasks: withPreviews(tasks, histories ?? []) });
        line.update({ tasks, events: record.events, nowMs: record.nowMs });
        if (details.open) {
            table.show(job.tasks);
        }
    }
    let countTimer = 0;
    function count(): void {
        countTimer = 0;
        // Without the history nobody can tell training from waiting for photographs.
        if (!signal.aborted && histories !== null) {
            bounds.show(verdictOfJob(record, histories));
        }
    }
    followHistory(
        context,
        (history) => {
            histories = history.tasks;
            count();
            update();
        },
        // What was shown stays.
        () => {},
        HISTORY_EVERY_MS,
    );
    let timer = 0;
    const update = (): void => {
        timer ||= window.setTimeout(draw, DRAW_EVERY_MS);
        countTimer ||= window.setTimeout(count, COUNT_EVERY_MS);
    };
    // Bars of running tasks grow.
    const tick = setInterval(() => {
        if (!document.hidden && !hasEnded(context.job.state)) {
            update();
        }
    }, TICK_MS);
    draw();
    return {
        update,
        destroy: () => {
            clearInterval(tick);
            clearTimeout(timer);
            clearTimeout(countTimer);
            map.destroy();
            line.destroy();
            addresses.revoke();
        },
    };
}
