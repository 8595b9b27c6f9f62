// What is known of one job: snapshots of GetJob and the events of WatchJob, merged.
//
// A stream begins with all events of the past. Those that a snapshot contains already are kept for the
// timeline and change nothing else.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import type { Job, JobEvent, Progress, Task } from '../../rpc/fathom/v1/job_pb.ts';
import { JobState, Stage, TaskState } from '../../rpc/fathom/v1/job_pb.ts';
import type { CurvePoint, TaskInfo, TimelineEvent } from '../parts/index.ts';
import { jobStateWord, stageWord, taskStateWord } from '../words.ts';

const PER_PARTITION: ReadonlySet<Stage> = new Set([Stage.FIRST_PART, Stage.PARTITION]);
/** Points of a task that are kept; above, every other one is removed. */
const MOST_POINTS = 2000;

export function pointOf(progress: Progress, attempt: number, timeMs: number): CurvePoint {
    return {
        timeMs,
        attempt,
        iteration: progress.iteration,
        loss: progress.loss,
        psnr: progress.heldOut?.psnrDb ?? null,
        gaussians: progress.gaussians,
        rate: progress.iterationsPerSecond,
        memoryBytes: Number(progress.memoryBytes),
    };
}

/** An event in words; null for one that is not kept. */
export function eventInfo({ event, time }: JobEvent): TimelineEvent | null {
    const base = {
        task: null,
        state: null,
        attempt: 0,
        worker: null,
        message: '',
        resumedFrom: 0,
        timeMs: time === undefined ? 0 : timestampMs(time),
    };
    switch (event.case) {
        case 'jobState':
            return { ...base, kind: 'job_state', state: jobStateWord(event.value.state), message: event.value.message };
        case 'jobStage':
            return { ...base, kind: 'job_stage', state: stageWord(event.value.stage) };
        case 'taskChanged': {
            const { taskId: task, state, attempt, worker, message, resumedFromIteration: resumedFrom } = event.value;
            const words = { state: taskStateWord(state), worker: worker === '' ? null : worker };
            return { ...base, ...words, kind: 'task', task, attempt, message, resumedFrom };
        }
        case 'checkpoint': {
            const { taskId: task, attempt, iteration } = event.value;
            return { ...base, kind: 'checkpoint', task, attempt, message: `iteration ${iteration}` };
        }
        case 'warning':
            return { ...base, kind: 'warning', message: event.value.message };
        case 'updated': {
            const { priority, maxParallel } = event.value;
            return { ...base, kind: 'updated', message: `priority ${priority}, at most ${maxParallel} tasks at a time` };
        }
        default:
            return null;
    }
}

export class JobRecord {
    /** Absent before the first snapshot. */
    job: Job | null = null;
    readonly events: TimelineEvent[] = [];
    /** Points that arrived while this page was open, by task. */
    readonly points = new Map<string, CurvePoint[]>();
    /** Number of the latest durable event of the stream. */
    lastSeq = 0n;
    #clockAheadMs = 0;

    /** Takes the present by the clock of the service. */
    clock(timeMs: number): void {
        this.#clockAheadMs = timeMs - Date.now();
    }

    /** Takes a snapshot. One that is older than the events is refused. */
    snapshot(job: Job): boolean {
        if (job.lastSeq < this.lastSeq) {
            return false;
        }
        this.job = job;
        return true;
    }

    /** Takes an event of the stream. Returns whether something changed. */
    apply(event: JobEvent): boolean {
        if (event.event.case === 'keepAlive' || event.event.case === 'progress') {
            // These are sent at once, so they show the clock of the service.
            this.clock(event.time === undefined ? Date.now() : timestampMs(event.time));
        }
        if (event.event.case === 'keepAlive') {
            return false;
        }
        if (event.event.case === 'progress') {
            return this.#progress(event);
        }
        if (event.seq <= this.lastSeq) {
            return false;
        }
        this.lastSeq = event.seq;
        const info = eventInfo(event);
        if (info !== null) {
            this.events.push(info);
        }
        if (this.job !== null && event.seq > this.job.lastSeq) {
            this.#change(this.job, event);
            this.job.lastSeq = event.seq;
        }
        return true;
    }

