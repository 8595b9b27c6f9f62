// What bounds the jobs of the queue: for each the verdict that its Overview gives.
//
// A verdict needs the tasks, all past events and the history of a job, which may be megabytes. So only the
// first jobs are asked about, one after another, not often, and none while nobody sees the page.

import { type History, type Job, type JobEvent, JobState } from '../../rpc/fathom/v1/job_pb.ts';
import type { Api } from '../api.ts';
import { h, setText } from '../dom.ts';
import { BOUND_WORDS, type Verdict, verdictOfJob } from '../job/bounds.ts';
import { pauseAfter } from '../job/history.ts';
import { JobRecord } from '../job/record.ts';
import { jobLink } from '../route.ts';
import type { Visibility } from '../visibility.ts';

/** So many running jobs have a verdict in the queue, in its order. */
export const MOST_JOBS = 8;
/** Each is asked about this often at most, milliseconds. */
export const EVERY_MS = 30_000;
/** The header with the time of an answer has whole seconds. */
const HALF_SECOND_MS = 500;

/** What is shown of a job: a verdict, where to find one, or nothing, since too little is known or it rests. */
export type Shown = Verdict | 'in its Overview' | null;

/** The calls about one job. */
export interface Source {
    /** `onTime` gets the time of the answer by the clock of the service. */
    job(id: string, signal: AbortSignal, onTime: (timeMs: number) => void): Promise<Job>;
    /** The events after a known one; the stream stays open. */
    events(id: string, afterSeq: bigint, signal: AbortSignal): AsyncIterable<JobEvent>;
    history(id: string, signal: AbortSignal): Promise<Pick<History, 'tasks'>>;
}

export const sourceOf = (api: Api): Source => ({
    job: (jobId, signal, onTime) => {
        const onHeader = (headers: Headers): void => {
            const timeMs = Date.parse(headers.get('date') ?? '') + HALF_SECOND_MS;
            if (Number.isFinite(timeMs)) {
                onTime(timeMs);
            }
        };
        return api.jobs.getJob({ jobId }, { signal, onHeader });
    },
    // With the time limit of a call: it is closed as soon as the past is known.
    events: (jobId, afterSeq, signal) => api.jobs.watchJob({ jobId, afterSeq }, { signal }),
    history: (jobId, signal) => api.jobs.getHistory({ jobId }, { signal }),
});

/** What is known of one job. */
interface Known {
    readonly record: JobRecord;
    verdict: Verdict | null;
    /** When it may be asked about again. */
    againMs: number;
}

export class BoundsOfJobs {
    readonly #source: Source;
    readonly #visibility: Pick<Visibility, 'isHidden'>;
    readonly #signal: AbortSignal;
    readonly #onChange: () => void;
    readonly #now: () => number;
    readonly #known = new Map<string, Known>();
    /** The running jobs that are asked about, and the others. */
    #asked: readonly string[] = [];
    #others: ReadonlySet<string> = new Set();
    #isAsking = false;

    /** `onChange` is called after each answer, until `signal` ends it. */
    constructor(
        source: Source,
        visibility: Pick<Visibility, 'isHidden'>,
        signal: AbortSignal,
        onChange: () => void,
        now: () => number = Date.now,
    ) {
        this.#source = source;
        this.#visibility = visibility;
        this.#signal = signal;
        this.#onChange = onChange;
        this.#now = now;
    }

    /** Takes the open jobs in the order of the queue, and asks about those whose time has come. */
    async take(jobs: readonly Pick<Job, 'jobId' | 'state'>[]): Promise<void> {
        const running = jobs.filter(({ state }) => state === JobState.RUNNING).map(({ jobId }) => jobId);
        this.#asked = running.slice(0, MOST_JOBS);
        this.#others = new Set(running.slice(MOST_JOBS));
        // What is known of a job that is paused or moves down is kept: it may come back soon.
        const open = new Set(jobs.map(({ jobId }) => jobId));
        [...this.#known.keys()].filter((id) => !open.has(id)).forEach((id) => this.#known.delete(id));
        if (this.#isAsking) {
            return;
        }
        this.#isAsking = true;
        try {
            for (let id = this.#next(); id !== undefined; id = this.#next()) {
                await this.#ask(id);
                if (!this.#signal.aborted) {
                    this.#onChange();
                }
            }
        } finally {
            this.#isAsking = false;
        }
    }

    of(id: string): Shown {
        if (this.#others.has(id)) {
            return 'in its Overview';
        }
        return this.#asked.includes(id) ? (this.#known.get(id)?.verdict ?? null) : null;
    }

    /** The job whose turn it is: the one that has waited longest, so that slow answers leave out none. */
    #next(): string | undefined {
        if (this.#signal.aborted || this.#visibility.isHidden) {
            return undefined;
        }
        const again = (id: string): number => this.#known.get(id)?.againMs ?? 0;
        const now = this.#now();
        return this.#asked.filter((id) => again(id) <= now).toSorted((a, b) => again(a) - again(b))[0];
    }

    async #ask(id: string): Promise<void> {
        const known = this.#known.get(id) ?? { record: new JobRecord(), verdict: null, againMs: 0 };
        this.#known.set(id, known);
        let pauseMs = EVERY_MS;
        try {
            const { record } = known;
            record.snapshot(await this.#source.job(id, this.#signal, (timeMs) => record.clock(timeMs)));
            const isWhole = await this.#readPast(id, record);
            // Last, so that it tells of the same present as the verdict.
            const history = await this.#source.history(id, this.#signal);
            pauseMs = pauseAfter(history, EVERY_MS);
            if (isWhole) {
                known.verdict = verdictOfJob(record, history.tasks);
            }
        } catch {
            // What was shown stays. The calls note a lost connection and a refused token by themselves.
        }
        known.againMs = this.#now() + pauseMs;
    }

    /** Reads the events that the snapshot contains, and closes the stream. Returns whether all have come. */
    async #readPast(id: string, record: JobRecord): Promise<boolean> {
        const last = record.job?.lastSeq ?? 0n;
        if (record.lastSeq < last) {
            const done = new AbortController();
            const signal = AbortSignal.any([this.#signal, done.signal]);
            try {
                for await (const event of this.#source.events(id, record.lastSeq, signal)) {
                    record.apply(event);
                    if (record.lastSeq >= last) {
                        break;
                    }
                }
            } finally {
                done.abort();
            }
        }
        return record.lastSeq >= last;
    }
}

/** Fills the cell of a job: the bound in a few words, and below it the sentence and the advice. */
export function showBound(cell: HTMLElement, id: string, shown: Shown): void {
    const kind = shown === null || typeof shown === 'string' ? (shown ?? '') : 'verdict';
    if (cell.dataset['shown'] !== kind) {
        cell.dataset['shown'] = kind;
        cell.replaceChildren(
            ...(kind === '' ? [] : [kind === 'verdict' ? verdictBox() : h('a', { href: jobLink(id) }, kind)]),
        );
    }
    if (shown !== null && typeof shown !== 'string') {
        const [word, words] = cell.firstElementChild!.children;
        setText(word as HTMLElement, BOUND_WORDS[shown.bound]);
        setText(words as HTMLElement, `${shown.text} ${shown.advice}`.trim());
    }
}

const verdictBox = (): HTMLElement => h('div', {}, h('div'), h('div', { class: 'soft' }));
