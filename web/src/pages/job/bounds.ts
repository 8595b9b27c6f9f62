// What bounds a job: where its time went, from the beginning to now, and what takes most of it.
//
// At each moment either workers hold tasks, or the coordinator works alone, or tasks wait for a worker. While
// workers hold tasks, the time is divided evenly among these tasks, and that of each task by what its
// attempts reported. Pauses do not count.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import type { HistoryPoint, TaskHistory, TimeSpent } from '../../rpc/fathom/v1/job_pb.ts';
import { durationText } from '../format.ts';
import type { TaskInfo } from '../parts/part.ts';
import { type TimelineEvent, attemptsOf } from '../parts/timeline-bars.ts';
import type { JobRecord } from './record.ts';

/** Where time goes. */
export type Part =
    'training' | 'disk' | 'photographs' | 'network' | 'watching' | 'coordinator' | 'waiting' | 'unknown';
/** What is named: a part, or nothing where no part is large enough. */
export type Bound = Exclude<Part, 'unknown'> | 'nothing';

export const PART_WORDS: Readonly<Record<Part, string>> = {
    training: 'Training',
    disk: 'Reading photographs from disk',
    photographs: 'Decoding photographs',
    network: 'Fetching input, sending results',
    watching: 'Measuring, previews, checkpoints',
    coordinator: 'Work of the coordinator',
    waiting: 'Waiting for workers',
    unknown: 'Other',
};
const PARTS = Object.keys(PART_WORDS) as Part[];

/** What bounds a job, in as few words as a table takes. */
export const BOUND_WORDS: Readonly<Record<Bound, string>> = {
    training: 'GPU',
    disk: 'Reading from disk',
    photographs: 'Decoding photographs',
    network: 'Network',
    watching: 'Measuring and saving',
    coordinator: 'Coordinator',
    waiting: 'Lack of workers',
    nothing: 'Nothing alone',
};

export interface BoundsData {
    readonly tasks: readonly TaskInfo[];
    readonly histories: readonly TaskHistory[];
    readonly events: readonly TimelineEvent[];
    readonly startMs: number;
    /** The present, or the end of the job. */
    readonly nowMs: number;
    /** Maximum number of its tasks that run at a time; 0 for no limit. */
    readonly maxParallel: number;
}

export interface Verdict {
    readonly bound: Bound;
    /** One sentence. */
    readonly text: string;
    /** What would help; empty where nothing is known. */
    readonly advice: string;
    /** What has a share, in a fixed order. */
    readonly parts: readonly { readonly part: Part; readonly seconds: number; readonly share: number }[];
}

/** In less time than this nothing is said. */
const LEAST_SECONDS = 20;
/** The share from which on something bounds a job. */
const BOUND_FROM = 0.4;
/** The share from which on a part is named beside the one that bounds a job. */
const WORTH_NAMING = 0.05;
/** Where more is not known, nothing is said. */
const MOST_UNKNOWN = 0.5;
/** Tasks that wait for a worker, on average, from which on more workers would help. */
const QUEUE_FROM = 0.5;

const OWN_STAGES: ReadonlySet<string> = new Set(['plan', 'exchange', 'merge', 'artifacts']);
const OWN_WORK: Readonly<Record<string, string>> = {
    plan: 'planning',
    exchange: 'the exchange between partitions',
    merge: 'merging',
    artifacts: 'writing files',
};
const FINAL: ReadonlySet<string> = new Set(['succeeded', 'failed', 'cancelled']);

/** Seconds of workers. */
interface Spent {
    all: number;
    training: number;
    /** Training waited for photographs: for the disk, and for the rest of the work on them. */
    disk: number;
    photographs: number;
    fetching: number;
    sending: number;
    watching: number;
}

