// The list of jobs.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import { type Job, JobState } from '../rpc/fathom/v1/job_pb.ts';
import { type Context, problemOf } from './context.ts';
import { commandField } from './commands.ts';
import { type Column, Table, chip, freshId, h, only, progressBar, setAttribute, setText } from './dom.ts';
import { faultOf } from './faults.ts';
import { durationText, percentText, timeText } from './format.ts';
import { poll } from './poll.ts';
import { type JobFilter, jobLink, jobsLink, newJobLink } from './route.ts';
import type { Session } from './session.ts';
import { Thumbnails } from './thumbnails.ts';
import { STATES_BY_WORD, capital, hasEnded, shownState, stageLabel } from './words.ts';

const PAGE_SIZE = 50;
const EVERY_MS = 3000;
const TYPING_MS = 250;
/** Only GetJob says how long a job will train. So many of the page are asked, no more often than this. */
const MOST_ASKED = 6;
const ASK_EVERY_MS = 10_000;

const bars = new WeakMap<HTMLElement, ReturnType<typeof progressBar>>();

function showName(cell: HTMLElement, job: Job, thumbnails: Thumbnails): void {
    const box = only(cell, () => h('div', { class: 'with-thumb' }, thumbnails.make(job.jobId), h('a', { href: jobLink(job.jobId) })));
    thumbnails.update(job);
    const link = box.lastElementChild as HTMLElement;
    setText(link, job.name === '' ? job.jobId : job.name);
}

function showProgress(cell: HTMLElement, job: Job): void {
    let bar = bars.get(cell);
    if (bar === undefined) {
        bar = progressBar(`Progress of ${job.name}`);
        bars.set(cell, bar);
        cell.append(h('div', { class: 'progress' }, bar.element, h('span', { class: 'number' })));
    }
    const text = percentText(job.progress);
    bar.set(job.progress, text);
    setAttribute(bar.element, 'data-state', shownState(job));
    setText(cell.querySelector<HTMLElement>('.number')!, text);
}

const showTime = (cell: HTMLElement, ms: number): void => {
    const element = only(cell, () => h('time'));
    setText(element, timeText(ms));
    setAttribute(element, 'datetime', new Date(ms).toISOString());
};

/** Times left of running jobs, asked for one by one. */
class TimesLeft {
    readonly #context: Context;
    readonly #known = new Map<string, { readonly seconds: number | null; readonly askedMs: number }>();

    constructor(context: Context) {
        this.#context = context;
    }

    of(job: Job): string {
        const known = this.#known.get(job.jobId);
        const isRunning = job.state === JobState.RUNNING && job.waitingReason === '';
        return isRunning && known !== undefined && known.seconds !== null ? durationText(known.seconds) : '';
    }

