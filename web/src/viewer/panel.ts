// The controls of the viewer: plain HTML elements, each with a label and reachable by keyboard.

import { freshId, h } from './dom.ts';
import type { ViewerError } from './errors.ts';
import { type Bookmark, type RightSide, fragmentOf } from './link.ts';
import type { Control } from './navigation.ts';
import type { Mode } from './renderer.ts';
import type { State, Viewer } from './viewer.ts';

const MODE_NAMES: Readonly<Record<Mode, string>> = {
    clear: 'Without water',
    water: 'Under water',
    veil: 'Backscatter',
    range: 'Range',
    normal: 'Normals',
    alpha: 'Alpha',
    partition: 'Partitions',
};
const CONTROL_NAMES: Readonly<Record<Control, string>> = { orbit: 'Orbit', fly: 'Fly', walk: 'Walk' };
const KEYS: readonly (readonly [string, string])[] = [
    ['Drag', 'turn'],
    ['Right button, Shift or two fingers', 'shift the view'],
    ['Wheel or pinch', 'nearer, farther'],
    ['Double click', 'turn about this point'],
    ['W A S D, Q E', 'move, down and up; Shift is faster'],
    ['Arrow keys', 'turn'],
    ['+ −', 'nearer, farther'],
    ['F', 'turn about what is in the middle'],
    ['Page up, Page down', 'other photographs'],
    ['R', 'first view'],
];
/** The slider of the water runs from 0 to 1: its first half is 0 to 1 times the usual distance, the rest to 10. */
const amountOf = (at: number): number => (at <= 0.5 ? 2 * at : 1 + 9 * (2 * at - 1) ** 2);
const placeOf = (amount: number): number => (amount <= 1 ? amount / 2 : (1 + Math.sqrt((amount - 1) / 9)) / 2);
/** How long a message is shown, milliseconds. */
const MESSAGE_TIME = 15_000;
/** How far an arrow key moves the divider, as a share of the width. */
const DIVIDER_STEP = 0.02;

const lengthText = (range: number, metres: number | null): string =>
    metres === null ? `${range.toPrecision(3)} units` : `${(range * metres).toPrecision(3)} m`;

interface Actions {
    /** Whether links to this page can hold a view. */
    readonly hasLinks: boolean;
    savePicture(): Promise<void>;
}

export class Panel {
    readonly element: HTMLElement;
    readonly divider: HTMLElement;
    readonly legend: HTMLElement;
    /** The scale of the range follows the camera, so it changes with every frame. */
    updateLegend: () => void = () => {};
    readonly #viewer: Viewer;
    readonly #actions: Actions;
    readonly #update: ((state: State) => void)[] = [];
    readonly #status = h('p', { class: 'fv-status', role: 'status' });
    #silence = 0;
    readonly #views = h('ul', { class: 'fv-list' });

    constructor(viewer: Viewer, actions: Actions) {
        this.#viewer = viewer;
        this.#actions = actions;
        this.divider = this.#makeDivider();
        this.legend = this.#makeLegend();
        const body = h(
            'div',
            { class: 'fv-body' },
            this.#makeShow(),
            viewer.water === null ? null : this.#makeWater(),
            this.#makeMove(),
            viewer.cameras.length === 0 ? null : this.#makePhotographs(),
            this.#makeViews(),
            this.#makeAbout(),
        );
        const bodyId = freshId();
        body.id = bodyId;
        const fold = h(
            'button',
            {
                type: 'button',
                class: 'fv-fold',
                'aria-expanded': 'true',
                'aria-controls': bodyId,
                onclick: () => {
                    const open = fold.getAttribute('aria-expanded') !== 'true';
                    fold.setAttribute('aria-expanded', String(open));
                    body.hidden = !open;
                    this.element.classList.toggle('fv-folded', !open);
                    fold.textContent = open ? 'Hide' : 'Controls';
                },
            },
            'Hide',
        );
        // On a phone the picture comes first.
        const isNarrow = window.matchMedia('(max-width: 640px)').matches;
        if (isNarrow) {
            body.hidden = true;
            fold.setAttribute('aria-expanded', 'false');
            fold.textContent = 'Controls';
        }
        this.element = h(
            'section',
            { class: isNarrow ? 'fv-panel fv-folded' : 'fv-panel', 'aria-label': 'Controls' },
            h('header', { class: 'fv-head' }, h('h1', {}, viewer.scene.name), fold),
            body,
            this.#status,
        );
        this.update();
    }

