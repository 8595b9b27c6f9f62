// The order of held-out views and the difference of two pictures, without anything of the page.

import type { GetPicture } from './part.ts';

/**
 * A held-out view. Pictures are fetched when they are shown, once for each function: give the same functions at
 * every update. Null where there is no picture.
 */
export interface ComparedView {
    readonly name: string;
    /** dB; null where it was not measured. */
    readonly psnr: number | null;
    readonly ssim: number | null;
    readonly photograph: GetPicture | null;
    readonly render: GetPicture | null;
    /** The scene without water. */
    readonly clear: GetPicture | null;
    /** Where names are not unique: what is. */
    readonly key?: string;
    /** In the list below the name, instead of the PSNR. */
    readonly label?: string;
    /** Above the picture, instead of PSNR and SSIM. */
    readonly facts?: string;
    /** A small picture for the list, instead of the photograph. */
    readonly thumbnail?: GetPicture | null;
}

export const keyOf = ({ key, name }: ComparedView): string => key ?? name;

export const thumbnailOf = ({ thumbnail, photograph, render }: ComparedView): GetPicture | null =>
    thumbnail === undefined ? (photograph ?? render) : thumbnail;

/** Worst PSNR first, views without one last; equal ones by name. */
export const worstFirst = (views: readonly ComparedView[]): ComparedView[] =>
    views.toSorted(
        (a, b) =>
            (a.psnr ?? Infinity) - (b.psnr ?? Infinity) || a.name.localeCompare(b.name, 'en', { numeric: true }),
    );

/**
 * The absolute difference of two pictures, amplified: red, green, blue and an alpha of 255 for each pixel.
 * Both have the same size, four bytes a pixel, sRGB.
 */
export function difference(
    a: Uint8ClampedArray,
    b: Uint8ClampedArray,
    gain: number,
    out: Uint8ClampedArray<ArrayBuffer>,
): void {
    for (let i = 0; i < out.length; i += 4) {
        // A clamped array rounds and clamps.
        out[i] = gain * Math.abs(a[i]! - b[i]!);
        out[i + 1] = gain * Math.abs(a[i + 1]! - b[i + 1]!);
        out[i + 2] = gain * Math.abs(a[i + 2]! - b[i + 2]!);
        out[i + 3] = 255;
    }
}

/** Mean absolute difference of all channels, 0 to 255. */
export function meanDifference(a: Uint8ClampedArray, b: Uint8ClampedArray): number {
    let sum = 0;
    for (let i = 0; i < a.length; i += 4) {
        sum += Math.abs(a[i]! - b[i]!) + Math.abs(a[i + 1]! - b[i + 1]!) + Math.abs(a[i + 2]! - b[i + 2]!);
    }
    return a.length === 0 ? 0 : sum / (0.75 * a.length);
}

export type Showing = 'compare' | 'photograph' | 'render' | 'difference' | 'clear';

/** Two pictures with a divider between them, the left one first. */
export type Sides = 'photograph-render' | 'photograph-clear' | 'render-clear';
type Side = 'photograph' | 'render' | 'clear';
const SIDES: Readonly<Record<Sides, readonly [Side, Side]>> = {
    'photograph-render': ['photograph', 'render'],
    'photograph-clear': ['photograph', 'clear'],
    'render-clear': ['render', 'clear'],
};
/** What readers call a picture: on a tag, and within a sentence. */
export const SIDE_WORDS: Readonly<Record<Side, readonly [string, string]>> = {
    photograph: ['Photograph', 'photograph'],
    render: ['Render', 'render'],
    clear: ['Without water', 'scene without water'],
};
export const ALL_SIDES = Object.keys(SIDES) as Sides[];

/** The left and the right picture. */
export const sidesOf = (sides: Sides): readonly [Side, Side] => SIDES[sides];

/** "Photograph and render", "Render and scene without water". */
export function sidesText(sides: Sides): string {
    const [left, right] = SIDES[sides];
    return `${SIDE_WORDS[left][0]} and ${SIDE_WORDS[right][1]}`;
}

/** The pairs of a view that have both pictures. */
export const possibleSides = (view: ComparedView): Sides[] =>
    ALL_SIDES.filter((sides) => SIDES[sides].every((side) => view[side] !== null));

/** What can be shown of a view. */
export function possible(view: ComparedView): Set<Showing> {
    const can = new Set<Showing>();
    if (view.photograph !== null) {
        can.add('photograph');
    }
    if (view.render !== null) {
        can.add('render');
    }
    if (can.size === 2) {
        can.add('difference');
    }
    if (possibleSides(view).length > 0) {
        can.add('compare');
    }
    if (view.clear !== null) {
        can.add('clear');
    }
    return can;
}
