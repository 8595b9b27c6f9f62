// Links with invitations: their exchange for a token, and what happens when it fails.

import assert from 'node:assert/strict';
import { beforeEach, test } from 'node:test';

import { create } from '@bufbuild/protobuf';
import { Code, ConnectError } from '@connectrpc/connect';

import { Connection } from '../../src/pages/connection.ts';
import { Fault } from '../../src/pages/faults.ts';
import { INVITATION_REFUSED, Session } from '../../src/pages/session.ts';
import { CallerSchema, Role } from '../../src/rpc/fathom/admin/v1/admin_pb.ts';

const KEY = 'fathom.token';
const stored = new Map<string, string>();
const location = { hash: '', pathname: '/', search: '' };
let shownAddress = '';
/** The invitations that the service was asked to exchange. */
let asked: string[] = [];
/** What the service answers to an exchange. */
let answer: () => Response = () => new Response(null, { status: 500 });
/** The tokens that are valid. */
let valid: ReadonlySet<string | null> = new Set();

Object.assign(globalThis, {
    location,
    history: { state: null, replaceState: (_: unknown, __: string, address: string) => (shownAddress = address) },
    sessionStorage: {
        getItem: (key: string) => stored.get(key) ?? null,
        setItem: (key: string, value: string) => void stored.set(key, value),
        removeItem: (key: string) => void stored.delete(key),
    },
    fetch: async (address: URL, { method, headers }: { method: string; headers: { authorization: string } }) => {
        assert.deepEqual([address.href, method], ['http://reef.example/f/api/v1/enter', 'POST']);
        asked.push(headers.authorization);
        return answer();
    },
});

beforeEach(() => {
    stored.clear();
    asked = [];
    valid = new Set(['new']);
    answer = () => Response.json({ token: 'new' });
});

function sessionAt(hash: string, connection = new Connection()): Session {
    location.hash = hash;
    shownAddress = '';
    const session = new Session('http://reef.example/f/', connection);
    Object.assign(session.api.admin, {
        getCaller: async () => {
            if (!valid.has(session.token())) {
                throw new ConnectError('not valid', Code.Unauthenticated);
            }
            return create(CallerSchema, { role: Role.OPERATOR });
        },
    });
    return session;
}
const refused = (): Response => new Response('{"error": {"reason": "TOKEN_REFUSED"}}', { status: 401 });

test('an invitation is exchanged once, and only the token is stored', async () => {
    const session = sessionAt('#invitation=once');
    assert.deepEqual([shownAddress, session.isBareLink], ['/#/jobs', true]);
    assert.deepEqual([...stored], []);
    await session.identify();
    await session.identify();
    assert.deepEqual(asked, ['Bearer once']);
    assert.deepEqual([...stored], [[KEY, 'new']]);
});

test('a lost connection keeps the invitation for the next try', async () => {
    const connection = new Connection();
    const session = sessionAt('#invitation=once', connection);
    answer = () => {
        throw new TypeError('Failed to fetch');
    };
    await assert.rejects(session.identify(), (error: unknown) => error instanceof Fault && error.kind === 'lost');
    assert.equal(connection.isLost, true);
    answer = () => new Response(null, { status: 503 });
    await assert.rejects(session.identify(), (error: unknown) => error instanceof Fault && error.kind === 'lost');
    answer = () => Response.json({ token: 'new' });
    await session.identify();
    assert.deepEqual([asked.length, session.token(), connection.isLost], [3, 'new', false]);
});

test('a refused invitation leaves the token of the tab, if that is valid', async () => {
    stored.set(KEY, 'old');
    valid = new Set(['old']);
    answer = refused;
    const session = sessionAt('#invitation=used');
    await session.identify();
    assert.deepEqual([session.token(), stored.get(KEY)], ['old', 'old']);
});

test('a refused invitation is told, and asked for no second time', async () => {
    for (const token of [null, 'old']) {
        asked = [];
        answer = refused;
        if (token !== null) {
            stored.set(KEY, token);
        }
        const session = sessionAt('#invitation=used');
        for (let time = 0; time < 2; time += 1) {
            await assert.rejects(session.identify(), (error: unknown) => {
                assert.ok(error instanceof Fault);
                assert.deepEqual([error.kind, error.reason], ['token', INVITATION_REFUSED]);
                assert.match(error.message, /^This link was used before, or its run has ended\./);
                return true;
            });
        }
        assert.equal(asked.length, 1);
        session.use('new');
        await session.identify();
    }
});

test('a later link takes the place of an earlier one', async () => {
    const session = sessionAt('#invitation=first');
    session.take({ token: 'second', isInvitation: true, rest: '', isBare: false });
    await session.identify();
    assert.deepEqual([asked, session.isBareLink], [['Bearer second'], false]);
    session.take({ token: 'other', isInvitation: false, rest: '', isBare: false });
    valid = new Set(['other']);
    await session.identify();
    assert.deepEqual([asked.length, stored.get(KEY)], [1, 'other']);
});
