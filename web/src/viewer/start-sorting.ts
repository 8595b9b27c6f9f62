// The worker that sorts, from a file beside the script. A page in one file has start-sorting-inline.ts in its
// place.

export const startSorting = (): Worker =>
    new Worker(new URL('sort-worker.ts', import.meta.url), { type: 'module' });