    update(): void {
        this.#update.forEach((update) => update(this.#viewer.state));
    }

    say(text: string): void {
        this.#status.textContent = text;
        clearTimeout(this.#silence);
        this.#silence = window.setTimeout(() => (this.#status.textContent = ''), MESSAGE_TIME);
    }

    complain(error: ViewerError): void {
        this.say(`${error.message} ${error.remedy}`);
    }

    updateViews(): void {
        const { bookmarks, suggested } = this.#viewer;
        const suggestion = (photograph: string, i: number): HTMLElement =>
            h(
                'li',
                { class: 'fv-view' },
                h(
                    'button',
                    { type: 'button', class: 'fv-entry', onclick: () => this.#viewer.goToPhotograph(photograph) },
                    `View ${i + 1}`,
                ),
            );
        const remove = (bookmark: Bookmark): void => {
            this.#viewer.bookmarks = this.#viewer.bookmarks.filter((other) => other !== bookmark);
            this.updateViews();
            this.#viewer.onChange();
        };
        const entry = (bookmark: Bookmark): HTMLElement =>
            h(
                'li',
                { class: 'fv-view' },
                h('button', { type: 'button', class: 'fv-entry', onclick: () => this.#viewer.show(bookmark.view) }, bookmark.name),
                h(
                    'button',
                    {
                        type: 'button',
                        class: 'fv-small',
                        'aria-label': `Remove the view ${bookmark.name}`,
                        onclick: () => remove(bookmark),
                    },
                    'Remove',
                ),
            );
        this.#views.replaceChildren(...suggested.map(suggestion), ...bookmarks.map(entry));
        this.#views.hidden = bookmarks.length + suggested.length === 0;
    }

    #nameOf(mode: Mode): string {
        return mode === 'clear' && this.#viewer.water === null ? 'Colour' : MODE_NAMES[mode];
    }

    #makeSection(title: string, ...children: (Node | null)[]): HTMLElement {
        return h('section', { class: 'fv-section', 'aria-label': title }, h('h2', {}, title), ...children);
    }

    /** A row of buttons of which one is chosen. */
    #makeChoice<T extends string>(
        legend: string,
        values: readonly (readonly [T, string])[],
        chosen: (state: State) => T,
        choose: (value: T) => void,
    ): HTMLElement {
        const name = freshId();
        const options = values.map(([value, text]) => {
            const id = freshId();
            const input = h('input', { type: 'radio', name, id, value, onchange: () => choose(value) });
            this.#update.push((state) => (input.checked = chosen(state) === value));
            return h('span', { class: 'fv-option' }, input, h('label', { for: id }, text));
        });
        return h('fieldset', { class: 'fv-choice' }, h('legend', {}, legend), h('div', {}, ...options));
    }

    #makeShow(): HTMLElement {
        const viewer = this.#viewer;
        const modes = viewer.modes().map((mode) => [mode, this.#nameOf(mode)] as const);
        const show = this.#makeChoice('Picture', modes, (state) => state.left, (left) => viewer.set({ left }));
        const id = freshId();
        const select = h(
            'select',
            { id, onchange: () => viewer.set({ right: select.value as RightSide }) },
            h('option', { value: 'none' }, 'Nothing'),
            ...modes.map(([mode, text]) => h('option', { value: mode }, text)),
        );
        const photograph = h('option', { value: 'photograph' }, 'Photograph');
        this.#update.push((state) => {
            if (viewer.hasPhotograph && photograph.parentNode === null) {
                select.append(photograph);
            } else if (!viewer.hasPhotograph) {
                photograph.remove();
            }
            select.value = state.right;
        });
        const compare = h('div', { class: 'fv-row' }, h('label', { for: id }, 'Compare with'), select);
        return this.#makeSection('Show', show, compare);
    }

