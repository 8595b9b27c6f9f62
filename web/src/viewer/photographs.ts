// The photograph that lies over the picture, right of the divider.

import { fetched } from './download.ts';
import { ViewerError } from './errors.ts';
import type { Panel } from './panel.ts';
import type { FetchFile } from './scene.ts';
import type { Viewer } from './viewer.ts';

/** Fetches the photograph that is compared with. */
export class Photographs {
    readonly #viewer: Viewer;
    readonly #image: HTMLImageElement;
    readonly #fetchFile: FetchFile;
    readonly #panel: Panel;
    #shown: string | null = null;

    constructor(viewer: Viewer, image: HTMLImageElement, fetchFile: FetchFile, panel: Panel) {
        this.#viewer = viewer;
        this.#image = image;
        this.#fetchFile = fetchFile;
        this.#panel = panel;
    }

    async update(): Promise<void> {
        const { right, photograph } = this.#viewer.state;
        if (right !== 'photograph' || photograph === null || photograph === this.#shown) {
            return;
        }
        this.#shown = photograph;
        const path = this.#viewer.scene.photographs[photograph] ?? '';
        this.#free();
        try {
            const response = await fetched(path, this.#fetchFile);
            const blob = await response.blob();
            if (this.#shown !== photograph) {
                return;
            }
            this.#image.src = URL.createObjectURL(blob);
            this.#image.alt = `Photograph ${photograph}`;
            await this.#image.decode();
        } catch (error) {
            if (this.#shown === photograph) {
                this.#shown = null;
                this.#viewer.set({ right: 'none' });
                const damaged = new ViewerError(`${path} is not a picture that the browser can show.`, 'PNG and JPEG work everywhere; TIFF does not.', error);
                this.#panel.complain(error instanceof ViewerError ? error : damaged);
            }
        }
    }

    destroy(): void {
        this.#free();
    }

    #free(): void {
        if (this.#image.src !== '') {
            URL.revokeObjectURL(this.#image.src);
            this.#image.removeAttribute('src');
        }
    }
}
