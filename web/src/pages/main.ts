// The pages of a service: who uses them, and which one is shown.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import type { Caller } from '../rpc/fathom/admin/v1/admin_pb.ts';
import { Connection, Backoff } from './connection.ts';
import { type Context, problemPage } from './context.ts';
import { freshId, h, setAttribute, setText } from './dom.ts';
import { type Fault, faultOf } from './faults.ts';
import { timeText } from './format.ts';
import type { JobPage } from './job/index.ts';
import { showJobs } from './jobs.ts';
import { DATASETS_LINK, type Route, jobLink, jobsLink, readRoute, serviceLink } from './route.ts';
import type { ServicePage } from './service/index.ts';
import { INVITATION_REFUSED, Session, WORKER_TOKEN, tokenOfAddress } from './session.ts';
import { capital, roleWord } from './words.ts';
import './pages.css';

/** How long a message is shown, milliseconds. */
const MESSAGE_MS = 8000;
const NOT_ACCEPTED =
    'The service does not accept this token. It may be mistyped, expired or revoked. Ask an operator of the service for another one.';

const root = document.querySelector<HTMLElement>('#page')!;
const connection = new Connection();
const session = new Session(new URL('.', location.href.split('#')[0]!).href, connection);

const banner = h('div', { class: 'banner', role: 'status' });
connection.listen((isLost) => setText(banner, isLost ? 'Connection lost; trying again …' : ''));
const message = h('div', { class: 'message', role: 'status' });
let messageTimer = 0;
function say(text: string): void {
    message.textContent = text;
    clearTimeout(messageTimer);
    messageTimer = window.setTimeout(() => (message.textContent = ''), MESSAGE_MS);
}

/** Ends what is shown. */
let stop = new AbortController();
function start(): AbortSignal {
    stop.abort();
    stop = new AbortController();
    return stop.signal;
}

// Sign in

function showSignIn(error: string): void {
    start();
    document.title = 'Sign in · Fathom';
    const [fieldId, errorId] = [freshId(), freshId()];
    const field = h('input', {
        id: fieldId,
        type: 'password',
        required: true,
        autocomplete: 'off',
        spellcheck: 'false',
        'aria-describedby': errorId,
    });
    const alert = h('p', { class: 'alert bad', role: 'alert', id: errorId }, error);
    alert.hidden = error === '';
    const button = h('button', { type: 'submit', class: 'primary' }, 'Sign in');
    const form = h(
        'form',
        { class: 'card sign-in' },
        h('h1', {}, 'Sign in'),
        h('p', {}, 'This service asks for a token. Operators issue tokens.'),
        h('div', { class: 'field' }, h('label', { for: fieldId }, 'Token'), field),
        alert,
        button,
        h('p', { class: 'soft' }, 'The token is kept until you close this tab or sign out.'),
    );
    form.addEventListener('submit', (event) => {
        event.preventDefault();
        void (async () => {
            button.disabled = true;
            session.use(field.value.trim());
            try {
                await session.identify();
                showPages();
            } catch (thrown) {
                const fault = faultOf(thrown);
                session.forget();
                alert.textContent = fault.kind === 'token' ? NOT_ACCEPTED : fault.message;
                alert.hidden = false;
                setAttribute(field, 'aria-invalid', 'true');
                button.disabled = false;
                field.focus();
                field.select();
            }
        })();
    });
    root.replaceChildren(h('header', { class: 'top' }, h('span', { class: 'brand' }, 'Fathom')), banner, h('main', { class: 'narrow' }, form), message);
    field.focus();
}

session.onRefused = () => showSignIn('You are signed out: the token has expired or was revoked. Sign in with another one.');

// The frame of all pages

