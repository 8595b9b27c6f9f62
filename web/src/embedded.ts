// The files inside a page that `fathom export --html` made, instead of a server's.
//
//   <script type="application/json" id="scene">               the content of scene.json
//   <script type="application/octet-stream;base64" data-file="PATH">   a part of a file; its parts follow in order

import { decodeBase64 } from './base64.ts';
import { type Scene, ViewerError } from './viewer/index.ts';

const KINDS: Readonly<Record<string, string>> = { png: 'image/png', jpg: 'image/jpeg', jpeg: 'image/jpeg', webp: 'image/webp' };

/** What the page was made with; `views` is the fragment of a link, with the views that were chosen. */
export type EmbeddedScene = Scene & { readonly views?: unknown };

const damaged = (what: string, cause?: unknown): ViewerError =>
    new ViewerError(`This page is damaged: ${what}.`, 'Copy the file again, or ask for it again.', cause);

/** The scene of the page. */
export function sceneOf(page: Document): EmbeddedScene {
    const element = page.querySelector('#scene');
    if (element === null) {
        throw damaged('it holds no scene');
    }
    try {
        return JSON.parse(element.textContent) as EmbeddedScene;
    } catch (error) {
        throw damaged('its scene is not JSON', error);
    }
}

/** A file of the page, as a server would answer. The text of a model is removed: it is read once. */
export function fileOf(page: Document, path: string): Response {
    const elements = [...page.querySelectorAll<HTMLElement>('script[data-file]')].filter(
        (element) => element.dataset['file'] === path,
    );
    if (elements.length === 0) {
        throw damaged(`${path} is not in it`);
    }
    let parts: Uint8Array<ArrayBuffer>[];
    try {
        parts = elements.map((element) => decodeBase64(element.textContent));
    } catch (error) {
        throw damaged(`${path} cannot be decoded`, error);
    }
    const kind = KINDS[path.split('.').at(-1)?.toLowerCase() ?? ''];
    if (kind === undefined) {
        elements.forEach((element) => element.remove());
    }
    const length = parts.reduce((sum, part) => sum + part.length, 0);
    return new Response(new Blob(parts), {
        headers: { 'content-type': kind ?? 'application/octet-stream', 'content-length': String(length) },
    });
}
