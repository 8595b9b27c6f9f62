// Held-out photographs beside their renders, worst first.

import { freshId, h } from '../../viewer/dom.ts';
import { Divider } from './compare-divider.ts';
import './compare-views.css';
import { type Choice, choice, setText } from './elements.ts';
import { counted, decibels } from './format.ts';
import './parts.css';
import { type GetPicture, NoPicture, type Part } from './part.ts';
import { Pictures, drawThumbnail, pixels } from './pictures.ts';
import {
    ALL_SIDES,
    type ComparedView,
    SIDE_WORDS,
    type Showing,
    type Sides,
    difference,
    keyOf,
    meanDifference,
    possible,
    possibleSides,
    sidesOf,
    sidesText,
    thumbnailOf,
    worstFirst,
} from './view-difference.ts';

export interface CompareData {
    readonly views: readonly ComparedView[];
    /** In which order: the worst first, or as they are given. */
    readonly order?: 'worst' | 'given';
    /** The key of the view to show. Absent: the one that the reader chose, or the first. */
    readonly chosen?: string | null;
}

export interface CompareOptions {
    /** What is shown where there are no views. */
    readonly empty?: string;
    /** Shown above the picture. */
    readonly controls?: HTMLElement;
    /** The reader chose a view. */
    readonly onChoose?: (key: string) => void;
}

/** A picture that takes longer is announced, milliseconds. */
const SLOW_MS = 200;
const NONE = 'No held-out photographs to compare. They are rendered when the model is evaluated.';
const BROKEN = 'The picture cannot be loaded. Check the connection, then choose it again.';
const NAMES: readonly (readonly [Showing, string])[] = [
    ['compare', 'Compare'],
    ['photograph', 'Photograph'],
    ['render', 'Render'],
    ['difference', 'Difference'],
    ['clear', 'Without water'],
];

type SideWords = (typeof SIDE_WORDS)[keyof typeof SIDE_WORDS];

interface Entry {
    readonly element: HTMLElement;
    readonly button: HTMLButtonElement;
    readonly label: HTMLElement;
    readonly thumb: HTMLCanvasElement;
    /** The picture that the thumbnail shows. */
    shows: GetPicture | null;
}

export function compareViews(container: HTMLElement, options: CompareOptions = {}): Part<CompareData> {
    const view = new CompareViews(options);
    container.append(view.element);
    return view;
}

class CompareViews implements Part<CompareData> {
    readonly element = h('div', { class: 'fp fp-compare' });
    readonly #empty = h('p', { class: 'fp-empty' });
    readonly #body = h('div', { class: 'fp-compare-pair', hidden: true });
    readonly #list = h('ol', { class: 'fp-compare-list' });
    readonly #count = h('p', { class: 'fp-note' });
    readonly #title = h('h3');
    readonly #facts = h('p', { class: 'fp-note fp-number' });
    readonly #stage = h('div', { class: 'fp-compare-stage' });
    readonly #left = h('img', { alt: '' });
    readonly #right = h('img', { alt: '' });
    readonly #canvas = h('canvas', { role: 'img', hidden: true });
    readonly #message = h('p', { class: 'fp-compare-message', role: 'status' });
    readonly #divider = new Divider(this.#stage, this.#right);
    readonly #options: CompareOptions;
    readonly #choice: Choice<Showing>;
    readonly #sidesSelect: HTMLSelectElement;
    readonly #sidesRow: HTMLElement;
    readonly #gain: HTMLInputElement;
    readonly #gainRow: HTMLElement;
    readonly #words = h('p', { class: 'fp-note' });
    readonly #pictures = new Pictures();
    readonly #entries = new Map<string, Entry>();
    readonly #observer: IntersectionObserver;
    #views: readonly ComparedView[] = [];
    #chosen: string | null = null;
    #shown: ComparedView | null = null;
    #showing: Showing = 'compare';
    /** What the reader wants on both sides of the divider. */
    #sides: Sides = 'photograph-render';
    /** The pairs that can be chosen now. */
    #sidesKey = '';
    /** Counts what is asked for, so that a slow picture does not replace a later one. */
    #turn = 0;
    #pair: { readonly a: ImageData; readonly b: ImageData } | null = null;