function describe(caller: Caller): string {
    if (!caller.tokensRequired) {
        return '';
    }
    const until = caller.expireTime === undefined ? '' : `, until ${timeText(timestampMs(caller.expireTime))}`;
    if (caller.jobId !== '') {
        return `Shared job, read only${until}`;
    }
    const tenant = caller.tenant === '' ? '' : ` of ${caller.tenant}`;
    return `${caller.name === '' ? '' : `${caller.name}, `}${roleWord(caller.role)}${tenant}`;
}

let main = h('main');
const links = {
    jobs: h('a', { href: jobsLink() }, 'Jobs'),
    datasets: h('a', { href: DATASETS_LINK }, 'Datasets'),
    service: h('a', { href: serviceLink() }, 'Service'),
};

function showPages(): void {
    const { caller } = session;
    // A shared link shows its job and has no list.
    links.jobs.hidden = caller.jobId !== '';
    links.datasets.hidden = caller.jobId !== '';
    links.service.hidden = !session.operates;
    const signOut = h('button', { type: 'button', hidden: !caller.tokensRequired }, 'Sign out');
    signOut.addEventListener('click', () => {
        session.forget();
        history.replaceState(history.state, '', jobsLink());
        showSignIn('');
    });
    const skip = h('a', { class: 'skip', href: '#main' }, 'Skip to the content');
    skip.addEventListener('click', (event) => {
        // The fragment of the address is that of the page.
        event.preventDefault();
        focusTitle();
    });
    main = h('main', { id: 'main', tabindex: -1 });
    root.replaceChildren(
        skip,
        h(
            'header',
            { class: 'top' },
            h('a', { class: 'brand', href: caller.jobId === '' ? jobsLink() : jobLink(caller.jobId) }, 'Fathom'),
            h('nav', { class: 'row', 'aria-label': 'Pages' }, links.jobs, links.datasets, links.service),
            h('span', { class: 'who' }, describe(caller)),
            signOut,
        ),
        banner,
        main,
        message,
    );
    shown = null;
    show(false);
}

function title(text: string): void {
    document.title = `${text} · Fathom`;
}

function focusTitle(): void {
    // A page that is still loading has no title.
    (main.querySelector<HTMLElement>('h1') ?? main).focus();
}

// Which page

let shown: { readonly route: Route; readonly page: JobPage | ServicePage | null } | null = null;

/** The route of the address, or the one that this caller may see. */
function routeNow(): Route {
    const route = readRoute(location.hash);
    const { jobId } = session.caller;
    if (jobId !== '' && !(route.page === 'job' && route.id === jobId)) {
        history.replaceState(history.state, '', jobLink(jobId));
        return { page: 'job', id: jobId, section: 'overview' };
    }
    return route;
}

function show(byUser: boolean): void {
    const route = routeNow();
    setAttribute(links.jobs, 'aria-current', route.page === 'jobs' ? 'page' : null);
    setAttribute(links.datasets, 'aria-current', route.page === 'datasets' ? 'page' : null);
    setAttribute(links.service, 'aria-current', route.page === 'service' ? 'page' : null);
    const before = shown;
    if (route.page === 'job' && before?.route.page === 'job' && before.route.id === route.id && before.page !== null) {
        (before.page as JobPage).section(route.section);
        shown = { route, page: before.page };
        return;
    }
    if (route.page === 'service' && before?.route.page === 'service' && before.page !== null) {
        (before.page as ServicePage).section(route.section);
        shown = { route, page: before.page };
        return;
    }
    const signal = start();
    const container = h('div', { class: 'page' });
    main.replaceChildren(container);
    window.scrollTo(0, 0);
    const context: Context = { session, connection, signal, title, say };
    shown = { route, page: null };
    if (route.page === 'jobs') {
        showJobs(container, context, route.filter);
    } else if (route.page === 'job') {
        const { id } = route;
        void loaded(signal, container, () => import('./job/index.ts'), ({ showJob }) => {
            // The section may have changed meanwhile.
            const now = readRoute(location.hash);
            const section = now.page === 'job' && now.id === id ? now.section : route.section;
            shown = { route: now, page: showJob(container, context, id, section) };
        });
    } else if (route.page === 'new' && session.controls) {
        void loaded(signal, container, () => import('./new-job.ts'), ({ showNewJob }) => showNewJob(container, context, route.dataset));
    } else if (route.page === 'datasets') {
        void loaded(signal, container, () => import('./datasets.ts'), ({ showDatasets }) => showDatasets(container, context));
    } else if (route.page === 'service' && session.operates) {
        void loaded(signal, container, () => import('./service/index.ts'), ({ showService }) => {
            const now = readRoute(location.hash);
            shown = { route: now, page: showService(container, context, now.page === 'service' ? now.section : route.section) };
        });
    } else {
        const refused: Readonly<Record<string, string>> = {
            service: 'Only operators of all tenants see the service.',
            new: 'Only submitters and operators create jobs.',
        };
        title('Not found');
        const back = h('a', { href: jobsLink(), class: 'button' }, 'All jobs');
        container.append(
            problemPage('There is no such page', refused[route.page] ?? 'The address may be mistyped.', back),
        );
    }
    if (byUser) {
        focusTitle();
    }
}

