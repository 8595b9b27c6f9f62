// What the service works on, in the order in which workers take it, what bounds it, and what is lacking.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import { type Job, JobState } from '../../rpc/fathom/v1/job_pb.ts';
import { type Context, problemOf } from '../context.ts';
import { Table, chip, h, only, setText } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { agoText, percentText } from '../format.ts';
import { poll } from '../poll.ts';
import { jobLink } from '../route.ts';
import { VISIBILITY } from '../visibility.ts';
import { capital, shownState, stageLabel } from '../words.ts';
import { BoundsOfJobs, showBound, sourceOf } from './bounds-of-jobs.ts';

const EVERY_MS = 3000;
/** More open jobs are counted but not shown. */
const MOST_JOBS = 500;

const createdMs = ({ createTime }: Job): number => (createTime === undefined ? 0 : timestampMs(createTime));

/** Jobs with a higher priority first, among equals the older. */
export const inOrder = (jobs: readonly Job[]): readonly Job[] =>
    jobs.toSorted((a, b) => b.priority - a.priority || createdMs(a) - createdMs(b));

export function showQueue(container: HTMLElement, context: Context): void {
    const { session, signal } = context;
    let now = Date.now();
    let queue: readonly Job[] = [];
    const bounds = new BoundsOfJobs(sourceOf(session.api), VISIBILITY, signal, () => table.show(queue));
    const table = new Table<Job>(
        'Jobs that have not ended',
        'queue',
        [
            {
                title: 'Job',
                kind: 'name',
                isHeader: true,
                show: (cell, { jobId, name }) => setText(only(cell, () => h('a', { href: jobLink(jobId) })), name === '' ? jobId : name),
            },
            { title: 'State', kind: 'state', show: (cell, job) => chip(cell, shownState(job), capital(shownState(job))) },
            { title: 'Progress', kind: 'number', show: (cell, { progress }) => setText(cell, percentText(progress)) },
            { title: 'Stage', kind: 'stage', show: (cell, { stage }) => setText(cell, stageLabel(stage)) },
            { title: 'Tenant', kind: 'tenant', show: (cell, { tenant }) => setText(cell, tenant) },
            { title: 'Priority', kind: 'number', show: (cell, { priority }) => setText(cell, String(priority)) },
            {
                title: 'What bounds it',
                kind: 'bound',
                show: (cell, { jobId }) => showBound(cell, jobId, bounds.of(jobId)),
            },
            {
                title: 'What is lacking',
                kind: 'wide',
                show: (cell, { waitingReason, waitingSince, state, pauseReason }) => {
                    const since = waitingSince === undefined ? '' : ` (${agoText(timestampMs(waitingSince), now)})`;
                    setText(cell, state === JobState.PAUSED ? pauseReason : waitingReason === '' ? '' : `${waitingReason}${since}`);
                },
            },
        ],
        ({ jobId }) => jobId,
    );
    const summary = h('p', { class: 'soft', role: 'status' }, 'Loading the queue …');
    const content = h('div', { class: 'card flush', hidden: true });
    container.append(summary, content);
    poll(() => EVERY_MS, signal, async () => {
        try {
            const request = { pageSize: MOST_JOBS, states: [JobState.RUNNING, JobState.PAUSED] };
            const { jobs, nextPageToken } = await session.api.jobs.listJobs(request, { signal });
            now = Date.now();
            content.hidden = false;
            queue = inOrder(jobs);
            // The rows are shown at once; the answers change them.
            void bounds.take(queue);
            if (jobs.length === 0) {
                setText(summary, '');
                content.replaceChildren(h('div', { class: 'empty' }, h('h2', {}, 'The queue is empty'), h('p', {}, 'All jobs have ended.')));
                return;
            }
            table.show(queue);
            if (table.element.parentElement !== content) {
                content.replaceChildren(table.element);
            }
            const waiting = jobs.filter((job) => shownState(job) === 'waiting').length;
            const more = nextPageToken === '' ? '' : 'the newest ';
            setText(summary, `${more}${jobs.length} open ${jobs.length === 1 ? 'job' : 'jobs'}, ${waiting} waiting for a worker`);
        } catch (error) {
            const shown = problemOf('The queue cannot be shown', faultOf(error));
            if (shown !== null) {
                setText(summary, '');
                content.hidden = false;
                content.replaceChildren(shown);
            }
        }
    });
}
