// Errors that a person can act on: what happened, where, and what to do.

export class ViewerError extends Error {
    /** What a person can do about it. */
    readonly remedy: string;

    constructor(what: string, remedy: string, cause?: unknown) {
        super(what, { cause });
        this.name = 'ViewerError';
        this.remedy = remedy;
    }
}

/** Any thrown value as an error with a remedy. */
export function explained(error: unknown): ViewerError {
    if (error instanceof ViewerError) {
        return error;
    }
    const text = error instanceof Error ? error.message : String(error);
    return new ViewerError(text, 'Reload the page. If it happens again, report this text.', error);
}
