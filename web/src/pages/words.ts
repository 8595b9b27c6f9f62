// Words for states. The first kind are those of coordinator/src/json.rs, which the parts of the page take;
// the labels are for people.

import { Role, WorkerState } from '../rpc/fathom/admin/v1/admin_pb.ts';
import type { Worker } from '../rpc/fathom/admin/v1/admin_pb.ts';
import { JobState, Stage, TaskState } from '../rpc/fathom/v1/job_pb.ts';
import type { Job } from '../rpc/fathom/v1/job_pb.ts';
import { LogSeverity } from '../rpc/fathom/v1/log_pb.ts';

const JOB_STATES: Readonly<Record<number, string>> = {
    [JobState.RUNNING]: 'running',
    [JobState.SUCCEEDED]: 'succeeded',
    [JobState.FAILED]: 'failed',
    [JobState.CANCELLED]: 'cancelled',
    [JobState.PAUSED]: 'paused',
};
const STAGES: Readonly<Record<number, string>> = {
    [Stage.UNSPECIFIED]: 'waiting',
    [Stage.PLAN]: 'plan',
    [Stage.GLOBAL]: 'global',
    [Stage.FIRST_PART]: 'first_part',
    [Stage.EXCHANGE]: 'exchange',
    [Stage.PARTITION]: 'partition',
    [Stage.MERGE]: 'merge',
    [Stage.BORDERS]: 'borders',
    [Stage.EVALUATE]: 'evaluate',
    [Stage.ARTIFACTS]: 'artifacts',
};
const TASK_STATES: Readonly<Record<number, string>> = {
    [TaskState.BLOCKED]: 'blocked',
    [TaskState.READY]: 'ready',
    [TaskState.LEASED]: 'running',
    [TaskState.DONE]: 'done',
    [TaskState.DEAD]: 'failed',
    [TaskState.CANCELLED]: 'cancelled',
};
const SEVERITIES: Readonly<Record<number, string>> = {
    [LogSeverity.TRACE]: 'trace',
    [LogSeverity.DEBUG]: 'debug',
    [LogSeverity.INFO]: 'info',
    [LogSeverity.WARN]: 'warn',
    [LogSeverity.ERROR]: 'error',
};
const ROLES: Readonly<Record<number, string>> = {
    [Role.VIEWER]: 'viewer',
    [Role.SUBMITTER]: 'submitter',
    [Role.OPERATOR]: 'operator',
    [Role.WORKER]: 'worker',
};
const STAGE_LABELS: Readonly<Record<string, string>> = {
    waiting: 'Waiting',
    plan: 'Planning',
    global: 'Coarse model',
    first_part: 'Partitions, first part',
    exchange: 'Exchange',
    partition: 'Partitions',
    merge: 'Merging',
    borders: 'Borders',
    evaluate: 'Evaluation',
    artifacts: 'Writing files',
};

/** The states by which jobs can be selected. */
export const STATES_BY_WORD: Readonly<Record<string, JobState>> = {
    running: JobState.RUNNING,
    paused: JobState.PAUSED,
    succeeded: JobState.SUCCEEDED,
    failed: JobState.FAILED,
    cancelled: JobState.CANCELLED,
};

export const jobStateWord = (state: JobState): string => JOB_STATES[state] ?? 'unknown';
export const stageWord = (stage: Stage): string => STAGES[stage] ?? 'unknown';
export const taskStateWord = (state: TaskState): string => TASK_STATES[state] ?? 'unknown';
export const severityWord = (severity: LogSeverity): string => SEVERITIES[severity] ?? '?';
export const roleWord = (role: Role): string => ROLES[role] ?? 'unknown';
export const stageLabel = (stage: Stage): string => STAGE_LABELS[stageWord(stage)] ?? stageWord(stage);

export const capital = (word: string): string => word.charAt(0).toUpperCase() + word.slice(1);

/** The state of a worker. One that has not called within the duration of a lease is silent. */
export function workerStateWord(worker: Worker): string {
    if (!worker.connected) {
        return 'silent';
    }
    const words: Readonly<Record<number, string>> = {
        [WorkerState.ACTIVE]: 'active',
        [WorkerState.CORDONED]: 'cordoned',
        [WorkerState.DRAINING]: 'draining',
    };
    return words[worker.state] ?? 'unknown';
}

export const hasEnded = (state: JobState): boolean =>
    state === JobState.SUCCEEDED || state === JobState.FAILED || state === JobState.CANCELLED;

/** The state as the page shows it: a running job that waits for a worker is waiting. */
export const shownState = (job: Pick<Job, 'state' | 'waitingReason'>): string =>
    job.state === JobState.RUNNING && job.waitingReason !== '' ? 'waiting' : jobStateWord(job.state);

/** "partition-0003" as "Partition 3". */
export function taskLabel(task: string): string {
    const match = /^([a-z_]+)(?:-(\d+))?$/.exec(task);
    if (match === null) {
        return task;
    }
    const [, name = '', number] = match;
    const labels: Readonly<Record<string, string>> = { partition: 'Partition', first_part: 'First part of partition' };
    const label = labels[name] ?? STAGE_LABELS[name] ?? name;
    return number === undefined ? label : `${label} ${Number(number)}`;
}