function spentOf(time: TimeSpent): Spent {
    // The disk is a part of what photographs took. Workers before this split report none.
    const disk = Math.min(Math.max(0, time.diskSeconds ?? 0), time.photographsSeconds);
    return {
        all: time.seconds,
        training: time.trainingSeconds,
        disk,
        photographs: time.photographsSeconds - disk,
        fetching: time.fetchingSeconds,
        sending: time.sendingSeconds,
        watching: time.watchingSeconds,
    };
}
const NOTHING: Spent = {
    all: 0,
    training: 0,
    disk: 0,
    photographs: 0,
    fetching: 0,
    sending: 0,
    watching: 0,
};

function sum(all: readonly Spent[]): Spent {
    const total = { ...NOTHING };
    for (const one of all) {
        for (const key of Object.keys(total) as (keyof Spent)[]) {
            total[key] += one[key];
        }
    }
    return total;
}

/** What the attempts of a task reported last, added. */
export function spentBy(points: readonly HistoryPoint[]): Spent {
    const last = new Map<number, Spent>();
    for (const { attempt, progress } of points) {
        if (progress?.timeSpent !== undefined && progress.timeSpent.seconds > 0) {
            last.set(attempt, spentOf(progress.timeSpent));
        }
    }
    return sum([...last.values()]);
}

/** How the seconds of a job were filled. */
interface Filled {
    /** By task that workers held. */
    readonly held: ReadonlyMap<string, number>;
    /** By stage, where only the coordinator worked. */
    readonly own: ReadonlyMap<string, number>;
    readonly waiting: number;
    readonly idle: number;
    /** Tasks that waited for a worker while others ran, on average. */
    readonly queue: number;
}

interface Change {
    readonly timeMs: number;
    apply(): void;
}

function filled({ tasks, events, startMs, nowMs }: BoundsData): Filled {
    const stages = new Map(tasks.map(({ task, stage }) => [task, stage]));
    const isOwn = (task: string): boolean => OWN_STAGES.has(stages.get(task) ?? '');
    const held = new Map<string, number>();
    const own = new Map<string, number>();
    let [waiting, idle, queued, busy] = [0, 0, 0, 0];
    let [running, isPaused] = [0, false];
    /** Seconds of a task that has been held from the beginning. */
    let perTask = 0;
    const ready = new Set<string>();
    const begun = new Set<string>();
    const working = new Map<string, number>();
    const changes: Change[] = [];
    for (const [task, bars] of attemptsOf({ tasks, events, nowMs })) {
        const stage = stages.get(task) ?? '';
        for (const { startMs: from, endMs: to } of bars) {
            if (isOwn(task)) {
                const by = (step: number) => (): void =>
                    void working.set(stage, (working.get(stage) ?? 0) + step);
                changes.push({ timeMs: from, apply: by(1) }, { timeMs: to, apply: by(-1) });
                continue;
            }
            let before = 0;
            changes.push(
                {
                    timeMs: from,
                    apply: () => {
                        before = perTask;
                        running += 1;
                    },
                },
                {
                    timeMs: to,
                    apply: () => {
                        held.set(task, (held.get(task) ?? 0) + perTask - before);
                        running -= 1;
                    },
                },
            );
        }
    }
    // No event tells when a task becomes ready first. It does when its stage begins.
    const enter = (stage: string): void =>
        tasks
            .filter((one) => one.stage === stage && one.state !== 'blocked' && !begun.has(one.task))
            .forEach(({ task }) => ready.add(task));
    for (const { kind, task, state, timeMs } of events) {
        if (kind === 'job_stage' && state !== null && !OWN_STAGES.has(state)) {
            changes.push({ timeMs, apply: () => enter(state) });
        } else if (kind === 'task' && task !== null && !isOwn(task)) {
            const apply = (): void => {
                if (state === 'ready') {
                    ready.add(task);
                } else {
                    ready.delete(task);
                    begun.add(task);
                }
            };
            changes.push({ timeMs, apply });
        } else if (kind === 'job_state') {
            const apply = (): void => {
                isPaused = state === 'paused';
                if (FINAL.has(state ?? '')) {
                    ready.clear();
                }
            };
            changes.push({ timeMs, apply });
        }
    }
    changes.push({ timeMs: nowMs, apply: () => {} });
    let beforeMs = startMs;
    for (const { timeMs, apply } of changes.toSorted((a, b) => a.timeMs - b.timeMs)) {
        const seconds = Math.max(0, Math.min(timeMs, nowMs) - beforeMs) / 1000;
        beforeMs = Math.max(beforeMs, Math.min(timeMs, nowMs));
        const stage = [...working].find(([, count]) => count > 0)?.[0];
        if (running > 0) {
            perTask += seconds / running;
            busy += seconds;
            queued += seconds * (isPaused ? 0 : ready.size);
        } else if (stage !== undefined) {
            own.set(stage, (own.get(stage) ?? 0) + seconds);
        } else if (!isPaused && ready.size > 0) {
            waiting += seconds;
        } else if (!isPaused) {
            idle += seconds;
        }
        apply();
    }
    return { held, own, waiting, idle, queue: busy > 0 ? queued / busy : 0 };
}

