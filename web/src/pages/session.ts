// Who uses the page. The token is in memory and in the session storage of this tab, never elsewhere.

import { create } from '@bufbuild/protobuf';

import { type Caller, CallerSchema, Role } from '../rpc/fathom/admin/v1/admin_pb.ts';
import { Api, type Identity } from './api.ts';
import type { Connection } from './connection.ts';
import { Fault } from './faults.ts';
import { type TakenToken, takeToken } from './route.ts';

const KEY = 'fathom.token';
/** The reason of the fault when a worker's token is used to sign in. */
export const WORKER_TOKEN = 'WORKER_TOKEN';

/** Storage may be forbidden; then a reload asks for the token again. */
function stored(): string | null {
    try {
        return sessionStorage.getItem(KEY);
    } catch {
        return null;
    }
}

function store(token: string | null): void {
    try {
        if (token === null) {
            sessionStorage.removeItem(KEY);
        } else {
            sessionStorage.setItem(KEY, token);
        }
    } catch {
        // See `stored`.
    }
}

/** Takes a token out of the page's address and removes it there, so that nobody reads or copies it. */
export function tokenOfAddress(): TakenToken | null {
    const taken = takeToken(location.hash);
    if (taken === null) {
        return null;
    }
    history.replaceState(history.state, '', `${location.pathname}${location.search}${taken.rest}`);
    return taken;
}

export class Session implements Identity {
    readonly api: Api;
    /** Called when a token that was valid is not any more. */
    onRefused: () => void = () => {};
    /** Whether the latest link named a token and no page. */
    isBareLink: boolean;
    #token: string | null;
    #caller: Caller | null = null;

    constructor(base: string, connection: Connection) {
        const taken = tokenOfAddress();
        this.isBareLink = taken?.isBare ?? false;
        this.#token = taken?.token ?? stored();
        store(this.#token);
        this.api = new Api(base, this, connection);
    }

    token(): string | null {
        return this.#token;
    }

    refused(): void {
        if (this.#caller !== null) {
            this.#caller = null;
            this.forget();
            this.onRefused();
        }
    }

    /** Forgets the token. */
    forget(): void {
        this.#token = null;
        this.#caller = null;
        store(null);
    }

    use(token: string): void {
        this.#token = token;
        this.#caller = null;
        store(token);
    }

    /** Asks the service who this is. Rejects if it is nobody who may use the pages. */
    async identify(): Promise<Caller> {
        const caller = await this.api.admin.getCaller({});
        if (caller.role === Role.WORKER) {
            throw new Fault('refused', WORKER_TOKEN, 'This is the token of a worker. Sign in as a viewer, submitter or operator.');
        }
        this.#caller = caller;
        return caller;
    }

    get caller(): Caller {
        return this.#caller ?? create(CallerSchema, { role: Role.VIEWER });
    }

    /** Whether this caller may control jobs. */
    get controls(): boolean {
        return this.caller.role === Role.SUBMITTER || this.caller.role === Role.OPERATOR;
    }

    /** Whether this caller sees the service itself: operators of all tenants. */
    get operates(): boolean {
        return this.caller.role === Role.OPERATOR && this.caller.tenant === '' && this.caller.jobId === '';
    }

    /** Whether jobs of several tenants are shown. */
    get seesTenants(): boolean {
        return this.operates && this.caller.tokensRequired;
    }
}
