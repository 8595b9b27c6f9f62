// What the sections of a job's page have in common.

import type { Artifact, Job } from '../../rpc/fathom/v1/job_pb.ts';
import { JobState } from '../../rpc/fathom/v1/job_pb.ts';
import type { Context } from '../context.ts';
import { h } from '../dom.ts';
import type { JobRecord } from './record.ts';

export interface JobContext extends Context {
    readonly id: string;
    readonly record: JobRecord;
    /** The job as it is known now. */
    readonly job: Job;
    /** The files of a job that has succeeded, by ascending path. */
    files(): Promise<readonly Artifact[]>;
    /** A file as JSON; null if the job has no such file. */
    json(path: string): Promise<unknown>;
}

export interface Section {
    /** The job has changed. */
    update(): void;
    /** Frees what the signal of the context does not. */
    destroy?(): void;
}

export type OpenSection = (container: HTMLElement, context: JobContext) => Section;

/** Shows something that exists only once the job has succeeded; `open` is called once, then. */
export function whenSucceeded(
    container: HTMLElement,
    context: JobContext,
    what: string,
    open: () => void,
): Section {
    let shown: JobState | null = null;
    const update = (): void => {
        const { state } = context.job;
        if (state === shown) {
            return;
        }
        shown = state;
        if (state === JobState.SUCCEEDED) {
            container.replaceChildren();
            open();
            return;
        }
        const isOpen = state === JobState.RUNNING || state === JobState.PAUSED;
        const text = isOpen ? `${what} will be here once the job has succeeded.` : 'The job did not succeed, so it has no files.';
        container.replaceChildren(h('div', { class: 'empty' }, h('h2', {}, 'Nothing yet'), h('p', {}, text)));
    };
    update();
    return { update };
}
