// Views in the fragment of an address, so that a link holds what is shown, and bookmarks with it.
//
//   c  position and rotation (x y z w) of the camera      f  field of view, degrees
//   p  photograph whose camera is used exactly            m  what the left and the right side show
//   s  place of the divider, 0 to 1                       w  how many times the usual distance the water is
//   b  a bookmark: its name, "~", and the same keys again; repeated

import type { Pose } from './camera.ts';
import type { Mode } from './renderer.ts';
import { quatUnit } from './vector.ts';

export type RightSide = Mode | 'photograph' | 'none';

/** What is shown, without the scene. */
export interface SavedView {
    readonly pose: Pose;
    /** Field of view along the shorter side, radians; null with a photograph. */
    readonly fov: number | null;
    readonly photograph: string | null;
    readonly left: Mode;
    readonly right: RightSide;
    readonly split: number;
    readonly amount: number;
}

export interface Bookmark {
    readonly name: string;
    readonly view: SavedView;
}

export const MODES: readonly Mode[] = ['clear', 'water', 'veil', 'range', 'normal', 'alpha', 'partition'];

const isMode = (mode: string | undefined): mode is Mode => MODES.includes(mode as Mode);
const short = (value: number): string => String(Number(value.toPrecision(7)));

function paramsOf(view: SavedView): URLSearchParams {
    const params = new URLSearchParams();
    params.set('c', [...view.pose.position, ...view.pose.rotation].map(short).join(','));
    if (view.photograph !== null) {
        params.set('p', view.photograph);
    } else if (view.fov !== null) {
        params.set('f', short((view.fov * 180) / Math.PI));
    }
    params.set('m', `${view.left},${view.right}`);
    params.set('s', short(view.split));
    params.set('w', short(view.amount));
    return params;
}

/** The fragment, without "#". */
export function fragmentOf(view: SavedView, bookmarks: readonly Bookmark[]): string {
    const params = paramsOf(view);
    for (const bookmark of bookmarks) {
        params.append('b', `${bookmark.name}~${paramsOf(bookmark.view).toString()}`);
    }
    return params.toString();
}

function viewOf(params: URLSearchParams): SavedView | null {
    const numbers = (params.get('c') ?? '').split(',').map(Number);
    if (numbers.length !== 7 || !numbers.every(Number.isFinite) || Math.hypot(...numbers.slice(3)) < 1e-6) {
        return null;
    }
    const [px, py, pz, x, y, z, w] = numbers as [number, number, number, number, number, number, number];
    const [left, right] = (params.get('m') ?? '').split(',');
    const number = (key: string, otherwise: number, least: number, most: number): number => {
        const value = Number(params.get(key) ?? otherwise);
        return Number.isFinite(value) ? Math.min(most, Math.max(least, value)) : otherwise;
    };
    const photograph = params.get('p');
    return {
        pose: { position: [px, py, pz], rotation: quatUnit([x, y, z, w]) },
        fov: photograph === null ? (number('f', 50, 1, 170) * Math.PI) / 180 : null,
        photograph,
        left: isMode(left) ? left : 'clear',
        right: isMode(right) || right === 'photograph' ? right : 'none',
        split: number('s', 0.5, 0, 1),
        amount: number('w', 1, 0, 10),
    };
}

/** Reads a fragment, with or without "#". Parts that are wrong are left out. */
export function readFragment(fragment: string): { view: SavedView | null; bookmarks: Bookmark[] } {
    const params = new URLSearchParams(fragment.replace(/^#/, ''));
    const bookmarks: Bookmark[] = [];
    for (const text of params.getAll('b')) {
        const at = text.lastIndexOf('~c=');
        const view = at < 0 ? null : viewOf(new URLSearchParams(text.slice(at + 1)));
        if (view !== null) {
            bookmarks.push({ name: text.slice(0, at), view });
        }
    }
    return { view: viewOf(params), bookmarks };
}