    constructor(options: CompareOptions) {
        this.#options = options;
        setText(this.#empty, options.empty ?? NONE);
        this.#observer = new IntersectionObserver((seen) => seen.forEach((one) => this.#loadThumb(one)), {
            rootMargin: '100px',
        });
        this.#choice = choice('What to show', NAMES, 'compare', (value) => {
            this.#showing = value;
            void this.#show();
        });
        const sidesId = freshId();
        this.#sidesSelect = h('select', {
            id: sidesId,
            onchange: () => {
                this.#sides = this.#sidesSelect.value as Sides;
                void this.#show();
            },
        });
        this.#sidesRow = h(
            'div',
            { class: 'fp-bar', hidden: true },
            h('label', { for: sidesId }, 'Divider between'),
            this.#sidesSelect,
        );
        const id = freshId();
        const output = h('output', { for: id, class: 'fp-number' }, '4 ×');
        this.#gain = h('input', {
            type: 'range',
            id,
            min: 1,
            max: 8,
            step: 1,
            value: 4,
            oninput: () => {
                output.textContent = `${this.#gain.value} ×`;
                this.#drawDifference();
            },
        });
        this.#gainRow = h(
            'div',
            { class: 'fp-bar', hidden: true },
            h('label', { for: id }, 'Amplified'),
            this.#gain,
            output,
        );
        this.#stage.append(this.#left, this.#right, this.#canvas, this.#divider.element, this.#message);
        this.#body.append(
            h('nav', { class: 'fp-compare-views', 'aria-label': 'Held-out photographs' }, this.#count, this.#list),
            h(
                'div',
                { class: 'fp-compare-main' },
                h('header', { class: 'fp-compare-head' }, this.#title, this.#facts),
                h('div', { class: 'fp-bar' }, this.#choice.element),
                this.#sidesRow,
                this.#gainRow,
                options.controls ?? null,
                this.#stage,
                this.#words,
            ),
        );
        this.element.append(this.#empty, this.#body);
    }

    update({ views, order, chosen: key }: CompareData): void {
        const isByQuality = order !== 'given';
        this.#views = isByQuality ? worstFirst(views) : views;
        const isEmpty = views.length === 0;
        this.#empty.hidden = !isEmpty;
        this.#body.hidden = isEmpty;
        const all = views.flatMap(({ photograph, render, clear, thumbnail }) => [photograph, render, clear, thumbnail ?? null]);
        this.#pictures.keep(new Set(all.filter((get): get is GetPicture => get !== null)));
        this.#drawList(isByQuality);
        const wanted = key ?? this.#chosen;
        const chosen = this.#views.find((view) => keyOf(view) === wanted) ?? this.#views[0];
        const isSame = chosen !== undefined && this.#shown !== null && hasSamePictures(chosen, this.#shown);
        if (chosen !== undefined && !isSame) {
            this.#choose(keyOf(chosen));
            this.#reveal(keyOf(chosen));
        }
    }

    destroy(): void {
        this.#turn += 1;
        this.#observer.disconnect();
        this.element.remove();
    }

    #drawList(isByQuality: boolean): void {
        const measured = isByQuality && this.#views.some(({ psnr }) => psnr !== null);
        // With keys of their own, several views may be of the same photograph.
        const isOfPhotographs = this.#views.every(({ key }) => key === undefined);
        const many = counted(this.#views.length, isOfPhotographs ? 'photograph' : 'view');
        // An element that moves loses the focus.
        const focused = this.#list.contains(document.activeElement) ? (document.activeElement as HTMLElement) : null;
        setText(this.#count, `${many}${measured ? ', worst PSNR first' : ''}`);
        const keys = new Set(this.#views.map(keyOf));
        for (const [key, { element, thumb }] of this.#entries) {
            if (!keys.has(key)) {
                this.#observer.unobserve(thumb);
                element.remove();
                this.#entries.delete(key);
            }
        }
        this.#views.forEach((view, i) => {
            const entry = this.#entries.get(keyOf(view)) ?? this.#makeEntry(keyOf(view), view.name);
            setText(entry.label, view.label ?? decibels(view.psnr));
            const thumbnail = thumbnailOf(view);
            if (entry.shows !== thumbnail) {
                entry.shows = thumbnail;
                // What is observed again is reported at once, if it is in sight.
                this.#observer.unobserve(entry.thumb);
                this.#observer.observe(entry.thumb);
            }
            if (this.#list.children[i] !== entry.element) {
                this.#list.insertBefore(entry.element, this.#list.children[i] ?? null);
            }
        });
        if (focused !== null && focused !== document.activeElement) {
            focused.focus({ preventScroll: true });
        }
    }

    #makeEntry(key: string, name: string): Entry {
        const thumb = h('canvas', {
            class: 'fp-thumb',
            width: 184,
            height: 128,
            'aria-hidden': 'true',
            'data-key': key,
        });
        const label = h('span', { class: 'fp-number' });
        const words = h(
            'span',
            { class: 'fp-compare-words' },
            h('span', { class: 'fp-compare-name', title: name }, name),
            label,
        );
        const choose = (): void => {
            this.#choose(key);
            this.#options.onChoose?.(key);
        };
        const button = h('button', { type: 'button', class: 'fp-compare-entry', onclick: choose }, thumb, words);
        const entry: Entry = { element: h('li', {}, button), button, label, thumb, shows: null };
        this.#entries.set(key, entry);
        return entry;
    }

    #loadThumb({ target, isIntersecting }: IntersectionObserverEntry): void {
        const thumb = target as HTMLCanvasElement;
        const get = this.#entries.get(thumb.dataset['key'] ?? '')?.shows ?? null;
        if (isIntersecting && get !== null) {
            this.#observer.unobserve(thumb);
            this.#pictures.get(get).then(
                (image) => drawThumbnail(thumb, image),
                // It stays empty. Observing it again would ask for a missing picture for ever.
                () => {},
            );
        }
    }

    #choose(key: string): void {
        this.#chosen = key;
        for (const [other, { button }] of this.#entries) {
            if (other === key) {
                button.setAttribute('aria-current', 'true');
            } else {
                button.removeAttribute('aria-current');
            }
        }
        void this.#show();
    }

    /** Scrolls the list, and only the list, to an entry. */
    #reveal(key: string): void {
        const entry = this.#entries.get(key)?.element.getBoundingClientRect();
        const list = this.#list.getBoundingClientRect();
        if (entry !== undefined) {
            this.#list.scrollLeft += Math.min(0, entry.left - list.left) + Math.max(0, entry.right - list.right);
            this.#list.scrollTop += Math.min(0, entry.top - list.top) + Math.max(0, entry.bottom - list.bottom);
        }
    }

    async #show(): Promise<void> {
        const view = this.#views.find((one) => keyOf(one) === this.#chosen);
        if (view === undefined) {
            return;
        }
        this.#turn += 1;
        this.#shown = view;
        const turn = this.#turn;
        const allowed = possible(view);
        const showing = allowed.has(this.#showing) ? this.#showing : ([...allowed][0] ?? null);
        this.#choice.allow(allowed);
        setText(this.#title, view.name);
        setText(
            this.#facts,
            view.facts ?? `PSNR ${decibels(view.psnr)}, SSIM ${view.ssim === null ? 'not measured' : view.ssim.toFixed(4)}`,
        );
        if (showing === null) {
            this.#display(null);
            setText(this.#message, 'There are no pictures of this view.');
            return;
        }
        this.#choice.value = showing;
        this.#gainRow.hidden = showing !== 'difference';
        const sides = this.#offerSides(view, showing);
        const gets =
            showing === 'compare'
                ? sidesOf(sides).map((side) => view[side]!)
                : showing === 'difference'
                  ? [view.photograph!, view.render!]
                  : [view[showing]!];
        const announce = (): void => {
            if (turn === this.#turn) {
                setText(this.#message, 'Loading …');
            }
        };
        const slow = setTimeout(announce, SLOW_MS);
        try {
            const images = await Promise.all(gets.map((get) => this.#pictures.get(get)));
            if (turn === this.#turn) {
                setText(this.#message, '');
                this.#place(view, showing, sides, images);
            }
        } catch (error) {
            if (turn === this.#turn) {
                this.#display(null);
                setText(this.#message, error instanceof NoPicture ? error.message : BROKEN);
            }
        } finally {
            clearTimeout(slow);
        }
    }

    /** Offers the pairs of a view, and returns the one to show: the wanted one if the view has it. */
    #offerSides(view: ComparedView, showing: Showing): Sides {
        const offered = possibleSides(view);
        this.#sidesRow.hidden = showing !== 'compare' || offered.length < 2;
        const key = offered.join(' ');
        if (key !== this.#sidesKey) {
            this.#sidesKey = key;
            this.#sidesSelect.replaceChildren(
                ...offered.map((sides) => h('option', { value: sides }, sidesText(sides))),
            );
        }
        const sides = offered.includes(this.#sides) ? this.#sides : (offered[0] ?? ALL_SIDES[0]!);
        this.#sidesSelect.value = sides;
        return sides;
    }

    #place(view: ComparedView, showing: Showing, sides: Sides, images: readonly HTMLImageElement[]): void {
        const [first, second] = images;
        const frame = second ?? first!;
        // The render has the size of training; the photograph may be larger.
        this.#stage.style.aspectRatio = `${frame.naturalWidth} / ${frame.naturalHeight}`;
        // No higher than most of the window, without distorting it.
        this.#stage.style.maxWidth = `calc(75vh * ${(frame.naturalWidth / frame.naturalHeight).toFixed(4)})`;
        this.#display(showing);
        const [left, right] = sidesOf(sides).map((side) => SIDE_WORDS[side]) as [SideWords, SideWords];
        const names: Record<Showing, string> = {
            compare: `The ${left[1]} on the left of the divider, the ${right[1]} on its right.`,
            photograph: 'The photograph, which was held out of the training.',
            render: 'The trained scene under its water, from the same camera.',
            difference: '',
            clear: 'The trained scene without its water.',
        };
        setText(this.#words, names[showing]);
        if (showing === 'difference') {
            this.#pair = { a: pixels(first!, frame), b: pixels(second!, frame) };
            this.#drawDifference();
            return;
        }
        this.#left.src = first!.src;
        this.#left.alt = showing === 'compare' ? `${left[0]}, ${view.name}` : `${names[showing]} ${view.name}`;
        if (second !== undefined) {
            this.#right.src = second.src;
            this.#right.alt = `${right[0]}, ${view.name}`;
            this.#divider.name(left, right);
            this.#divider.draw();
        }
    }

    #display(showing: Showing | null): void {
        this.#left.hidden = showing === null || showing === 'difference';
        this.#right.hidden = showing !== 'compare';
        this.#divider.element.hidden = showing !== 'compare';
        this.#canvas.hidden = showing !== 'difference';
        setText(this.#words, '');
    }

    #drawDifference(): void {
        const context = this.#canvas.getContext('2d');
        if (this.#pair === null || context === null) {
            return;
        }
        const { a, b } = this.#pair;
        const gain = Number(this.#gain.value);
        [this.#canvas.width, this.#canvas.height] = [a.width, a.height];
        const out = new ImageData(a.width, a.height);
        difference(a.data, b.data, gain, out.data);
        context.putImageData(out, 0, 0);
        const mean = meanDifference(a.data, b.data).toFixed(1);
        const words = `Photograph minus render without sign, ${gain} times as bright. Black: equal. Mean difference ${mean} of 255.`;
        setText(this.#words, words);
        this.#canvas.setAttribute('aria-label', words);
    }
}

/** Whether a view would look the same. */
const hasSamePictures = (a: ComparedView, b: ComparedView): boolean =>
    a.name === b.name &&
    a.psnr === b.psnr &&
    keyOf(a) === keyOf(b) &&
    a.facts === b.facts &&
    a.photograph === b.photograph &&
    a.render === b.render &&
    a.clear === b.clear;