    /** The present by the clock of the service, or the end of the job. */
    get nowMs(): number {
        const now = Date.now() + this.#clockAheadMs;
        return this.job?.endTime === undefined ? now : timestampMs(this.job.endTime);
    }

    /** The tasks in words. */
    get tasks(): readonly TaskInfo[] {
        return (this.job?.tasks ?? []).map((task) => ({
            task: task.taskId,
            stage: stageWord(task.stage),
            partition: PER_PARTITION.has(task.stage) ? task.partition : null,
            state: taskStateWord(task.state),
            worker: task.worker === '' ? null : task.worker,
            iteration: task.progress?.iteration ?? 0,
            iterations: task.progress?.iterations ?? 0,
            attempts: task.attempts,
            psnr: task.progress?.heldOut?.psnrDb ?? null,
        }));
    }

    #task(id: string): Task | undefined {
        return this.job?.tasks.find(({ taskId }) => taskId === id);
    }

    #change(job: Job, { event }: JobEvent): void {
        switch (event.case) {
            case 'jobState': {
                job.state = event.value.state;
                const isEnd = event.value.state === JobState.FAILED || event.value.state === JobState.CANCELLED;
                job.error = isEnd ? event.value.message : '';
                job.pauseReason = event.value.state === JobState.PAUSED ? event.value.message : '';
                if (event.value.state === JobState.SUCCEEDED) {
                    job.progress = 1;
                }
                return;
            }
            case 'jobStage':
                job.stage = event.value.stage;
                return;
            case 'taskChanged': {
                const task = this.#task(event.value.taskId);
                if (task !== undefined) {
                    task.state = event.value.state;
                    task.attempts = Math.max(task.attempts, event.value.attempt);
                    task.worker = event.value.worker === '' ? task.worker : event.value.worker;
                    if (event.value.state === TaskState.LEASED) {
                        // Only snapshots give the reason, and this one is out of date.
                        job.waitingReason = '';
                        task.resumedFromIteration = event.value.resumedFromIteration;
                    }
                }
                return;
            }
            case 'checkpoint': {
                const task = this.#task(event.value.taskId);
                if (task !== undefined) {
                    task.checkpointIteration = event.value.iteration;
                }
                return;
            }
            case 'updated':
                job.priority = event.value.priority;
                job.maxParallel = event.value.maxParallel;
                return;
            default:
        }
    }

    #progress({ event, time }: JobEvent): boolean {
        if (event.case !== 'progress' || event.value.progress === undefined || this.job === null) {
            return false;
        }
        const { taskId, progress, jobProgress } = event.value;
        this.job.progress = jobProgress;
        const task = this.#task(taskId);
        if (task !== undefined) {
            task.progress = progress;
        }
        const known = this.points.get(taskId) ?? [];
        known.push(pointOf(progress, Math.max(1, task?.attempts ?? 1), time === undefined ? Date.now() : timestampMs(time)));
        this.points.set(taskId, known.length > MOST_POINTS ? known.filter((_, index) => index % 2 === 0) : known);
        return true;
    }
}

/** The points of a task that the service kept, and those that arrived since. */
export function mergedPoints(kept: readonly CurvePoint[], arrived: readonly CurvePoint[]): readonly CurvePoint[] {
    const last = kept.at(-1);
    if (last === undefined) {
        return arrived;
    }
    // The service dates a kept point when it was measured, and an event when it was sent, so that the same
    // point may have two times. Within an attempt the iteration decides.
    const isNew = ({ timeMs, attempt, iteration }: CurvePoint): boolean =>
        timeMs > last.timeMs && (attempt !== last.attempt || iteration > last.iteration);
    return [...kept, ...arrived.filter(isNew)];
}
