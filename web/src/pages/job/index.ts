// The page of one job: what it does now, and its sections.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import type { Artifact, Job } from '../../rpc/fathom/v1/job_pb.ts';
import { JobState } from '../../rpc/fathom/v1/job_pb.ts';
import { NO_LIMIT } from '../api.ts';
import { type Context, problem, problemPage } from '../context.ts';
import { chip, h, progressBar, setAttribute, setText } from '../dom.ts';
import { type Fault, faultOf } from '../faults.ts';
import { durationText, percentText, timeText } from '../format.ts';
import { poll } from '../poll.ts';
import { JOB_SECTIONS, type JobSection, jobLink, jobsLink } from '../route.ts';
import { VISIBILITY } from '../visibility.ts';
import { capital, hasEnded, shownState, stageLabel } from '../words.ts';
import { makeActions } from './actions.ts';
import { follow } from './follow.ts';
import { JobRecord } from './record.ts';
import type { JobContext, OpenSection, Section } from './section.ts';

/** What events do not tell (what a job waits for, the time left) is asked for this often. */
const EVERY_MS = 4000;
/** For a job with many tasks, whose snapshots are large, and for one that has ended. */
const SELDOM_MS = 15_000;
const MANY_TASKS = 200;
/** In a tab that nobody sees only the title goes on. */
const HIDDEN_EVERY_MS = 30_000;
/** Changes are shown this often at most. Unlike frames, timers also run in a tab that nobody sees. */
const DRAW_EVERY_MS = 100;
/** Without these the job cannot be shown, however often the page asks. */
const FINAL_REASONS: ReadonlySet<string> = new Set(['JOB_NOT_FOUND', 'BAD_ARGUMENT', 'ROLE_REFUSED']);

/** Each section is fetched when it is opened first. */
const SECTIONS: Readonly<Record<JobSection, () => Promise<{ readonly open: OpenSection }>>> = {
    overview: () => import('./overview.ts'),
    curves: () => import('./curves.ts'),
    views: () => import('./views.ts'),
    water: () => import('./water.ts'),
    seams: () => import('./seams.ts'),
    log: () => import('./log.ts'),
    files: () => import('./files.ts'),
    settings: () => import('./settings.ts'),
    viewer: () => import('./viewer.ts'),
};

export interface JobPage {
    /** Shows another section. */
    section(section: JobSection): void;
}

/** Shows a message, or nothing where it is empty. */
function say(element: HTMLElement, text: string): void {
    setText(element, text);
    element.hidden = text === '';
}

/** The header: name, state, progress, and what is wrong. */
function makeHeader(hasList: boolean): { readonly element: HTMLElement; readonly actions: HTMLElement; update(job: Job): void } {
    const name = h('h1', { tabindex: -1 });
    const state = h('span');
    const facts = h('p', { class: 'soft facts' });
    const bar = progressBar('Progress of the job');
    const percent = h('strong', { class: 'number' });
    const doing = h('span');
    const left = h('span', { class: 'soft' });
    const waiting = h('p', { class: 'alert warn', role: 'status', hidden: true });
    const paused = h('p', { class: 'alert', role: 'status', hidden: true });
    const error = h('p', { class: 'alert bad', role: 'alert', hidden: true });
    const actions = h('div');
    return {
        actions,
        element: h(
            'header',
            { class: 'job-head' },
            hasList ? h('p', { class: 'crumb' }, h('a', { href: jobsLink() }, 'Jobs')) : null,
            h('div', { class: 'head' }, h('div', { class: 'row title' }, name, state), actions),
            facts,
            h('div', { class: 'job-progress' }, bar.element, h('p', { class: 'row' }, percent, doing, left)),
            waiting,
            paused,
            error,
        ),
        update: (job) => {
            setText(name, job.name === '' ? job.jobId : job.name);
            chip(state, shownState(job), capital(shownState(job)));
            const created = job.createTime === undefined ? null : timestampMs(job.createTime);
            const ended = job.endTime === undefined ? null : timestampMs(job.endTime);
            const parts = [
                job.jobId,
                job.tenant === 'default' || job.tenant === '' ? null : `tenant ${job.tenant}`,
                created === null ? null : `created ${timeText(created)}`,
                created === null || ended === null ? null : `took ${durationText((ended - created) / 1000)}`,
                job.partitions === 0 ? null : job.partitions === 1 ? '1 partition' : `${job.partitions} partitions`,
                job.priority === 0 ? null : `priority ${job.priority}`,
                job.maxParallel === 0 ? null : `at most ${job.maxParallel} tasks at a time`,
            ];
            setText(facts, parts.filter((part) => part !== null).join(' · '));
            setText(percent, percentText(job.progress));
            bar.set(job.progress, percentText(job.progress));
            setAttribute(bar.element, 'data-state', shownState(job));
            setText(doing, hasEnded(job.state) ? '' : stageLabel(job.stage));
            const seconds = job.state === JobState.RUNNING && job.waitingReason === '' ? job.timeLeftSeconds : undefined;
            setText(left, seconds === undefined ? '' : `${durationText(seconds)} left`);
            const since = job.waitingSince === undefined ? '' : ` (since ${timeText(timestampMs(job.waitingSince))})`;
            say(waiting, job.waitingReason === '' || hasEnded(job.state) ? '' : `Waiting: ${job.waitingReason}${since}`);
            say(paused, job.state !== JobState.PAUSED ? '' : `Paused${job.pauseReason === '' ? '.' : `: ${job.pauseReason}`}`);
            say(error, job.state === JobState.FAILED || job.state === JobState.CANCELLED ? job.error : '');
        },
    };
}

