// Whether the service answers. Every call reports here, and the page says when the answers stay away.

export class Connection {
    #isLost = false;
    readonly #listeners = new Set<(isLost: boolean) => void>();

    get isLost(): boolean {
        return this.#isLost;
    }

    answered(): void {
        this.#set(false);
    }

    lost(): void {
        this.#set(true);
    }

    /** Calls `listener` at every change. The result stops it. */
    listen(listener: (isLost: boolean) => void): () => void {
        this.#listeners.add(listener);
        return () => this.#listeners.delete(listener);
    }

    #set(isLost: boolean): void {
        if (isLost !== this.#isLost) {
            this.#isLost = isLost;
            this.#listeners.forEach((listener) => listener(isLost));
        }
    }
}

/** The first pause before trying again, and the longest, milliseconds. */
const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 5000;

/** Pauses between attempts: each is twice as long as the one before, with a part by chance. */
export class Backoff {
    #failures = 0;
    readonly #random: () => number;

    constructor(random: () => number = Math.random) {
        this.#random = random;
    }

    /** The pause after another failure, milliseconds. */
    next(): number {
        const pause = Math.min(LONGEST_PAUSE_MS, FIRST_PAUSE_MS * 2 ** this.#failures);
        this.#failures += 1;
        // All pages that lost the same service must not come back at the same moment.
        return pause * (0.75 + 0.25 * this.#random());
    }

    reset(): void {
        this.#failures = 0;
    }
}
