// The tenants of a service: what they use, and their limits.

import type { Tenant } from '../../rpc/fathom/admin/v1/admin_pb.ts';
import { type Context, problemOf } from '../context.ts';
import { ask } from '../dialog.ts';
import { Table, h, only, progressBar, setText } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { bytesText, countText } from '../format.ts';
import { poll } from '../poll.ts';

const EVERY_MS = 5000;
const GB = 1e9;

const usages = new WeakMap<HTMLElement, ReturnType<typeof progressBar>>();

/** What is used of a limit; 0 is no limit. */
function showUsage(cell: HTMLElement, label: string, used: number, limit: number, text: (value: number) => string): void {
    let bar = usages.get(cell);
    if (bar === undefined) {
        bar = progressBar(label);
        usages.set(cell, bar);
        cell.append(h('div', { class: 'usage' }, h('span', { class: 'number' }), bar.element));
    }
    const words = limit === 0 ? text(used) : `${text(used)} of ${text(limit)}`;
    setText(cell.querySelector<HTMLElement>('.number')!, words);
    bar.element.hidden = limit === 0;
    bar.set(limit === 0 ? 0 : used / limit, words);
    bar.element.dataset['state'] = used >= limit ? 'failed' : 'running';
}

const limitField = (label: string, value: number) => ({ kind: 'number', label, value, minimum: 0, maximum: 4_000_000_000 }) as const;

async function setLimits(context: Context, tenant: Tenant, changed: () => void): Promise<void> {
    const { quota } = tenant;
    await ask({
        title: `Limits of ${tenant.name}`,
        text: '0 sets no limit.',
        fields: {
            jobs: limitField('Jobs that have not ended', quota?.maxOpenJobs ?? 0),
            tasks: limitField('Tasks at a time', quota?.maxParallel ?? 0),
            bytes: limitField('Storage, GB', Math.round(Number(quota?.maxBytes ?? 0n) / GB)),
        },
        action: 'Save',
        act: async ({ jobs, tasks, bytes }) => {
            const changedQuota = { maxOpenJobs: Number(jobs), maxParallel: Number(tasks), maxBytes: BigInt(bytes) * BigInt(GB) };
            await context.session.api.admin.setQuota({ tenant: tenant.name, quota: changedQuota });
            changed();
            return null;
        },
    });
}

export function showTenants(container: HTMLElement, context: Context): void {
    const { session, signal } = context;
    const current = new Map<string, Tenant>();
    const table = new Table<Tenant>(
        'Tenants',
        'tenants',
        [
            { title: 'Tenant', kind: 'name', isHeader: true, show: (cell, { name }) => setText(cell, name) },
            { title: 'Open jobs', show: (cell, { name, openJobs, quota }) => showUsage(cell, `Open jobs of ${name}`, openJobs, quota?.maxOpenJobs ?? 0, countText) },
            { title: 'Running tasks', show: (cell, { name, leasedTasks, quota }) => showUsage(cell, `Running tasks of ${name}`, leasedTasks, quota?.maxParallel ?? 0, countText) },
            { title: 'Storage', show: (cell, { name, bytes, quota }) => showUsage(cell, `Storage of ${name}`, Number(bytes), Number(quota?.maxBytes ?? 0n), bytesText) },
            { title: 'Limits', show: (cell, { quotaIsOwn }) => setText(cell, quotaIsOwn ? 'its own' : 'default') },
            {
                title: 'Actions',
                kind: 'act',
                show: (cell, tenant) => {
                    const { name } = tenant;
                    const change = (): void => void setLimits(context, current.get(name) ?? tenant, () => polling.now());
                    only(cell, () => h('button', { type: 'button', 'aria-label': `Change limits of ${name}`, onclick: change }, 'Change limits'));
                },
            },
        ],
        ({ name }) => name,
    );
    const content = h('div', { class: 'card flush' }, h('p', { class: 'loading', role: 'status' }, 'Loading the tenants …'));
    container.append(content);
    const polling = poll(() => EVERY_MS, signal, async () => {
        try {
            const { tenants } = await session.api.admin.listTenants({}, { signal });
            tenants.forEach((tenant) => current.set(tenant.name, tenant));
            if (tenants.length === 0) {
                content.replaceChildren(h('div', { class: 'empty' }, h('h2', {}, 'No tenants'), h('p', {}, 'A tenant appears with its first token or job.')));
                return;
            }
            table.show(tenants);
            if (table.element.parentElement !== content) {
                content.replaceChildren(table.element);
            }
        } catch (error) {
            const shown = problemOf('The tenants cannot be listed', faultOf(error));
            if (shown !== null) {
                content.replaceChildren(shown);
            }
        }
    });
}
