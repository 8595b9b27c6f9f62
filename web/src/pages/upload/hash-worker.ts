// Computes digests beside the page.

import { digestOfFile } from './digest.ts';

/** How often progress is told, milliseconds. */
const TELL_EVERY_MS = 100;

/** Of the file that the page sent: more bytes that were read, or its end. */
export type FromHashing =
    | { readonly bytes: number }
    | { readonly digest: string }
    /** The name and the text of an error. */
    | { readonly error: string; readonly text: string };

const tell = (message: FromHashing): void => self.postMessage(message, { transfer: [] });

self.addEventListener('message', ({ data }: MessageEvent<Blob>) => {
    let [bytes, told] = [0, performance.now()];
    const more = (count: number): void => {
        bytes += count;
        if (performance.now() - told > TELL_EVERY_MS) {
            tell({ bytes });
            [bytes, told] = [0, performance.now()];
        }
    };
    digestOfFile(data, more).then(
        (digest) => {
            tell({ bytes });
            tell({ digest });
        },
        (error: unknown) => {
            const { name, message } = error as Error;
            tell({ error: name, text: message });
        },
    );
});