/** The links to the sections. */
function makeTabs(id: string): { readonly element: HTMLElement; mark(section: JobSection): void } {
    const links = JOB_SECTIONS.map((section) => h('a', { href: jobLink(id, section) }, capital(section)));
    return {
        element: h('nav', { class: 'tabs', 'aria-label': 'Sections of the job' }, ...links),
        mark: (chosen) => {
            JOB_SECTIONS.forEach((section, index) => {
                const link = links[index]!;
                setAttribute(link, 'aria-current', section === chosen ? 'page' : null);
                if (section === chosen) {
                    link.scrollIntoView({ block: 'nearest', inline: 'nearest' });
                }
            });
        },
    };
}

/** The files of a job, fetched once it has succeeded. */
function filesOf(context: Context, id: string): Pick<JobContext, 'files' | 'json'> {
    const { session, signal } = context;
    let known: Promise<readonly Artifact[]> | null = null;
    const all = async (): Promise<readonly Artifact[]> => {
        const found: Artifact[] = [];
        let pageToken = '';
        do {
            const page = await session.api.jobs.listArtifacts({ jobId: id, pageToken }, { signal });
            found.push(...page.artifacts);
            pageToken = page.nextPageToken;
        } while (pageToken !== '');
        return found;
    };
    const files = (): Promise<readonly Artifact[]> => {
        known ??= all().catch((error: unknown) => {
            known = null;
            throw error;
        });
        return known;
    };
    return {
        files,
        json: async (path) => {
            const file = (await files()).find((one) => one.path === path);
            if (file === undefined) {
                return null;
            }
            const content = await session.api.file(id, path, signal);
            return JSON.parse(await content.text()) as unknown;
        },
    };
}