const percentOf = (share: number): string => `${Math.round(100 * share)} %`;

function words(
    bound: Bound,
    { maxParallel, tasks }: BoundsData,
    { own, queue }: Filled,
    spent: Spent,
    seconds: Readonly<Record<Part, number>>,
    total: number,
): { readonly text: string; readonly advice: string } {
    const ofWorkers = (part: number): string =>
        `workers spent ${percentOf(part / Math.max(spent.all, 1e-9))} of their time`;
    const andAlso = (part: number, what: string): string => {
        const share = part / Math.max(spent.all, 1e-9);
        return share < WORTH_NAMING ? '' : `, and ${percentOf(share)} waiting for ${what}`;
    };
    switch (bound) {
        case 'training': {
            const text = `The GPU bounds this job: ${ofWorkers(spent.training)} training.`;
            const waited = `on average ${queue.toFixed(1)} tasks waited`;
            if (queue >= QUEUE_FROM && maxParallel > 0) {
                return { text, advice: `At most ${maxParallel} of its tasks may run at a time; ${waited}.` };
            }
            if (queue >= QUEUE_FROM) {
                return { text, advice: `More workers would finish it sooner: ${waited} for one.` };
            }
            const isCut = tasks.filter(({ stage }) => stage === 'partition').length > 1;
            const advice = isCut
                ? 'Hardly a task waited. Faster GPUs, or more partitions and workers, would help.'
                : 'More partitions (--partitions) let several workers share the work.';
            return { text, advice };
        }
        case 'disk':
            return {
                text:
                    `Reading photographs from disk bounds this job: ${ofWorkers(spent.disk)} waiting for the ` +
                    `disk${andAlso(spent.photographs, 'decoding')}.`,
                advice:
                    'What helps: --cache-dir on a faster disk of the worker, and more memory for decoded ' +
                    'photographs (--image-cache-bytes), so that each is read once.',
            };
        case 'photographs':
            return {
                text:
                    `Decoding photographs bounds this job: ${ofWorkers(spent.photographs)} waiting for ` +
                    `it${andAlso(spent.disk, 'the disk')}.`,
                advice:
                    'What helps: more threads that read ahead (train.prefetch_threads), on a machine with ' +
                    'processors for them, and more memory for decoded photographs (--image-cache-bytes).',
            };
        case 'network': {
            const done = 'fetching input and sending results';
            return {
                text: `The network bounds this job: ${ofWorkers(spent.fetching + spent.sending)} ${done}.`,
                advice:
                    spent.fetching >= spent.sending
                        ? 'Workers keep what they fetched in --cache-dir. Workers of a machine may share it.'
                        : 'Workers wait until the coordinator has stored their results.',
            };
        }
        case 'watching':
            return {
                text: `Watching bounds this job: ${ofWorkers(spent.watching)} measuring and saving.`,
                advice:
                    'Measurements (train.eval_every), previews (train.preview_seconds) and checkpoints ' +
                    '(train.checkpoint_seconds) can be rarer.',
            };
        case 'coordinator': {
            const [stage = ''] = [...own].toSorted((a, b) => b[1] - a[1])[0] ?? [];
            const work = `its own work, mostly ${OWN_WORK[stage] ?? stage},`;
            const share = percentOf(seconds.coordinator / total);
            return {
                text: `The coordinator bounds this job: ${work} took ${share} of the time.`,
                advice: '',
            };
        }
        case 'waiting': {
            const share = percentOf(seconds.waiting / total);
            return {
                text: `Lack of workers bounds this job: for ${share} of the time no worker took its tasks.`,
                advice: 'Start workers that may take them.',
            };
        }
        case 'nothing': {
            const known = PARTS.filter((part) => part !== 'unknown');
            const [first, second] = known.toSorted((a, b) => seconds[b] - seconds[a]);
            const one = (part: Part): string =>
                `${PART_WORDS[part].toLowerCase()} (${percentOf(seconds[part] / total)})`;
            return {
                text: `Nothing bounds this job alone: most is ${one(first!)} and ${one(second!)}.`,
                advice: '',
            };
        }
    }
}

