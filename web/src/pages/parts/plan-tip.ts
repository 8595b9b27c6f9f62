// The name and the photograph of a camera, beside it on the map of a plan.

import { h } from '../../viewer/dom.ts';
import type { MapCamera } from './plan-layout.ts';

/** Wait, so that a pointer on its way across the map does not fetch every photograph; milliseconds. */
const DELAY = 120;
/** Distance from the camera, pixels. */
const GAP = 16;

/** Where a camera is on the map, and the size of the map; pixels. */
export interface TipPlace {
    readonly x: number;
    readonly y: number;
    readonly width: number;
    readonly height: number;
}

export class PlanTip {
    readonly element = h('div', { class: 'fp-tip', role: 'status', hidden: true });
    readonly #onPhotograph: ((name: string) => Promise<string>) | null;
    readonly #addresses = new Map<string, Promise<string>>();
    #camera: MapCamera | null = null;

    constructor(onPhotograph: ((name: string) => Promise<string>) | null) {
        this.#onPhotograph = onPhotograph;
    }

    /** Shows a camera; null hides the tip. `placeOf` gives the place of the camera at any later time. */
    show(camera: MapCamera | null, placeOf: (camera: MapCamera) => TipPlace): void {
        this.#camera = camera;
        this.element.hidden = camera === null;
        if (camera === null) {
            return;
        }
        const words = camera.isHeldOut ? 'held out' : camera.owner === null ? '' : `partition ${camera.owner}`;
        const picture = h('img', { alt: '', hidden: true });
        this.element.replaceChildren(h('strong', {}, camera.name), words === '' ? '' : ` ${words}`, picture);
        this.#place(placeOf(camera));
        if (this.#onPhotograph !== null) {
            setTimeout(() => void this.#load(camera, picture, placeOf), DELAY);
        }
    }

    async #load(
        camera: MapCamera,
        picture: HTMLImageElement,
        placeOf: (camera: MapCamera) => TipPlace,
    ): Promise<void> {
        if (this.#camera !== camera || this.#onPhotograph === null) {
            return;
        }
        try {
            const address = this.#addresses.get(camera.name) ?? this.#onPhotograph(camera.name);
            this.#addresses.set(camera.name, address);
            picture.src = await address;
            await picture.decode();
            picture.alt = `Photograph ${camera.name}`;
            picture.hidden = false;
        } catch {
            this.#addresses.delete(camera.name);
            picture.replaceWith(h('span', { class: 'fp-tip-note' }, 'The photograph cannot be loaded.'));
        }
        if (this.#camera === camera) {
            this.#place(placeOf(camera));
        }
    }

    #place({ x, y, width, height }: TipPlace): void {
        const [w, tall] = [this.element.offsetWidth, this.element.offsetHeight];
        const isBelow = y + GAP + tall <= height || y < height / 2;
        this.element.style.left = `${Math.max(4, Math.min(width - w - 4, x - w / 2))}px`;
        this.element.style.top = `${isBelow ? y + GAP : y - tall - GAP}px`;
    }
}
