// The service itself, for operators of all tenants.

import type { Context } from '../context.ts';
import { h, setAttribute } from '../dom.ts';
import { SERVICE_SECTIONS, type ServiceSection, serviceLink } from '../route.ts';
import { capital } from '../words.ts';
import { showQueue } from './queue.ts';
import { showTenants } from './tenants.ts';
import { showTokens } from './tokens.ts';
import { showWorkers } from './workers.ts';

export interface ServicePage {
    section(section: ServiceSection): void;
}

const SECTIONS: Readonly<Record<ServiceSection, (container: HTMLElement, context: Context) => void>> = {
    workers: showWorkers,
    queue: showQueue,
    tenants: showTenants,
    tokens: showTokens,
};

export function showService(container: HTMLElement, context: Context, first: ServiceSection): ServicePage {
    const links = SERVICE_SECTIONS.map((section) => h('a', { href: serviceLink(section) }, capital(section)));
    const body = h('div', { class: 'section' });
    const version = context.session.caller.buildVersion;
    container.append(
        h(
            'div',
            { class: 'head' },
            h('h1', { tabindex: -1 }, 'Service'),
            h('p', { class: 'soft' }, version === '' ? '' : `Coordinator ${version}`),
        ),
        h('nav', { class: 'tabs', 'aria-label': 'Sections of the service' }, ...links),
        body,
    );
    let stop = new AbortController();
    const open = (section: ServiceSection): void => {
        stop.abort();
        stop = new AbortController();
        const signal = AbortSignal.any([context.signal, stop.signal]);
        SERVICE_SECTIONS.forEach((one, index) => setAttribute(links[index]!, 'aria-current', one === section ? 'page' : null));
        body.replaceChildren();
        context.title(capital(section));
        SECTIONS[section](body, { ...context, signal });
    };
    open(first);
    return { section: open };
}
