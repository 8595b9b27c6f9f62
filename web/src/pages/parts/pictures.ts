// Pictures behind `GetPicture`: fetched once, decoded when they are needed.

import type { GetPicture } from './part.ts';

/** Decoded pictures that are kept; photographs are large, so not all of them fit in memory. */
const MOST_DECODED = 12;

export class Pictures {
    readonly #addresses = new Map<GetPicture, Promise<string>>();
    /** In the order of their use. */
    readonly #decoded = new Map<GetPicture, Promise<HTMLImageElement>>();

    /** The decoded picture. A failure may pass, so the next call tries again. */
    get(get: GetPicture): Promise<HTMLImageElement> {
        const known = this.#decoded.get(get) ?? this.#load(get);
        this.#decoded.delete(get);
        this.#decoded.set(get, known);
        const [oldest] = this.#decoded.keys();
        if (this.#decoded.size > MOST_DECODED && oldest !== undefined) {
            this.#decoded.delete(oldest);
        }
        return known;
    }

    /** Forgets all others. */
    keep(used: ReadonlySet<GetPicture>): void {
        for (const known of [this.#addresses, this.#decoded]) {
            [...known.keys()].filter((get) => !used.has(get)).forEach((get) => known.delete(get));
        }
    }

    async #load(get: GetPicture): Promise<HTMLImageElement> {
        try {
            const address = this.#addresses.get(get) ?? get();
            this.#addresses.set(get, address);
            const image = new Image();
            image.src = await address;
            await image.decode();
            return image;
        } catch (error) {
            this.#addresses.delete(get);
            this.#decoded.delete(get);
            throw error;
        }
    }
}

/** The pixels of a picture at the size of another. */
export function pixels(image: HTMLImageElement, like: HTMLImageElement): ImageData {
    const canvas = document.createElement('canvas');
    [canvas.width, canvas.height] = [like.naturalWidth, like.naturalHeight];
    const context = canvas.getContext('2d', { willReadFrequently: true })!;
    context.imageSmoothingQuality = 'high';
    context.drawImage(image, 0, 0, canvas.width, canvas.height);
    return context.getImageData(0, 0, canvas.width, canvas.height);
}

/** Fills a small canvas with the middle of a picture. */
export function drawThumbnail(canvas: HTMLCanvasElement, image: HTMLImageElement): void {
    const context = canvas.getContext('2d')!;
    const scale = Math.max(canvas.width / image.naturalWidth, canvas.height / image.naturalHeight);
    const [w, h] = [image.naturalWidth * scale, image.naturalHeight * scale];
    context.imageSmoothingQuality = 'high';
    context.drawImage(image, (canvas.width - w) / 2, (canvas.height - h) / 2, w, h);
}
