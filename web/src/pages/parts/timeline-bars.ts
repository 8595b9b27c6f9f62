// From the events of a job to what the timeline draws: rows of tasks, bars of attempts, and what went wrong.

import { duration } from './format.ts';
import { type TaskInfo, shownState } from './part.ts';

/** An event of a job, in the words of `fathom watch --json`. */
export interface TimelineEvent {
    /** "task", "job_state", "job_stage", "checkpoint", "warning", ... */
    readonly kind: string;
    /** The task concerned; null for events of the whole job. */
    readonly task: string | null;
    /** New state of the task or the job; null for other kinds. */
    readonly state: string | null;
    /** 0 where there is none. */
    readonly attempt: number;
    readonly worker: string | null;
    /** Why: an error, "lease expired: ...", "released: ..."; may be empty. */
    readonly message: string;
    /** Iteration at which an attempt began: above 0 where it resumed from a checkpoint. */
    readonly resumedFrom: number;
    readonly timeMs: number;
}

export interface TimelineData {
    readonly tasks: readonly TaskInfo[];
    /** In the order in which they happened. */
    readonly events: readonly TimelineEvent[];
    /** The present, by the clock of the events. */
    readonly nowMs: number;
}

/** How an attempt ended. */
export type Outcome = 'running' | 'done' | 'error' | 'lost' | 'released' | 'superseded' | 'cancelled' | 'failed';

/** One attempt at a task. */
export interface Bar {
    readonly task: string;
    readonly attempt: number;
    readonly worker: string;
    readonly startMs: number;
    /** `nowMs` while it runs. */
    readonly endMs: number;
    readonly outcome: Outcome;
    readonly message: string;
    readonly resumedFrom: number;
}

/** A row of the timeline: one task, or many tasks folded into one. */
export interface Row {
    readonly key: string;
    readonly label: string;
    readonly stage: string;
    readonly state: string;
    readonly bars: readonly Bar[];
    /** How many tasks the row stands for, with their states in words; null for one task. */
    readonly folded: { readonly count: number; readonly words: string; readonly load: readonly LoadStep[] } | null;
}

/** How many attempts of the folded tasks run from a time on. */
export interface LoadStep {
    readonly timeMs: number;
    readonly count: number;
}

/** Something that did not go as planned, for the list. */
export interface Note {
    readonly timeMs: number;
    readonly task: string | null;
    readonly text: string;
}

export interface Timeline {
    readonly startMs: number;
    readonly endMs: number;
    readonly rows: readonly Row[];
    readonly notes: readonly Note[];
    readonly pauses: readonly { readonly startMs: number; readonly endMs: number }[];
    /** How many rows are left out, beyond `mostRows`. */
    readonly hidden: number;
}

const STAGES: readonly (readonly [string, string])[] = [
    ['plan', 'Plan'],
    ['global', 'Coarse model'],
    ['first_part', 'First part'],
    ['exchange', 'Exchange'],
    ['partition', 'Partition'],
    ['merge', 'Merge'],
    ['borders', 'Borders'],
    ['evaluate', 'Evaluate'],
    ['artifacts', 'Artifacts'],
];
/** A stage with at most as many tasks is shown in full. */
const SHOWN_IN_FULL = 12;
const FINAL = new Set(['succeeded', 'failed', 'cancelled']);

/** The words for an outcome. */
export const OUTCOMES: Readonly<Record<Outcome, string>> = {
    running: 'running',
    done: 'done',
    error: 'ended with an error',
    lost: 'worker lost',
    released: 'released',
    superseded: 'another attempt was faster',
    cancelled: 'stopped with the job',
    failed: 'failed for good',
};

/** The stage of a task, by its id. */
const stageOf = (task: string): string => task.replace(/-\d+$/, '');

/** How an attempt ended that gave its task back. The coordinator begins the message with what happened. */
function outcomeOf(message: string): Outcome {
    if (message.startsWith('lease expired')) {
        return 'lost';
    }
    return message.startsWith('released') || message === 'its coordinator is gone' ? 'released' : 'error';
}

/** The message without the word for what happened, where the outcome says it. */
const reasonOf = (message: string): string => message.replace(/^(released|lease expired): /, '');