    async ask(jobs: readonly Job[]): Promise<void> {
        const now = Date.now();
        const running = jobs.filter(({ state, waitingReason }) => state === JobState.RUNNING && waitingReason === '');
        const due = running.slice(0, MOST_ASKED).filter(({ jobId }) => now - (this.#known.get(jobId)?.askedMs ?? 0) > ASK_EVERY_MS);
        const { session, signal } = this.#context;
        await Promise.all(
            due.map(async ({ jobId }) => {
                try {
                    const job = await session.api.jobs.getJob({ jobId }, { signal });
                    this.#known.set(jobId, { seconds: job.timeLeftSeconds ?? null, askedMs: now });
                } catch {
                    // The list itself says what is wrong.
                    this.#known.delete(jobId);
                }
            }),
        );
    }
}

/** How to create the first job. */
function howToSubmit(session: Session): HTMLElement {
    if (session.isBareLink) {
        return h(
            'div',
            { class: 'empty' },
            h('h2', {}, 'The run begins'),
            h('p', {}, 'Its page opens by itself as soon as the photographs are read.'),
        );
    }
    return h(
        'div',
        { class: 'empty' },
        h('h2', {}, 'No jobs yet'),
        h('p', {}, 'A job trains one scene from photographs with known cameras. Submit one from a terminal:'),
        commandField(session, 'submit DATA --partitions auto'),
        h(
            'p',
            { class: 'soft' },
            'DATA is a folder with photographs, and with camera poses and sparse points of COLMAP or nerfstudio. The ' +
                'coordinator may have another port. The job appears here by itself.',
        ),
    );
}

export function showJobs(container: HTMLElement, context: Context, first: JobFilter): void {
    const { session, signal } = context;
    context.title('Jobs');
    let filter = first;
    /** Tokens of the pages up to the one that is shown. */
    let tokens: readonly string[] = [''];
    let next = '';

    const [stateId, nameId] = [freshId(), freshId()];
    const states = [['', 'All states'], ...Object.keys(STATES_BY_WORD).map((word) => [word, capital(word)])] as const;
    const state = h(
        'select',
        { id: stateId },
        ...states.map(([value, label]) => h('option', { value: value!, selected: value === filter.state }, label!)),
    );
    const name = h('input', { id: nameId, type: 'search', value: filter.name, maxlength: 100, autocomplete: 'off' });
    const filters = h(
        'form',
        { class: 'filters', role: 'search', 'aria-label': 'Select jobs' },
        h('div', { class: 'field' }, h('label', { for: stateId }, 'State'), state),
        h('div', { class: 'field grow' }, h('label', { for: nameId }, 'Name contains'), name),
    );

    const newJob = session.controls ? h('a', { class: 'button primary', href: newJobLink() }, 'New job') : null;

    const thumbnails = new Thumbnails(context);
    const times = new TimesLeft(context);
    const columns: Column<Job>[] = [
        { title: 'Name', kind: 'name', isHeader: true, show: (cell, job) => showName(cell, job, thumbnails) },
        { title: 'State', kind: 'state', show: (cell, job) => chip(cell, shownState(job), capital(shownState(job))) },
        { title: 'Progress', kind: 'progress-cell', show: showProgress },
        { title: 'Stage', kind: 'stage', show: (cell, job) => setText(cell, hasEnded(job.state) ? '' : stageLabel(job.stage)) },
        { title: 'Time left', kind: 'left', show: (cell, job) => setText(cell, times.of(job)) },
    ];
    if (session.seesTenants) {
        columns.push({ title: 'Tenant', kind: 'tenant', show: (cell, job) => setText(cell, job.tenant) });
    }
    columns.push({
        title: 'Created',
        kind: 'created',
        show: (cell, job) => showTime(cell, job.createTime === undefined ? 0 : timestampMs(job.createTime)),
    });
    const table = new Table<Job>('Jobs', 'jobs', columns, ({ jobId }) => jobId);

    const back = h('button', { type: 'button' }, 'Previous');
    const forth = h('button', { type: 'button' }, 'Next');
    const place = h('span', { class: 'soft', role: 'status' });
    const pager = h('nav', { class: 'pager', 'aria-label': 'Pages of the list', hidden: true }, back, place, forth);
    const content = h('div', { class: 'card flush' }, h('p', { class: 'loading', role: 'status' }, 'Loading jobs …'));
    container.append(
        h('div', { class: 'head' }, h('div', { class: 'row title' }, h('h1', { tabindex: -1 }, 'Jobs'), newJob), filters),
        content,
        pager,
    );

    const show = (jobs: readonly Job[]): void => {
        const isFiltered = filter.state !== '' || filter.name !== '';
        if (jobs.length > 0) {
            table.show(jobs);
            if (table.element.parentElement !== content) {
                content.replaceChildren(table.element);
            }
        } else if (isFiltered) {
            if (content.dataset['shown'] !== 'none') {
                const all = h('button', { type: 'button' }, 'Show all jobs');
                all.addEventListener('click', () => {
                    state.value = '';
                    name.value = '';
                    select();
                });
                content.replaceChildren(
                    h('div', { class: 'empty' }, h('h2', {}, 'No job matches'), h('p', {}, 'Choose another state or name.'), all),
                );
            }
        } else if (content.dataset['shown'] !== 'empty') {
            content.replaceChildren(howToSubmit(session));
        }
        content.dataset['shown'] = jobs.length > 0 ? 'jobs' : isFiltered ? 'none' : 'empty';
        filters.hidden = jobs.length === 0 && !isFiltered;
        pager.hidden = tokens.length === 1 && next === '';
        back.disabled = tokens.length === 1;
        forth.disabled = next === '';
        const begin = (tokens.length - 1) * PAGE_SIZE;
        setText(place, `${begin + 1} to ${begin + jobs.length}`);
    };

    const polling = poll(() => EVERY_MS, signal, async () => {
        const [asked, askedFilter] = [tokens, filter];
        try {
            const chosen = STATES_BY_WORD[filter.state];
            const page = await session.api.jobs.listJobs(
                {
                    pageSize: PAGE_SIZE,
                    pageToken: asked.at(-1) ?? '',
                    states: chosen === undefined ? [] : [chosen],
                    nameContains: filter.name,
                },
                { signal },
            );
            if (asked !== tokens || askedFilter !== filter) {
                return;
            }
            next = page.nextPageToken;
            if (session.isBareLink && page.jobs.length > 0) {
                session.isBareLink = false;
                location.replace(jobLink(page.jobs[0]!.jobId));
                return;
            }
            show(page.jobs);
            await times.ask(page.jobs);
            if (asked === tokens && askedFilter === filter && page.jobs.length > 0) {
                show(page.jobs);
            }
        } catch (error) {
            const shown = problemOf('The jobs cannot be listed', faultOf(error));
            if (shown !== null) {
                content.replaceChildren(shown);
                content.dataset['shown'] = 'fault';
            }
        }
    });

    function select(): void {
        if (signal.aborted) {
            return;
        }
        filter = { state: state.value, name: name.value.trim() };
        tokens = [''];
        history.replaceState(history.state, '', jobsLink(filter));
        polling.now();
    }
    let typing = 0;
    state.addEventListener('change', select);
    name.addEventListener('input', () => {
        clearTimeout(typing);
        typing = window.setTimeout(select, TYPING_MS);
    });
    filters.addEventListener('submit', (event) => {
        event.preventDefault();
        clearTimeout(typing);
        select();
    });
    forth.addEventListener('click', () => {
        tokens = [...tokens, next];
        polling.now();
    });
    back.addEventListener('click', () => {
        tokens = tokens.slice(0, -1);
        polling.now();
    });
}
