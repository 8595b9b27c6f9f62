// Repeats a call while the page is visible.

export interface Polling {
    /** Calls at once, and again after the usual time. */
    now(): void;
}

/**
 * Calls `work` now and `everyMs` after each of its ends, until `signal` ends it. While nobody sees the page
 * it calls every `hiddenMs`, or not at all. `work` must handle its errors.
 */
export function poll(everyMs: () => number, signal: AbortSignal, work: () => Promise<void>, hiddenMs?: number): Polling {
    let timer = 0;
    let isRunning = false;
    let isAskedAgain = false;
    const run = async (): Promise<void> => {
        clearTimeout(timer);
        if (signal.aborted) {
            return;
        }
        if (isRunning) {
            isAskedAgain = true;
            return;
        }
        isRunning = true;
        do {
            isAskedAgain = false;
            await work();
        } while (isAskedAgain && !signal.aborted);
        isRunning = false;
        plan();
    };
    const plan = (): void => {
        clearTimeout(timer);
        const pause = document.hidden ? hiddenMs : everyMs();
        if (!signal.aborted && pause !== undefined) {
            timer = window.setTimeout(() => void run(), pause);
        }
    };
    const seen = (): void => {
        if (document.hidden) {
            plan();
        } else {
            void run();
        }
    };
    document.addEventListener('visibilitychange', seen, { signal });
    signal.addEventListener('abort', () => clearTimeout(timer), { once: true });
    void run();
    return { now: () => void run() };
}