export function showJob(container: HTMLElement, context: Context, id: string, first: JobSection): JobPage {
    const { session } = context;
    const gone = new AbortController();
    const signal = AbortSignal.any([context.signal, gone.signal]);
    const record = new JobRecord();
    // A shared link shows its job and has no list.
    const header = makeHeader(session.caller.jobId === '');
    const tabs = makeTabs(id);
    const body = h('div');
    const loading = h('p', { class: 'loading', role: 'status' }, 'Loading the job …');
    container.append(loading);
    let section: Section | null = null;
    let stopSection = new AbortController();
    let chosen = first;
    let opened: JobSection | null = null;
    let timer = 0;
    let isFollowing = false;

    const jobContext: JobContext = {
        ...context,
        signal,
        id,
        record,
        get job(): Job {
            return record.job!;
        },
        ...filesOf({ ...context, signal }, id),
    };
    const actions = session.controls ? makeActions(jobContext, taken) : null;
    if (actions !== null) {
        header.actions.append(actions.element);
    }

    function draw(): void {
        timer = 0;
        const { job } = record;
        if (signal.aborted || job === null) {
            return;
        }
        if (loading.isConnected) {
            container.replaceChildren(header.element, tabs.element, body);
        }
        header.update(job);
        actions?.update();
        const name = job.name === '' ? job.jobId : job.name;
        context.title(hasEnded(job.state) ? name : `${percentText(job.progress)} ${name}`);
        if (opened !== chosen) {
            void openSection(chosen);
        }
        section?.update();
    }
    const changed = (): void => {
        timer ||= window.setTimeout(draw, DRAW_EVERY_MS);
    };

    function taken(job: Job): void {
        if (record.snapshot(job)) {
            changed();
        }
        polling.now();
    }

    async function openSection(name: JobSection): Promise<void> {
        opened = name;
        stopSection.abort();
        section?.destroy?.();
        section = null;
        stopSection = new AbortController();
        const ofSection = AbortSignal.any([signal, stopSection.signal]);
        tabs.mark(name);
        body.replaceChildren(h('p', { class: 'loading', role: 'status' }, 'Loading …'));
        try {
            const { open } = await SECTIONS[name]();
            if (!ofSection.aborted) {
                const content = h('div', { class: 'section' });
                body.replaceChildren(h('h2', { class: 'unseen' }, capital(name)), content);
                // Getters would be copied as values.
                const inner = Object.create(jobContext, { signal: { value: ofSection } }) as JobContext;
                section = open(content, inner);
            }
        } catch (error) {
            if (!ofSection.aborted) {
                const again = h('button', { type: 'button', onclick: () => void openSection(name) }, 'Try again');
                body.replaceChildren(problem('This section cannot be opened', faultOf(error).message, again));
            }
        }
    }

    const failed = (fault: Fault): void => {
        if (signal.aborted || (fault.kind !== 'refused' && fault.kind !== 'unknown call')) {
            return;
        }
        if (record.job !== null && !FINAL_REASONS.has(fault.reason)) {
            // Such as a limit of calls. The next round may succeed.
            context.say(fault.message);
            return;
        }
        const isMissing = fault.reason === 'JOB_NOT_FOUND' || fault.reason === 'BAD_ARGUMENT';
        const back = h('a', { href: jobsLink(), class: 'button' }, 'All jobs');
        const title = isMissing ? 'Job not found' : 'The job cannot be shown';
        const text = isMissing ? 'There is no such job, or it belongs to another tenant. It may have been deleted.' : fault.message;
        gone.abort();
        container.replaceChildren(problemPage(title, text, back));
        context.title(title);
    };

    const watch = async (): Promise<void> => {
        isFollowing = true;
        try {
            await follow(
                {
                    open: (ended) => session.api.jobs.watchJob({ jobId: id, afterSeq: record.lastSeq }, { signal: ended, ...NO_LIMIT }),
                    onItem: (event) => {
                        const isNew = event.seq > (record.job?.lastSeq ?? 0n);
                        if (record.apply(event)) {
                            changed();
                        }
                        // What the job waits for, and when it ended, are in snapshots only.
                        if (isNew && event.event.case === 'jobState') {
                            polling.now();
                        }
                    },
                    faultOf: (error) => session.api.noted(error),
                    isComplete: () => record.job !== null && hasEnded(record.job.state),
                    visibility: VISIBILITY,
                },
                signal,
            );
        } catch (error) {
            failed(faultOf(error));
        }
        isFollowing = false;
    };

    const every = (): number => {
        const { job } = record;
        return job !== null && (hasEnded(job.state) || job.tasks.length > MANY_TASKS) ? SELDOM_MS : EVERY_MS;
    };
    const polling = poll(every, signal, async () => {
        try {
            const job = await session.api.jobs.getJob({ jobId: id }, { signal });
            if (record.snapshot(job)) {
                changed();
            }
            // An ended job has no further events, unless it is retried.
            if (!isFollowing && (!hasEnded(job.state) || record.events.length === 0)) {
                void watch();
            }
        } catch (error) {
            failed(faultOf(error));
        }
    }, HIDDEN_EVERY_MS);

    signal.addEventListener('abort', () => {
        clearTimeout(timer);
        section?.destroy?.();
    });
    return {
        section: (name) => {
            chosen = name;
            changed();
        },
    };
}