/**
 * A link with nothing but a token or an invitation, such as that of `fathom train --web`, leads to the job if
 * there is only one. If there is none yet, the list of jobs waits for it.
 */
async function toOnlyJob(): Promise<void> {
    if (session.isBareLink && session.caller.jobId === '') {
        const { jobs } = await session.api.jobs.listJobs({ pageSize: 2 });
        session.isBareLink = jobs.length === 0;
        if (jobs.length === 1) {
            history.replaceState(history.state, '', jobLink(jobs[0]!.jobId));
        }
    }
}

/** Fetches a part of the program, and says so when it cannot. */
async function loaded<M>(signal: AbortSignal, container: HTMLElement, fetchModule: () => Promise<M>, then: (module: M) => void): Promise<void> {
    try {
        const module = await fetchModule();
        if (!signal.aborted) {
            then(module);
        }
    } catch (error) {
        if (!signal.aborted) {
            const again = h('button', { type: 'button', onclick: () => location.reload() }, 'Reload the page');
            container.replaceChildren(problemPage('The page cannot be loaded', `${faultOf(error).message} The service may have been updated.`, again));
        }
    }
}

window.addEventListener('hashchange', () => {
    const taken = tokenOfAddress();
    if (taken !== null) {
        session.take(taken);
        void begin();
    } else if (main.isConnected) {
        show(true);
    }
});

async function begin(): Promise<void> {
    const signal = start();
    root.replaceChildren(banner, h('p', { class: 'loading', role: 'status' }, 'Loading …'));
    const backoff = new Backoff();
    for (let isFirst = true; ; isFirst = false) {
        try {
            await session.identify();
            await toOnlyJob();
            if (!signal.aborted) {
                showPages();
            }
            return;
        } catch (error) {
            const fault = faultOf(error);
            if (signal.aborted) {
                return;
            }
            if (fault.kind !== 'lost') {
                refuse(fault);
                return;
            }
            if (isFirst) {
                root.replaceChildren(banner, h('main', { class: 'narrow' }, problemPage('The service does not answer', 'This page tries again by itself.')));
            }
            await new Promise((resolve) => setTimeout(resolve, backoff.next()));
        }
    }
}

function refuse(fault: Fault): void {
    const hadToken = session.token() !== null;
    if (fault.kind === 'token' || fault.reason === WORKER_TOKEN) {
        session.forget();
        const isSaid = fault.kind !== 'token' || fault.reason === INVITATION_REFUSED;
        showSignIn(isSaid ? fault.message : hadToken ? NOT_ACCEPTED : '');
        return;
    }
    const again = h('button', { type: 'button', onclick: () => void begin() }, 'Try again');
    root.replaceChildren(h('main', { class: 'narrow' }, problemPage('The pages cannot be shown', capital(fault.message), again)));
}

await begin();