/** The bars of each task, in the order of their beginning. */
export function attemptsOf(data: TimelineData): Map<string, Bar[]> {
    const bars = new Map<string, Bar[]>();
    const states = new Map(data.tasks.map(({ task, state }) => [task, state]));
    const end = (
        task: string,
        isIt: (bar: Bar) => boolean,
        timeMs: number,
        outcome: Outcome,
        message: string,
    ): void => {
        const list = bars.get(task) ?? [];
        list.forEach((bar, i) => {
            if (bar.outcome === 'running' && isIt(bar)) {
                list[i] = { ...bar, endMs: timeMs, outcome, message: message || bar.message };
            }
        });
    };
    for (const event of data.events) {
        if (event.kind === 'job_state' && FINAL.has(event.state ?? '')) {
            for (const task of bars.keys()) {
                end(task, () => true, event.timeMs, 'cancelled', event.message);
            }
        }
        const { task } = event;
        if (event.kind !== 'task' || task === null) {
            continue;
        }
        const isIt = ({ attempt }: Bar): boolean => attempt === event.attempt;
        if (event.state === 'running') {
            const bar: Bar = {
                task,
                attempt: event.attempt,
                worker: event.worker ?? '',
                startMs: event.timeMs,
                endMs: data.nowMs,
                outcome: 'running',
                message: event.message,
                resumedFrom: event.resumedFrom,
            };
            bars.set(task, [...(bars.get(task) ?? []), bar]);
        } else if (event.state === 'done') {
            end(task, isIt, event.timeMs, 'done', event.message);
            // Of two attempts at a task the first result counts.
            end(task, () => true, event.timeMs, 'superseded', '');
        } else if (event.state === 'ready') {
            end(task, isIt, event.timeMs, outcomeOf(event.message), event.message);
        } else if (event.state === 'failed') {
            end(task, isIt, event.timeMs, 'failed', event.message);
        } else if (event.state === 'cancelled') {
            end(task, () => true, event.timeMs, 'cancelled', event.message);
        }
    }
    // An attempt whose end is not among the events must not grow for ever.
    for (const [task, list] of bars) {
        const state = states.get(task);
        if (state !== undefined && state !== 'running') {
            const last = data.events.at(-1)?.timeMs ?? data.nowMs;
            end(task, () => true, last, state === 'done' ? 'done' : 'cancelled', '');
        }
        list.sort((a, b) => a.startMs - b.startMs || a.attempt - b.attempt);
    }
    return bars;
}

/** Whether a task is worth a row of its own among many. */
function standsOut({ state, attempts }: TaskInfo, bars: readonly Bar[]): boolean {
    const troubled = bars.some(({ outcome }) => outcome === 'error' || outcome === 'lost' || outcome === 'failed');
    return state === 'running' || state === 'failed' || troubled || attempts > 1 || bars.length > 1;
}

/** How many attempts run at each time, as steps. */
export function loadOf(bars: readonly Bar[]): LoadStep[] {
    const changes = bars.flatMap(({ startMs, endMs }) => [
        { timeMs: startMs, by: 1 },
        { timeMs: endMs, by: -1 },
    ]);
    changes.sort((a, b) => a.timeMs - b.timeMs);
    const steps: { timeMs: number; count: number }[] = [];
    let count = 0;
    for (const { timeMs, by } of changes) {
        count += by;
        const last = steps.at(-1);
        if (last?.timeMs === timeMs) {
            last.count = count;
        } else {
            steps.push({ timeMs, count });
        }
    }
    return steps;
}

/** "600 done, 350 waiting". */
function stateWords(tasks: readonly TaskInfo[]): string {
    const counts = new Map<string, number>();
    tasks.forEach(({ state }) => counts.set(shownState(state), (counts.get(shownState(state)) ?? 0) + 1));
    return [...counts].map(([state, count]) => `${count} ${state}`).join(', ');
}

/** What the row of a task is called. */
export function taskLabel({ stage, partition, task }: Pick<TaskInfo, 'stage' | 'partition' | 'task'>): string {
    const name = STAGES.find(([key]) => key === stage)?.[1] ?? stage;
    const part = /-(\d+)$/.exec(task)?.[1];
    const number = partition ?? (part === undefined ? null : Number(part));
    return number === null ? name : `${name} ${number}`;
}

const rank = ({ state, attempts }: TaskInfo): number => (state === 'failed' ? 0 : attempts > 1 ? 1 : 2);

function rowsOf(
    tasks: readonly TaskInfo[],
    bars: ReadonlyMap<string, Bar[]>,
    mostRows: number,
): { rows: Row[]; hidden: number } {
    const rows: Row[] = [];
    let hidden = 0;
    const one = (task: TaskInfo): Row => ({
        key: task.task,
        label: taskLabel(task),
        stage: task.stage,
        state: task.state,
        bars: bars.get(task.task) ?? [],
        folded: null,
    });
    const known = STAGES.map(([stage]) => stage);
    const others = [...new Set(tasks.map(({ stage }) => stage))].filter((stage) => !known.includes(stage));
    for (const stage of [...known, ...others]) {
        const all = tasks.filter((task) => task.stage === stage);
        if (all.length <= SHOWN_IN_FULL) {
            rows.push(...all.map(one));
            continue;
        }
        const own = all.filter((task) => standsOut(task, bars.get(task.task) ?? []));
        // Failures first where there is no room for all.
        const shown = new Set(own.toSorted((a, b) => rank(a) - rank(b)).slice(0, mostRows));
        hidden += own.length - shown.size;
        const rest = all.filter((task) => !shown.has(task));
        rows.push(...own.filter((task) => shown.has(task)).map(one));
        if (rest.length > 0) {
            const name = STAGES.find(([key]) => key === stage)?.[1] ?? stage;
            const words = stateWords(rest);
            const ofRest = rest.flatMap(({ task }) => bars.get(task) ?? []);
            rows.push({
                key: `${stage} others`,
                label: shown.size === 0 ? `${name}: all ${rest.length}` : `${name}: ${rest.length} others`,
                stage,
                state: rest.some(({ state }) => state === 'running') ? 'running' : '',
                bars: [],
                folded: { count: rest.length, words, load: loadOf(ofRest) },
            });
        }
    }
    return { rows, hidden };
}

