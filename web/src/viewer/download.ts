// Fetches files of the scene, with progress and with errors that say which file and why.

import { ViewerError } from './errors.ts';
import type { FetchFile } from './scene.ts';

export const megabytes = (bytes: number): string => (bytes / 1e6).toFixed(1);

export async function fetched(path: string, fetchFile: FetchFile): Promise<Response> {
    let response: Response;
    try {
        response = await fetchFile(path);
    } catch (error) {
        if (error instanceof ViewerError) {
            throw error;
        }
        throw new ViewerError(`${path} cannot be fetched: no answer.`, 'Check the connection and reload the page.', error);
    }
    if (!response.ok) {
        const remedies: Record<number, string> = {
            401: 'Sign in again.',
            403: 'Sign in with an account that may see this scene.',
            404: 'Check that the file is beside scene.json, with exactly this name.',
        };
        throw new ViewerError(
            `${path} cannot be fetched: the server answers ${response.status} ${response.statusText}.`,
            remedies[response.status] ?? 'Reload the page, or ask who runs the server.',
        );
    }
    return response;
}

/** All bytes of a file, with progress. `total` is 0 if it is not known. */
export async function download(
    path: string,
    fetchFile: FetchFile,
    onProgress: (done: number, total: number) => void,
): Promise<Uint8Array> {
    const response = await fetched(path, fetchFile);
    // The length of a compressed answer is not that of the file.
    const isPlain = (response.headers.get('content-encoding') ?? 'identity') === 'identity';
    const total = isPlain ? Number(response.headers.get('content-length') ?? 0) : 0;
    const reader = response.body?.getReader();
    if (reader === undefined) {
        return new Uint8Array(await response.arrayBuffer());
    }
    // One array from the start where the length is known: a large model must not be in memory twice.
    const whole = new Uint8Array(total);
    const parts: Uint8Array<ArrayBuffer>[] = [];
    let [filled, done] = [0, 0];
    try {
        for (let part = await reader.read(); !part.done; part = await reader.read()) {
            const { value } = part as { value: Uint8Array<ArrayBuffer> };
            if (parts.length === 0 && done + value.length <= total) {
                whole.set(value, done);
                filled += value.length;
            } else {
                parts.push(value);
            }
            done += value.length;
            onProgress(done, total);
        }
    } catch (error) {
        throw new ViewerError(
            `The connection broke after ${megabytes(done)} MB of ${path}.`,
            'Check the connection and reload the page.',
            error,
        );
    }
    const start = whole.subarray(0, filled);
    return parts.length === 0 ? start : new Uint8Array(await new Blob([start, ...parts]).arrayBuffer());
}
