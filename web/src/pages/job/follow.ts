// Follows a stream across interruptions.

import { pause } from '../api.ts';
import { Backoff } from '../connection.ts';
import type { Fault } from '../faults.ts';
import { type Visibility, whenVisible } from '../visibility.ts';

/** A stream that says nothing for this long is broken: the service sends something every 15 seconds. */
const SILENCE_MS = 40_000;
/** A page that is hidden for this long closes its streams. */
const HIDDEN_MS = 20_000;

export interface Followed<T> {
    /** Opens the stream, after what has arrived. */
    readonly open: (signal: AbortSignal) => AsyncIterable<T>;
    readonly onItem: (item: T) => void;
    /** Says what an error means, and notes it. */
    readonly faultOf: (error: unknown) => Fault;
    /** Whether the stream may end here: the job has ended. Otherwise it was interrupted. */
    readonly isComplete: () => boolean;
    readonly visibility: Visibility;
    readonly backoff?: Backoff;
    readonly silenceMs?: number;
    readonly hiddenMs?: number;
}

/** One attempt at a stream, and why it was ended by this side. */
class Attempt {
    readonly #controller = new AbortController();
    readonly #stops: (() => void)[] = [];
    #silence: ReturnType<typeof setTimeout> | undefined;
    #hidden: ReturnType<typeof setTimeout> | undefined;
    /** Why it was ended; null while it was not. */
    reason: 'left' | 'silent' | 'hidden' | null = null;

    constructor(followed: Followed<unknown>, signal: AbortSignal) {
        const leave = (): void => this.#end('left');
        signal.addEventListener('abort', leave, { once: true });
        const { visibility, hiddenMs } = followed;
        const look = (): void => {
            clearTimeout(this.#hidden);
            if (visibility.isHidden) {
                this.#hidden = setTimeout(() => this.#end('hidden'), hiddenMs ?? HIDDEN_MS);
            }
        };
        this.#stops.push(visibility.listen(look), () => signal.removeEventListener('abort', leave));
        this.heard(followed.silenceMs ?? SILENCE_MS);
    }

    get signal(): AbortSignal {
        return this.#controller.signal;
    }

    /** Something has arrived; the next must arrive within `silenceMs`. */
    heard(silenceMs: number): void {
        clearTimeout(this.#silence);
        this.#silence = setTimeout(() => this.#end('silent'), silenceMs);
    }

    close(): void {
        clearTimeout(this.#silence);
        clearTimeout(this.#hidden);
        this.#stops.forEach((stop) => stop());
    }

    #end(reason: NonNullable<Attempt['reason']>): void {
        this.reason ??= reason;
        this.#controller.abort();
    }
}

/**
 * Follows a stream to its end. After an interruption it is opened again, after longer and longer pauses.
 * While nobody sees the page it is closed. Rejects with a `Fault` when the service refuses it, and resolves
 * when `signal` ends it.
 */
export async function follow<T>(followed: Followed<T>, signal: AbortSignal): Promise<void> {
    const backoff = followed.backoff ?? new Backoff();
    const isStopped = (): boolean => signal.aborted;
    for (;;) {
        await whenVisible(followed.visibility, signal);
        if (isStopped()) {
            return;
        }
        const attempt = new Attempt(followed as Followed<unknown>, signal);
        try {
            for await (const item of followed.open(attempt.signal)) {
                attempt.heard(followed.silenceMs ?? SILENCE_MS);
                backoff.reset();
                followed.onItem(item);
            }
            if (followed.isComplete()) {
                return;
            }
        } catch (error) {
            if (isStopped()) {
                return;
            }
            if (attempt.reason === null) {
                const fault = followed.faultOf(error);
                if (fault.kind !== 'lost') {
                    throw fault;
                }
            }
        } finally {
            attempt.close();
        }
        if (attempt.reason !== 'hidden') {
            await pause(backoff.next(), signal).catch(() => {});
        }
    }
}
