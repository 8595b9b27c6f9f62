// Who uses the page. The token is in memory and in the session storage of this tab, never elsewhere. An
// invitation is in memory only, until it is exchanged for a token.

import { create } from '@bufbuild/protobuf';

import { type Caller, CallerSchema, Role } from '../rpc/fathom/admin/v1/admin_pb.ts';
import { Api, type Identity } from './api.ts';
import type { Connection } from './connection.ts';
import { Fault, faultOf } from './faults.ts';
import { type TakenToken, takeToken } from './route.ts';

const KEY = 'fathom.token';
/** The reason of the fault when a worker's token is used to sign in. */
export const WORKER_TOKEN = 'WORKER_TOKEN';
/** The reason of the fault when the invitation in a link is not valid any more, and there is no other token. */
export const INVITATION_REFUSED = 'INVITATION_REFUSED';
const USED = 'This link was used before, or its run has ended. Open the latest link that fathom train has printed.';

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

/** Takes a token or invitation out of the page's address, so that nobody reads or copies it there. */
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
    /** Not exchanged yet. */
    #invitation: string | null = null;
    /** Whether the latest invitation was refused. */
    #isUsed = false;
    #caller: Caller | null = null;

    constructor(base: string, connection: Connection) {
        const taken = tokenOfAddress();
        this.isBareLink = false;
        this.#token = stored();
        this.api = new Api(base, this, connection);
        if (taken !== null) {
            this.take(taken);
        }
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

    /** Forgets the token and the invitation. */
    forget(): void {
        this.#token = null;
        this.#invitation = null;
        this.#isUsed = false;
        this.#caller = null;
        store(null);
    }

    use(token: string): void {
        this.forget();
        this.#token = token;
        store(token);
    }

    /** Uses what a link carries. With an invitation the token of this tab stays until it is exchanged. */
    take({ token, isInvitation, isBare }: TakenToken): void {
        this.isBareLink = isBare;
        if (isInvitation) {
            this.#invitation = token;
            this.#isUsed = false;
            this.#caller = null;
        } else {
            this.use(token);
        }
    }

    /**
     * Asks the service who this is, after the exchange of an invitation. Rejects if it is nobody who may use
     * the pages. After a lost connection another call goes on.
     */
    async identify(): Promise<Caller> {
        await this.#enter();
        let caller: Caller;
        try {
            caller = await this.api.admin.getCaller({});
        } catch (error) {
            const fault = faultOf(error);
            throw this.#isUsed && fault.kind === 'token' ? new Fault('token', INVITATION_REFUSED, USED, error) : fault;
        }
        if (caller.role === Role.WORKER) {
            throw new Fault('refused', WORKER_TOKEN, 'This is the token of a worker. Sign in as a viewer, submitter or operator.');
        }
        this.#caller = caller;
        return caller;
    }

    /** Exchanges the invitation. One that is refused is dropped: the token of this tab may still be valid. */
    async #enter(): Promise<void> {
        const invitation = this.#invitation;
        if (invitation === null) {
            return;
        }
        let token: string | null = null;
        try {
            token = await this.api.enter(invitation);
        } catch (error) {
            const fault = faultOf(error);
            if (fault.kind !== 'token') {
                throw fault;
            }
        }
        // Another link may have been opened meanwhile.
        if (this.#invitation !== invitation) {
            return;
        }
        if (token === null) {
            this.#invitation = null;
            this.#isUsed = true;
        } else {
            this.use(token);
        }
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