/** A bar in a sentence. */
export function barText(bar: Bar): string {
    const on = bar.worker === '' ? '' : ` on ${bar.worker}`;
    const from = bar.resumedFrom > 0 ? `, resumed from iteration ${bar.resumedFrom}` : '';
    const why = bar.message === '' ? '' : `: ${reasonOf(bar.message)}`;
    return `${bar.task}, attempt ${bar.attempt}${on}${from}, ${duration(bar.endMs - bar.startMs)}, ${OUTCOMES[bar.outcome]}${why}`;
}

const where = ({ attempt, worker }: TimelineEvent): string => `Attempt ${attempt}${worker ? ` on ${worker}` : ''}`;

/** What went wrong, the latest first. */
function notesOf(data: TimelineData, bars: ReadonlyMap<string, Bar[]>): Note[] {
    const notes: Note[] = [];
    const hasEnded = (event: TimelineEvent): boolean =>
        (bars.get(event.task ?? '') ?? []).some(
            ({ attempt, endMs, outcome }) =>
                attempt === event.attempt && endMs === event.timeMs && outcome !== 'done',
        );
    for (const event of data.events) {
        const { kind, state, message, timeMs, task } = event;
        const add = (text: string): number => notes.push({ timeMs, task, text });
        if (kind === 'warning') {
            add(`Warning: ${message}`);
        } else if (kind === 'job_state' && (state === 'failed' || state === 'cancelled' || state === 'paused')) {
            add(
                `The job was ${state === 'failed' ? 'ended as failed' : state}${message === '' ? '' : `: ${message}`}`,
            );
        } else if (kind === 'job_state' && message === 'resumed') {
            add('The job was resumed');
        } else if (kind === 'task' && state === 'ready' && event.attempt > 0) {
            const outcome = outcomeOf(message);
            const verb =
                outcome === 'lost' ? 'lost its worker' : outcome === 'released' ? 'was released' : OUTCOMES.error;
            const what = hasEnded(event) ? `${where(event)} ${verb}` : 'It has to run again';
            add(`${what}${message === '' ? '' : `: ${reasonOf(message)}`}`);
        } else if (kind === 'task' && state === 'failed') {
            add(`${where(event)} failed, and no other will follow${message === '' ? '' : `: ${message}`}`);
        } else if (kind === 'task' && state === 'running' && message !== '') {
            add(`${where(event)} began ${message}`);
        } else if (kind === 'task' && state === 'running' && event.resumedFrom > 0) {
            add(`${where(event)} resumed from iteration ${event.resumedFrom}`);
        } else if (kind === 'task' && state === 'running' && event.attempt > 1) {
            add(`${where(event)} began from the start`);
        }
    }
    return notes.toReversed();
}

function pausesOf(data: TimelineData): { startMs: number; endMs: number }[] {
    const pauses: { startMs: number; endMs: number }[] = [];
    let since: number | null = null;
    for (const { kind, state, timeMs } of data.events) {
        if (kind === 'job_state') {
            if (state === 'paused') {
                since ??= timeMs;
            } else if (since !== null) {
                pauses.push({ startMs: since, endMs: timeMs });
                since = null;
            }
        }
    }
    return since === null ? pauses : [...pauses, { startMs: since, endMs: data.nowMs }];
}

/** Everything that the timeline draws. At most `mostRows` tasks of a stage with many have rows of their own. */
export function timelineOf(data: TimelineData, mostRows = 40): Timeline {
    const bars = attemptsOf(data);
    const known = new Set(data.tasks.map(({ task }) => task));
    // Events may be newer than the list of tasks.
    const unlisted = [...bars.keys()]
        .filter((task) => !known.has(task))
        .map((task): TaskInfo => ({
            task,
            stage: stageOf(task),
            partition: null,
            state: bars.get(task)!.at(-1)!.outcome === 'running' ? 'running' : 'done',
            worker: null,
            iteration: 0,
            iterations: 0,
            attempts: bars.get(task)!.length,
            psnr: null,
        }));
    const { rows, hidden } = rowsOf([...data.tasks, ...unlisted], bars, mostRows);
    const startMs = data.events[0]?.timeMs ?? data.nowMs;
    const lastState = data.events.findLast(({ kind }) => kind === 'job_state');
    const isOver = lastState !== undefined && FINAL.has(lastState.state ?? '');
    const endMs = Math.max(startMs + 1000, isOver ? lastState.timeMs : data.nowMs);
    return { startMs, endMs, rows, hidden, notes: notesOf(data, bars), pauses: pausesOf(data) };
}