    #makeWater(): HTMLElement {
        const id = freshId();
        const output = h('output', { for: id, class: 'fv-value' });
        const slider = h('input', {
            id,
            type: 'range',
            min: 0,
            max: 1,
            step: 0.005,
            oninput: () => {
                const amount = amountOf(Number(slider.value));
                // The usual amount can be hit again.
                this.#viewer.set({ amount: Math.abs(amount - 1) < 0.04 ? 1 : Math.round(amount * 100) / 100 });
            },
        });
        this.#update.push((state) => {
            slider.value = String(placeOf(state.amount));
            const text = `${state.amount.toFixed(state.amount < 2 ? 2 : 1)} ×`;
            output.textContent = text;
            slider.setAttribute('aria-valuetext', `${text} the usual distance`);
        });
        return this.#makeSection(
            'Water',
            h('div', { class: 'fv-row' }, h('label', { for: id }, 'Amount of water'), output),
            slider,
        );
    }

    #makeMove(): HTMLElement {
        const viewer = this.#viewer;
        const controls = Object.entries(CONTROL_NAMES) as [Control, string][];
        const choice = this.#makeChoice('Movement', controls, (state) => state.control, (control) =>
            viewer.set({ control }),
        );
        const id = freshId();
        const showsCameras = h('input', {
            type: 'checkbox',
            id,
            onchange: () => viewer.set({ showsCameras: showsCameras.checked }),
        });
        this.#update.push((state) => (showsCameras.checked = state.showsCameras));
        const keys = h(
            'details',
            { class: 'fv-keys' },
            h('summary', {}, 'Mouse, touch and keys'),
            h('dl', {}, ...KEYS.flatMap(([key, effect]) => [h('dt', {}, key), h('dd', {}, effect)])),
        );
        return this.#makeSection(
            'Move',
            choice,
            h(
                'div',
                { class: 'fv-row' },
                h('button', { type: 'button', onclick: () => viewer.reset() }, 'First view'),
                viewer.cameras.length === 0
                    ? null
                    : h('button', { type: 'button', onclick: () => viewer.overview() }, 'Whole scene'),
                h('span', { class: 'fv-fill' }),
            ),
            viewer.cameras.length === 0
                ? null
                : h('div', { class: 'fv-check' }, showsCameras, h('label', { for: id }, 'Show camera positions')),
            keys,
        );
    }

    #makePhotographs(): HTMLElement {
        const viewer = this.#viewer;
        const id = freshId();
        const select = h(
            'select',
            { id, onchange: () => viewer.goToPhotograph(select.value) },
            h('option', { value: '' }, `${viewer.cameras.length} photographs`),
            ...viewer.cameras.map((camera) => h('option', { value: camera.img_name }, camera.img_name)),
        );
        const step = (by: number, text: string, label: string): HTMLElement =>
            h('button', { type: 'button', 'aria-label': label, onclick: () => viewer.stepPhotograph(by) }, text);
        const compare = h(
            'button',
            {
                type: 'button',
                'aria-pressed': 'false',
                onclick: () => viewer.set({ right: viewer.state.right === 'photograph' ? 'none' : 'photograph' }),
            },
            'Compare with the photograph',
        );
        this.#update.push((state) => {
            select.value = state.photograph ?? '';
            compare.disabled = !viewer.hasPhotograph;
            compare.setAttribute('aria-pressed', String(state.right === 'photograph'));
        });
        const hasAny = Object.keys(viewer.scene.photographs).length > 0;
        return this.#makeSection(
            'Photographs',
            h('label', { for: id, class: 'fv-above' }, 'Go to the camera of'),
            h('div', { class: 'fv-row' }, select, step(-1, '‹', 'Previous photograph'), step(1, '›', 'Next photograph')),
            hasAny ? compare : null,
        );
    }

    #makeViews(): HTMLElement {
        const viewer = this.#viewer;
        const id = freshId();
        const name = h('input', { id, type: 'text', maxlength: 60, autocomplete: 'off', placeholder: 'Stern from port' });
        const save = (): void => {
            const bookmark = { name: name.value.trim() || `View ${viewer.suggested.length + viewer.bookmarks.length + 1}`, view: viewer.saved() };
            viewer.bookmarks = [...viewer.bookmarks, bookmark];
            name.value = '';
            this.updateViews();
            viewer.onChange();
            this.say(
                this.#actions.hasLinks ? `Saved "${bookmark.name}". It is kept in the link.` : `Saved "${bookmark.name}".`,
            );
        };
        name.addEventListener('keydown', (event) => {
            if (event.key === 'Enter') {
                save();
            }
        });
        const copy = async (): Promise<void> => {
            const address = new URL(location.href);
            address.hash = fragmentOf(viewer.saved(), viewer.bookmarks);
            try {
                await navigator.clipboard.writeText(address.href);
                this.say('The link is copied.');
            } catch {
                this.say('The browser does not allow copying. Copy the address of this page instead.');
            }
        };
        const picture = h(
            'button',
            {
                type: 'button',
                onclick: () => {
                    picture.disabled = true;
                    void this.#actions.savePicture().finally(() => (picture.disabled = false));
                },
            },
            'Save picture',
        );
        this.updateViews();
        return this.#makeSection(
            'Views',
            h('label', { for: id, class: 'fv-above' }, 'Name of this view'),
            h('div', { class: 'fv-row' }, name, h('button', { type: 'button', onclick: save }, 'Keep')),
            this.#views,
            h(
                'div',
                { class: 'fv-row' },
                this.#actions.hasLinks ? h('button', { type: 'button', onclick: () => void copy() }, 'Copy link') : null,
                picture,
            ),
        );
    }

    #makeAbout(): HTMLElement | null {
        const { credits } = this.#viewer.scene;
        return credits === '' ? null : h('p', { class: 'fv-credits' }, credits);
    }

    #makeDivider(): HTMLElement {
        const viewer = this.#viewer;
        const divider = h('div', {
            class: 'fv-divider',
            role: 'slider',
            tabindex: 0,
            'aria-label': 'Divider between the two pictures',
            'aria-orientation': 'horizontal',
            'aria-valuemin': 0,
            'aria-valuemax': 100,
        });
        const grip = h('span', { class: 'fv-grip', 'aria-hidden': 'true' });
        const left = h('span', { class: 'fv-tag fv-tag-left', 'aria-hidden': 'true' });
        const right = h('span', { class: 'fv-tag fv-tag-right', 'aria-hidden': 'true' });
        divider.append(grip, left, right);
        const move = (to: number): void => viewer.set({ split: Math.min(1, Math.max(0, to)) });
        divider.addEventListener('pointerdown', (event) => {
            divider.setPointerCapture(event.pointerId);
            event.preventDefault();
            divider.focus();
        });
        divider.addEventListener('pointermove', (event) => {
            if (divider.hasPointerCapture(event.pointerId)) {
                const box = viewer.canvas.getBoundingClientRect();
                const area = viewer.area();
                move((event.clientX - box.left - area.x) / area.width);
            }
        });
        divider.addEventListener('keydown', (event) => {
            const steps: Record<string, number> = {
                ArrowLeft: -DIVIDER_STEP,
                ArrowRight: DIVIDER_STEP,
                PageDown: -5 * DIVIDER_STEP,
                PageUp: 5 * DIVIDER_STEP,
                Home: -1,
                End: 1,
            };
            const step = steps[event.key];
            if (step !== undefined) {
                event.preventDefault();
                move(viewer.state.split + step);
            }
        });
        this.#update.push((state) => {
            divider.hidden = state.right === 'none';
            divider.setAttribute('aria-valuenow', String(Math.round(100 * state.split)));
            const other = state.right === 'photograph' ? 'Photograph' : this.#nameOf(state.right as Mode);
            divider.setAttribute('aria-valuetext', `${Math.round(100 * state.split)} % ${this.#nameOf(state.left)}, then ${other}`);
            left.textContent = this.#nameOf(state.left);
            right.textContent = other ?? '';
        });
        return divider;
    }

    #makeLegend(): HTMLElement {
        const near = h('span');
        const far = h('span');
        const legend = h('div', { class: 'fv-legend' }, near, h('span', { class: 'fv-ramp', 'aria-hidden': 'true' }), far);
        const metres = this.#viewer.water?.metres_per_unit ?? null;
        this.updateLegend = () => {
            const { left, right } = this.#viewer.state;
            legend.hidden = left !== 'range' && right !== 'range';
            near.textContent = lengthText(this.#viewer.rangeScale[0], metres);
            far.textContent = lengthText(this.#viewer.rangeScale[1], metres);
        };
        return legend;
    }
}
