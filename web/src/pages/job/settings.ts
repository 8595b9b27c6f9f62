// The settings with which a job runs.

import { h } from '../dom.ts';
import { capital } from '../words.ts';
import { save } from './files.ts';
import type { JobContext, Section } from './section.ts';

type Json = null | boolean | number | string | readonly Json[] | { readonly [key: string]: Json };

const isGroup = (value: Json): value is { readonly [key: string]: Json } =>
    typeof value === 'object' && value !== null && !Array.isArray(value);

/** A value as a person writes it. */
export function valueText(value: Json): string {
    if (value === null) {
        return 'not set';
    }
    if (typeof value === 'boolean') {
        return value ? 'yes' : 'no';
    }
    return typeof value === 'string' ? value : JSON.stringify(value);
}

/** All values of a group with their dotted keys. */
export function flattened(group: { readonly [key: string]: Json }, before = ''): readonly (readonly [string, string])[] {
    return Object.entries(group).flatMap(([key, value]) =>
        isGroup(value) ? flattened(value, `${before}${key}.`) : [[`${before}${key}`, valueText(value)] as const],
    );
}

function list(name: string, values: readonly (readonly [string, string])[]): HTMLElement {
    const rows = values.map(([key, value]) => h('div', {}, h('dt', { class: 'mono' }, key), h('dd', {}, value)));
    return h('section', { class: 'card' }, h('h2', {}, name), h('dl', { class: 'settings' }, ...rows));
}

export function open(container: HTMLElement, context: JobContext): Section {
    const text = context.job.configJson;
    let config: Json = null;
    try {
        config = JSON.parse(text) as Json;
    } catch {
        // Shown as it is.
    }
    if (config === null || !isGroup(config)) {
        container.append(h('pre', { class: 'card mono', tabindex: 0 }, text));
        return { update: () => {} };
    }
    const entries = Object.entries(config);
    const single = entries.filter(([, value]) => !isGroup(value));
    const groups = entries.filter(([, value]) => isGroup(value));
    const saveAll = (): void => {
        const pretty = JSON.stringify(config, null, 2);
        save(new Blob([pretty, '\n'], { type: 'application/json' }), `${context.job.name || context.id}.settings.json`);
    };
    container.append(
        h(
            'div',
            { class: 'row between' },
            h('p', { class: 'soft' }, 'All settings with which this job runs. They cannot be changed while it runs.'),
            h('button', { type: 'button', onclick: saveAll }, 'Save as JSON'),
        ),
        h(
            'div',
            { class: 'groups' },
            single.length === 0 ? null : list('General', flattened(Object.fromEntries(single))),
            ...groups.map(([name, values]) => list(capital(name), isGroup(values) ? flattened(values) : [])),
        ),
    );
    return { update: () => {} };
}
