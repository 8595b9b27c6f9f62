// The addresses of the pages. They are in the fragment, so the server sees neither them nor a token in a
// link.

export const JOB_SECTIONS = [
    'overview',
    'curves',
    'views',
    'water',
    'seams',
    'log',
    'files',
    'settings',
    'viewer',
] as const;
export type JobSection = (typeof JOB_SECTIONS)[number];
export const SERVICE_SECTIONS = ['workers', 'queue', 'tenants', 'tokens'] as const;
export type ServiceSection = (typeof SERVICE_SECTIONS)[number];

/** Which jobs the list shows. */
export interface JobFilter {
    /** A state in a word, or empty for all. */
    readonly state: string;
    /** A part of the name. */
    readonly name: string;
}

export type Route =
    | { readonly page: 'jobs'; readonly filter: JobFilter }
    | { readonly page: 'job'; readonly id: string; readonly section: JobSection }
    | { readonly page: 'new'; readonly dataset: string }
    | { readonly page: 'datasets' }
    | { readonly page: 'service'; readonly section: ServiceSection }
    | { readonly page: 'unknown' };

const decoded = (text: string): string => {
    try {
        return decodeURIComponent(text);
    } catch {
        return text;
    }
};

const among = <T extends string>(all: readonly T[], word: string): T | undefined => all.find((one) => one === word);

/** The route of a fragment, with or without `#`. An empty one is the list of jobs. */
export function readRoute(fragment: string): Route {
    const [path = '', query = ''] = fragment.replace(/^#/, '').split('?', 2);
    const [, page = '', first = '', second = '', ...rest] = path.split('/');
    const asked = new URLSearchParams(query);
    if (page === '' && first === '') {
        return { page: 'jobs', filter: { state: '', name: '' } };
    }
    if (rest.length > 0) {
        return { page: 'unknown' };
    }
    if (page === 'jobs' && first === '') {
        return { page: 'jobs', filter: { state: asked.get('state') ?? '', name: asked.get('name') ?? '' } };
    }
    if (page === 'jobs') {
        const section = second === '' ? 'overview' : among(JOB_SECTIONS, second);
        return section === undefined ? { page: 'unknown' } : { page: 'job', id: decoded(first), section };
    }
    if (page === 'new' && first === '') {
        return { page: 'new', dataset: asked.get('dataset') ?? '' };
    }
    if (page === 'datasets' && first === '') {
        return { page: 'datasets' };
    }
    if (page === 'service' && second === '') {
        const section = first === '' ? 'workers' : among(SERVICE_SECTIONS, first);
        return section === undefined ? { page: 'unknown' } : { page: 'service', section };
    }
    return { page: 'unknown' };
}

export function jobsLink(filter: JobFilter = { state: '', name: '' }): string {
    const asked = new URLSearchParams();
    if (filter.state !== '') {
        asked.set('state', filter.state);
    }
    if (filter.name !== '') {
        asked.set('name', filter.name);
    }
    return asked.size === 0 ? '#/jobs' : `#/jobs?${asked.toString()}`;
}

export const jobLink = (id: string, section: JobSection = 'overview'): string =>
    `#/jobs/${encodeURIComponent(id)}${section === 'overview' ? '' : `/${section}`}`;

export const serviceLink = (section: ServiceSection = 'workers'): string =>
    section === 'workers' ? '#/service' : `#/service/${section}`;

/** The form for a new job, of a dataset or without a choice. */
export const newJobLink = (dataset = ''): string => (dataset === '' ? '#/new' : `#/new?dataset=${encodeURIComponent(dataset)}`);

export const DATASETS_LINK = '#/datasets';

/** The address of a job's page, for somebody who needs no token. */
export const pageOfJob = (page: string, job: string): string => `${page}${jobLink(job)}`;

/** A link that carries a token, for a colleague. */
export const shareLink = (page: string, job: string, token: string): string =>
    `${page}#/jobs/${encodeURIComponent(job)}?token=${encodeURIComponent(token)}`;

export interface TakenToken {
    readonly token: string;
    /** Whether it is an invitation: valid once, and to be exchanged for a token. */
    readonly isInvitation: boolean;
    /** The fragment without it. */
    readonly rest: string;
    /** Whether the link names no page: it leads to the only job, or to the list of them. */
    readonly isBare: boolean;
}

/**
 * The token or invitation that a fragment carries, and the fragment without it. Two forms are read:
 * `#/jobs/ID?token=...` and `#token=...&job=ID`, each also with `invitation`.
 */
export function takeToken(fragment: string): TakenToken | null {
    const text = fragment.replace(/^#/, '');
    const isPath = text.startsWith('/');
    const [path = '', query = ''] = isPath ? text.split('?', 2) : ['', text];
    const asked = new URLSearchParams(query);
    const invitation = asked.get('invitation')?.trim() ?? '';
    const isInvitation = invitation !== '';
    const token = isInvitation ? invitation : (asked.get('token')?.trim() ?? '');
    if (token === '') {
        return null;
    }
    if (!isPath) {
        const job = asked.get('job') ?? '';
        return { token, isInvitation, rest: job === '' ? jobsLink() : jobLink(job), isBare: job === '' };
    }
    // Both are removed, so that neither stays in the address.
    asked.delete('invitation');
    asked.delete('token');
    const rest = `#${path}${asked.size === 0 ? '' : `?${asked.toString()}`}`;
    return { token, isInvitation, rest, isBare: false };
}
