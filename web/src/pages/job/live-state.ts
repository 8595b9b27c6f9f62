// What there is to see of a job that still trains, and what a reader is told about it.

import type { BlobRef } from '../../rpc/fathom/v1/blob_pb.ts';
import { type Job, JobState, Stage, type Task, TaskState } from '../../rpc/fathom/v1/job_pb.ts';
import { hasEnded } from '../words.ts';

/** A model that can be shown now. */
export type Live =
    | { readonly kind: 'finished'; readonly key: string }
    /** The model of the whole scene, before it is evaluated. */
    | { readonly kind: 'merged'; readonly key: string; readonly model: BlobRef }
    | {
          readonly kind: 'composite';
          readonly key: string;
          readonly coarse: BlobRef | null;
          /** By the number of the partition. */
          readonly partitions: ReadonlyMap<number, BlobRef>;
          /** Of how many. */
          readonly of: number;
      };

/** The best model that a job has now; null where there is none. */
export function liveOf(job: Job): Live | null {
    if (job.state === JobState.SUCCEEDED) {
        return { kind: 'finished', key: 'finished' };
    }
    if (hasEnded(job.state)) {
        return null;
    }
    const models = (stage: Stage): readonly Task[] =>
        job.tasks.filter(
            (task) => task.stage === stage && task.state === TaskState.DONE && task.model !== undefined,
        );
    const merged = models(Stage.BORDERS)[0]?.model ?? models(Stage.MERGE)[0]?.model;
    if (merged !== undefined) {
        return { kind: 'merged', key: `merged ${merged.digest}`, model: merged };
    }
    const coarse = models(Stage.GLOBAL)[0]?.model ?? null;
    const finished = models(Stage.PARTITION).toSorted((a, b) => a.partition - b.partition);
    if (job.plan === undefined || (coarse === null && finished.length === 0)) {
        return null;
    }
    const partitions = new Map(finished.map(({ partition, model }) => [partition, model!]));
    const digests = [...partitions.values()].map(({ digest }) => digest);
    return {
        kind: 'composite',
        key: ['composite', coarse?.digest ?? '', ...digests].join(' '),
        coarse,
        partitions,
        of: Math.max(job.partitions, partitions.size),
    };
}

/** What is shown, in a sentence. */
export function liveText(live: Live): string {
    if (live.kind === 'finished') {
        return 'The finished model.';
    }
    if (live.kind === 'merged') {
        return 'The merged model. Its evaluation follows.';
    }
    const { coarse, partitions, of } = live;
    if (of === 1) {
        return 'The trained model. Its evaluation follows.';
    }
    if (partitions.size === 0) {
        return `The coarse model. None of ${of} partitions has finished.`;
    }
    if (partitions.size === of) {
        return `All ${of} partitions. They are merged next.`;
    }
    const elsewhere = coarse === null ? 'nothing' : 'the coarse model';
    return `${partitions.size} of ${of} partitions, ${elsewhere} elsewhere.`;
}

/** Why there is nothing to see yet. */
export function nothingText(job: Job): string {
    if (hasEnded(job.state)) {
        return 'The job did not succeed, so it has no files.';
    }
    const isCoarse = job.tasks.some(({ stage }) => stage === Stage.GLOBAL);
    const first = isCoarse ? 'the coarse model has been trained' : 'a partition has finished';
    return `The scene is shown here as soon as ${first}. Until then Views has previews.`;
}

/** How many bytes must be fetched to show a model; 0 for a finished one, whose files say it. */
export function liveBytes(live: Live): number {
    if (live.kind === 'finished') {
        return 0;
    }
    const blobs = live.kind === 'merged' ? [live.model] : [live.coarse, ...live.partitions.values()];
    return blobs.reduce((sum, blob) => sum + Number(blob?.sizeBytes ?? 0), 0);
}
