// Errors of calls: which kind they are, and what the page says about them.

import { Code, ConnectError } from '@connectrpc/connect';

import { BadRequestSchema, ErrorInfoSchema } from '../rpc/google/rpc/error_details_pb.ts';
import { sentence } from './format.ts';

export type FaultKind =
    /** Nobody answered, or the answer broke off: try again. */
    | 'lost'
    /** The token is missing or not valid. */
    | 'token'
    /** The call was ended by the page itself. */
    | 'ended'
    /** The service does not know the call: it is older than this page. */
    | 'unknown call'
    /** The service refuses; see `reason`. */
    | 'refused';

/** A failed call. */
export class Fault extends Error {
    readonly kind: FaultKind;
    /** The reason of the service, such as "JOB_NOT_FOUND"; empty where it gives none. */
    readonly reason: string;

    constructor(kind: FaultKind, reason: string, message: string, cause?: unknown) {
        super(message, { cause });
        this.name = 'Fault';
        this.kind = kind;
        this.reason = reason;
    }
}

/** Codes that also come from proxies and broken connections. With a reason they are from the service. */
const BROKEN: ReadonlySet<Code> = new Set([
    Code.Unavailable,
    Code.Unknown,
    Code.Internal,
    Code.Aborted,
    Code.DataLoss,
    Code.DeadlineExceeded,
]);
const LOST = 'The service does not answer. Check the connection; this page tries again.';

function kindOf(error: ConnectError, reason: string): FaultKind {
    if (error.code === Code.Canceled) {
        return 'ended';
    }
    if (error.code === Code.Unauthenticated) {
        return 'token';
    }
    if (error.code === Code.Unimplemented && reason === '') {
        return 'unknown call';
    }
    // A service that has no access to its database says so with a reason, and recovers by itself.
    return (BROKEN.has(error.code) && reason === '') || error.code === Code.Unavailable ? 'lost' : 'refused';
}

/** Any thrown value as a fault. */
export function faultOf(thrown: unknown): Fault {
    if (thrown instanceof Fault) {
        return thrown;
    }
    if (thrown instanceof DOMException && thrown.name === 'AbortError') {
        return new Fault('ended', '', 'The call was ended.', thrown);
    }
    if (thrown instanceof TypeError && /fetch|network/i.test(thrown.message)) {
        return new Fault('lost', '', LOST, thrown);
    }
    if (!(thrown instanceof ConnectError)) {
        const message = thrown instanceof Error ? thrown.message : String(thrown);
        return new Fault('refused', '', sentence(message), thrown);
    }
    const reason = thrown.findDetails(ErrorInfoSchema)[0]?.reason ?? '';
    const kind = kindOf(thrown, reason);
    const texts: Partial<Record<FaultKind, string>> = {
        lost: reason === '' ? LOST : sentence(thrown.rawMessage),
        'unknown call': 'The service is older than this page and cannot do this. Update the coordinator.',
    };
    return new Fault(kind, reason, texts[kind] ?? sentence(thrown.rawMessage), thrown);
}

export interface WrongField {
    /** The field of the request, such as "config_json". */
    readonly field: string;
    readonly message: string;
}

/** The fields of a request that the service finds wrong. */
export function wrongFieldsOf(fault: Fault): readonly WrongField[] {
    const details = fault.cause instanceof ConnectError ? fault.cause.findDetails(BadRequestSchema) : [];
    return details.flatMap(({ fieldViolations }) => fieldViolations.map(({ field, description: message }) => ({ field, message })));
}

interface JsonError {
    readonly error?: { readonly reason?: string; readonly message?: string };
}

/** The fault of an answer of the JSON interface that is no success. */
export async function faultOfResponse(response: Response): Promise<Fault> {
    const said = (await response.json().catch(() => ({}))) as JsonError;
    const reason = said.error?.reason ?? '';
    const message = sentence(said.error?.message ?? `the service answers ${response.status} ${response.statusText}`);
    if (response.status === 401) {
        return new Fault('token', reason, message);
    }
    const isBroken = [502, 503, 504].includes(response.status);
    return new Fault(isBroken ? 'lost' : 'refused', reason, isBroken && reason === '' ? LOST : message);
}