/** What bounds a job; null where too little is known. */
export function verdictOf(data: BoundsData): Verdict | null {
    const time = filled(data);
    const seconds: Record<Part, number> = {
        training: 0,
        disk: 0,
        photographs: 0,
        network: 0,
        watching: 0,
        coordinator: [...time.own.values()].reduce((a, b) => a + b, 0),
        waiting: time.waiting,
        unknown: time.idle,
    };
    const reported = new Map(data.histories.map(({ taskId, points }) => [taskId, spentBy(points)]));
    for (const [task, weight] of time.held) {
        const { all, training, disk, photographs, fetching, sending, watching } = reported.get(task) ?? NOTHING;
        const network = fetching + sending;
        // Where clocks disagree, the parts may be more than the whole.
        const whole = Math.max(all, training + disk + photographs + network + watching);
        const parts: readonly (readonly [Part, number])[] = [
            ['training', training],
            ['disk', disk],
            ['photographs', photographs],
            ['network', network],
            ['watching', watching],
        ];
        let left = weight;
        for (const [part, spent] of parts) {
            const share = whole > 0 ? (weight * spent) / whole : 0;
            seconds[part] += share;
            left -= share;
        }
        seconds.unknown += Math.max(0, left);
    }
    const total = PARTS.reduce((all, part) => all + seconds[part], 0);
    if (total < LEAST_SECONDS || seconds.unknown > MOST_UNKNOWN * total) {
        return null;
    }
    const known = PARTS.filter((part) => part !== 'unknown') as Exclude<Part, 'unknown'>[];
    // Disk and decoding are both the way of a photograph to the GPU. Together they may bound a job; then the
    // larger one is named.
    const forPhotographs = seconds.disk + seconds.photographs;
    const weightOf = (part: Part): number =>
        part === 'disk' || part === 'photographs' ? forPhotographs : seconds[part];
    const heaviest = known.reduce((a, b) => (weightOf(b) > weightOf(a) ? b : a));
    const largest =
        heaviest !== 'disk' || seconds.disk > seconds.photographs ? heaviest : ('photographs' as const);
    const bound: Bound = weightOf(largest) >= BOUND_FROM * total ? largest : 'nothing';
    const spent = sum([...reported.values()]);
    return {
        bound,
        ...words(bound, data, time, spent, seconds, total),
        parts: PARTS.map((part) => ({ part, seconds: seconds[part], share: seconds[part] / total })).filter(
            ({ share }) => share >= 0.005,
        ),
    };
}

/** What bounds a job of which this is known; null also before its first snapshot. */
export function verdictOfJob(record: JobRecord, histories: readonly TaskHistory[]): Verdict | null {
    const { job, tasks, events, nowMs } = record;
    if (job?.createTime === undefined) {
        return null;
    }
    const { createTime, maxParallel } = job;
    return verdictOf({ tasks, histories, events, startMs: timestampMs(createTime), nowMs, maxParallel });
}

/** A part in words, for its legend and for screen readers. */
export const partText = ({ part, seconds, share }: Verdict['parts'][number]): string =>
    `${PART_WORDS[part]}: ${percentOf(share)}, ${durationText(seconds)}`;
