// The photographs of a job, which its manifest names.

import type { JobContext } from './section.ts';

interface ManifestView {
    readonly name: string;
    readonly image: { readonly digest: string };
}

const TYPES: Readonly<Record<string, string>> = { png: 'image/png', jpg: 'image/jpeg', jpeg: 'image/jpeg', webp: 'image/webp' };

const isView = (value: unknown): value is ManifestView => {
    const view = value as Partial<ManifestView> | null;
    return typeof view?.name === 'string' && typeof view.image?.digest === 'string';
};

/** From the names of photographs to the digests of their files. Empty if the manifest cannot be read. */
export function digestsOf(manifest: unknown): ReadonlyMap<string, string> {
    const views = (manifest as { readonly views?: unknown } | null)?.views;
    const known = Array.isArray(views) ? views.filter(isView) : [];
    return new Map(known.map(({ name, image }) => [name, image.digest]));
}

export class Photographs {
    readonly #context: JobContext;
    #digests: Promise<ReadonlyMap<string, string>> | null = null;

    constructor(context: JobContext) {
        this.#context = context;
    }

    digests(): Promise<ReadonlyMap<string, string>> {
        const { job, id, session, signal } = this.#context;
        const digest = job.manifest?.digest ?? '';
        this.#digests ??=
            digest === ''
                ? Promise.resolve(new Map<string, string>())
                : session.api.json(digest, id, signal).then(digestsOf, (error: unknown) => {
                      // The next one who asks tries again.
                      this.#digests = null;
                      throw error;
                  });
        return this.#digests;
    }

    /** A photograph as it was uploaded; null if the manifest does not name it. */
    async fetch(name: string): Promise<Blob | null> {
        const { id, session, signal } = this.#context;
        const digest = (await this.digests()).get(name);
        const type = TYPES[name.split('.').at(-1)?.toLowerCase() ?? ''] ?? 'application/octet-stream';
        return digest === undefined ? null : session.api.blob(digest, id, signal, type);
    }
}
