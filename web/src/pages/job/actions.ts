// What a submitter can do with a job.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import { type Job, JobState } from '../../rpc/fathom/v1/job_pb.ts';
import { ask } from '../dialog.ts';
import { copyField, h } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { timeText } from '../format.ts';
import { jobsLink, pageOfJob, shareLink } from '../route.ts';
import { hasEnded } from '../words.ts';
import type { JobContext } from './section.ts';

const REASON = { kind: 'text', label: 'Reason (optional)', maximum: 300 } as const;
const DAY = 86_400;
const DURATIONS = [
    ['3600', '1 hour'],
    [String(DAY), '1 day'],
    [String(7 * DAY), '1 week'],
    [String(30 * DAY), '30 days'],
    [String(90 * DAY), '90 days'],
] as const;

const isOpen = (state: JobState): boolean => !hasEnded(state);
const nameOf = (job: Job): string => (job.name === '' ? job.jobId : job.name);

const pageAddress = (): string => `${location.origin}${location.pathname}`;

async function share(context: JobContext): Promise<void> {
    if (!context.session.caller.tokensRequired) {
        await ask({
            title: 'Share this job',
            text: 'This service asks for no token, so the address of this page is enough. It shows everything to everybody who reaches the service.',
            content: copyField('Address', pageOfJob(pageAddress(), context.id)),
        });
        return;
    }
    await ask({
        title: 'Share this job',
        text: 'Whoever has the link sees this job and its files until the link expires, and nothing else. It needs no account.',
        fields: { duration: { kind: 'choice', label: 'The link is valid for', value: String(7 * DAY), options: DURATIONS } },
        action: 'Make a link',
        act: async ({ duration }) => {
            const answer = await context.session.api.jobs.shareJob({ jobId: context.id, expiresInSeconds: BigInt(duration) });
            const until = answer.expireTime === undefined ? '' : ` It is valid until ${timeText(timestampMs(answer.expireTime))}.`;
            return h(
                'div',
                {},
                copyField('Link', shareLink(pageAddress(), context.id, answer.secret)),
                h('p', {}, `The link is shown only once: copy it now.${until}`),
                h('p', { class: 'soft' }, `An operator can revoke it by its id, ${answer.tokenId}.`),
            );
        },
    });
}

/** The buttons. `changed` gets the job after an action. */
export function makeActions(
    context: JobContext,
    changed: (job: Job) => void,
): { readonly element: HTMLElement; update(): void } {
    const { id, session, say } = context;
    const { jobs } = session.api;
    const run = async (work: () => Promise<Job>, done: string): Promise<void> => {
        try {
            changed(await work());
            say(done);
        } catch (error) {
            say(faultOf(error).message);
        }
    };
    const pauseJob = (): Promise<boolean> =>
        ask({
            title: 'Pause the job?',
            text: 'Workers save what they have trained and give their tasks back. Resume continues from there.',
            fields: { reason: REASON },
            action: 'Pause',
            act: async ({ reason }) => {
                changed(await jobs.pauseJob({ jobId: id, reason }));
                return null;
            },
        });
    const cancelJob = (): Promise<boolean> =>
        ask({
            title: 'Cancel the job?',
            text: `"${nameOf(context.job)}" stops for good. It cannot be resumed, and has no model.`,
            fields: { reason: REASON },
            action: 'Cancel the job',
            dismiss: 'Keep it',
            isDangerous: true,
            act: async ({ reason }) => {
                changed(await jobs.cancelJob({ jobId: id, reason }));
                return null;
            },
        });
    const updateJob = (): Promise<boolean> =>
        ask({
            title: 'Priority and limits',
            fields: {
                priority: {
                    kind: 'number',
                    label: 'Priority',
                    value: context.job.priority,
                    minimum: -1000,
                    maximum: 1000,
                    hint: 'Jobs with a higher priority come first; among equals, the older job.',
                },
                parallel: {
                    kind: 'number',
                    label: 'Tasks at a time',
                    value: context.job.maxParallel,
                    minimum: 0,
                    maximum: 1_000_000,
                    hint: 'The most tasks of this job that run at a time. 0 sets no limit.',
                },
            },
            action: 'Save',
            act: async ({ priority, parallel }) => {
                changed(await jobs.updateJob({ jobId: id, priority: Number(priority), maxParallel: Number(parallel) }));
                return null;
            },
        });
    const deleteJob = (): Promise<boolean> =>
        ask({
            title: 'Delete the job?',
            text: `"${nameOf(context.job)}", its log and its files are deleted. This cannot be undone.`,
            action: 'Delete the job',
            dismiss: 'Keep it',
            isDangerous: true,
            act: async () => {
                await jobs.deleteJob({ jobId: id });
                location.hash = jobsLink();
                say('The job is deleted.');
                return null;
            },
        });

    // The page of `fathom train` takes its own token only, and has no others to give.
    const canShare = session.caller.tokensRequired || session.token() === null;
    type Entry = readonly [label: string, kind: string, isShown: (state: JobState) => boolean, act: () => void];
    const entries: readonly Entry[] = [
        ['Resume', 'primary', (state) => state === JobState.PAUSED, () => void run(() => jobs.resumeJob({ jobId: id }), 'The job goes on.')],
        ['Retry', 'primary', (state) => state === JobState.FAILED, () => void run(() => jobs.retryJob({ jobId: id }), 'The job is tried again.')],
        ['Pause', '', (state) => state === JobState.RUNNING, () => void pauseJob()],
        ['Priority', '', isOpen, () => void updateJob()],
        ['Share', '', () => canShare, () => void share(context)],
        ['Cancel', 'danger', isOpen, () => void cancelJob()],
        ['Delete', 'danger', hasEnded, () => void deleteJob()],
    ];
    const buttons = entries.map(([label, kind, isShown, act]) => ({
        isShown,
        element: h('button', { type: 'button', class: kind, onclick: act }, label),
    }));
    return {
        element: h('div', { class: 'row actions', role: 'group', 'aria-label': 'Actions' }, ...buttons.map(({ element }) => element)),
        update: () => {
            const { state } = context.job;
            buttons.forEach(({ isShown, element }) => (element.hidden = !isShown(state)));
        },
    };
}
