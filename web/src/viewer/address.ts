// The address of the page, whose fragment holds the view and the bookmarks.

import { fragmentOf, readFragment } from './link.ts';
import type { Panel } from './panel.ts';
import type { Viewer } from './viewer.ts';

/** Keeps the view in the fragment of the address. */
export class Fragment {
    readonly #viewer: Viewer;
    readonly #panel: Panel;
    #timer = 0;
    #written = '';

    constructor(viewer: Viewer, panel: Panel, signal: AbortSignal) {
        this.#viewer = viewer;
        this.#panel = panel;
        window.addEventListener('hashchange', () => this.read(), { signal });
    }

    read(): void {
        const text = location.hash.replace(/^#/, '');
        if (text === '' || text === this.#written) {
            return;
        }
        const { view, bookmarks } = readFragment(text);
        this.#viewer.bookmarks = bookmarks;
        this.#panel.updateViews();
        if (view !== null) {
            this.#viewer.show(view);
        }
    }

    write(): void {
        // Browsers refuse more than about 100 changes in 30 seconds.
        clearTimeout(this.#timer);
        this.#timer = window.setTimeout(() => {
            this.#written = fragmentOf(this.#viewer.saved(), this.#viewer.bookmarks);
            try {
                history.replaceState(history.state, '', `#${this.#written}`);
            } catch {
                // Some browsers refuse this for a page from the disk: then its address holds no view.
            }
        }, 400);
    }
}
