// The tokens of a service: list, issue, revoke.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import { Role, type Token } from '../../rpc/fathom/admin/v1/admin_pb.ts';
import { type Context, problemOf } from '../context.ts';
import { ask } from '../dialog.ts';
import { Table, chip, copyField, h, only, setText } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { timeText } from '../format.ts';
import { poll } from '../poll.ts';
import { capital, roleWord } from '../words.ts';

const EVERY_MS = 5000;
const DAY = 86_400;
const ROLES: Readonly<Record<string, Role>> = {
    viewer: Role.VIEWER,
    submitter: Role.SUBMITTER,
    operator: Role.OPERATOR,
    worker: Role.WORKER,
};
const ROLE_OPTIONS = [
    ['viewer', 'Viewer: sees jobs and downloads files'],
    ['submitter', 'Submitter: also creates and controls jobs'],
    ['operator', 'Operator: all actions of people'],
    ['worker', 'Worker: takes tasks'],
] as const;
const EXPIRIES = [
    ['0', 'Never'],
    [String(DAY), 'In 1 day'],
    [String(7 * DAY), 'In 1 week'],
    [String(30 * DAY), 'In 30 days'],
    [String(90 * DAY), 'In 90 days'],
    [String(365 * DAY), 'In 1 year'],
] as const;

export type TokenState = 'valid' | 'expired' | 'revoked';

export function tokenState(token: Token, nowMs: number): TokenState {
    if (token.revokeTime !== undefined) {
        return 'revoked';
    }
    return token.expireTime !== undefined && timestampMs(token.expireTime) <= nowMs ? 'expired' : 'valid';
}

async function issue(context: Context, changed: () => void): Promise<void> {
    await ask({
        title: 'Issue a token',
        fields: {
            name: { kind: 'text', label: 'Name of its holder, or its purpose', maximum: 100, isRequired: true },
            role: { kind: 'choice', label: 'Role', value: 'viewer', options: ROLE_OPTIONS },
            tenant: {
                kind: 'text',
                label: 'Tenant',
                maximum: 40,
                hint: 'Required for viewers and submitters. Empty: an operator or a worker of all tenants.',
            },
            expires: { kind: 'choice', label: 'It expires', value: '0', options: EXPIRIES },
        },
        action: 'Issue',
        act: async ({ name, role, tenant, expires }) => {
            const request = { name, role: ROLES[role] ?? Role.VIEWER, tenant, expiresInSeconds: BigInt(expires) };
            const { secret, token } = await context.session.api.admin.issueToken(request);
            changed();
            return h(
                'div',
                {},
                copyField('Token', secret),
                h('p', {}, `This is the token of "${name}". It is shown only once: copy it now.`),
                token === undefined ? null : h('p', { class: 'soft' }, `Its id is ${token.tokenId}.`),
            );
        },
    });
}

async function revoke(context: Context, token: Token, changed: () => void): Promise<void> {
    const { admin } = context.session.api;
    let isLast = false;
    await ask({
        title: 'Revoke this token?',
        text: `"${token.name}" (${roleWord(token.role)}) loses access at once, and everything opened with it ends.`,
        action: 'Revoke',
        dismiss: 'Keep it',
        isDangerous: true,
        act: async () => {
            try {
                await admin.revokeToken({ tokenId: token.tokenId });
            } catch (error) {
                const fault = faultOf(error);
                if (fault.reason !== 'LAST_OPERATOR') {
                    throw fault;
                }
                isLast = true;
            }
            changed();
            return null;
        },
    });
    if (isLast) {
        await ask({
            title: 'This is the last operator',
            text:
                `"${token.name}" is the last token of an operator of all tenants. Without it, nobody can issue a token over the network; ` +
                'one must then be made in the data directory while the coordinator is stopped. Better issue another one first.',
            action: 'Revoke it all the same',
            dismiss: 'Keep it',
            isDangerous: true,
            act: async () => {
                await admin.revokeToken({ tokenId: token.tokenId, evenLast: true });
                changed();
                return null;
            },
        });
    }
}

export function showTokens(container: HTMLElement, context: Context): void {
    const { session, signal } = context;
    const table = new Table<Token>(
        'Tokens',
        'tokens',
        [
            {
                title: 'Name',
                kind: 'name',
                isHeader: true,
                show: (cell, { name, tokenId }) => void only(cell, () => h('div', {}, name, h('div', { class: 'soft mono' }, tokenId))),
            },
            { title: 'Role', show: (cell, { role, jobId }) => setText(cell, jobId === '' ? capital(roleWord(role)) : 'Link to one job') },
            { title: 'Tenant', show: (cell, { tenant }) => setText(cell, tenant === '' ? 'all' : tenant) },
            { title: 'Issued', kind: 'number', show: (cell, { createTime }) => setText(cell, createTime === undefined ? '' : timeText(timestampMs(createTime))) },
            { title: 'Expires', kind: 'number', show: (cell, { expireTime }) => setText(cell, expireTime === undefined ? 'never' : timeText(timestampMs(expireTime))) },
            {
                title: 'State',
                kind: 'state',
                show: (cell, token) => {
                    const state = tokenState(token, Date.now());
                    chip(cell, state, capital(state));
                },
            },
            {
                title: 'Actions',
                kind: 'act',
                show: (cell, token) => {
                    const run = (): void => void revoke(context, token, () => polling.now());
                    const button = only(cell, () => h('button', { type: 'button', class: 'danger', 'aria-label': `Revoke ${token.name}`, onclick: run }, 'Revoke'));
                    button.hidden = token.revokeTime !== undefined;
                },
            },
        ],
        ({ tokenId }) => tokenId,
    );
    const content = h('div', { class: 'card flush' }, h('p', { class: 'loading', role: 'status' }, 'Loading the tokens …'));
    const add = h('button', { type: 'button', class: 'primary', onclick: () => void issue(context, () => polling.now()) }, 'Issue a token');
    const note = context.session.caller.tokensRequired
        ? 'Secrets are not stored, so none can be shown again.'
        : 'This service does not require tokens. Start the coordinator with --tokens to require them.';
    container.append(h('div', { class: 'row between' }, h('p', { class: 'soft' }, note), add), content);
    const polling = poll(() => EVERY_MS, signal, async () => {
        try {
            const { tokens } = await session.api.admin.listTokens({}, { signal });
            if (tokens.length === 0) {
                content.replaceChildren(h('div', { class: 'empty' }, h('h2', {}, 'No tokens'), h('p', {}, 'No token has been issued.')));
                return;
            }
            // The newest first, and those that are of no use any more at the end.
            const rank = (token: Token): number => (tokenState(token, Date.now()) === 'valid' ? 0 : 1);
            table.show(tokens.toReversed().toSorted((a, b) => rank(a) - rank(b)));
            if (table.element.parentElement !== content) {
                content.replaceChildren(table.element);
            }
        } catch (error) {
            const shown = problemOf('The tokens cannot be listed', faultOf(error));
            if (shown !== null) {
                content.replaceChildren(shown);
            }
        }
    });
}
