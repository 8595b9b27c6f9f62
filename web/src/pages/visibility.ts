// Whether somebody sees the page. Without TLS a browser has six connections to a server for all its tabs, so
// tabs in the background must not hold any.

export interface Visibility {
    readonly isHidden: boolean;
    /** Calls `listener` at every change. The result stops it. */
    listen(listener: () => void): () => void;
}

export const VISIBILITY: Visibility = {
    get isHidden() {
        return document.hidden;
    },
    listen: (listener) => {
        document.addEventListener('visibilitychange', listener);
        return () => document.removeEventListener('visibilitychange', listener);
    },
};

/** Resolves when the page is visible, or when `signal` ends it. */
export function whenVisible(visibility: Visibility, signal: AbortSignal): Promise<void> {
    return new Promise((resolve) => {
        const check = (): void => {
            if (!visibility.isHidden || signal.aborted) {
                stop();
                signal.removeEventListener('abort', check);
                resolve();
            }
        };
        const stop = visibility.listen(check);
        signal.addEventListener('abort', check);
        check();
    });
}
