// The divider between two pictures that lie on each other: a slider that a pointer and keys move.

import { h } from '../../viewer/dom.ts';
import { setText } from './elements.ts';

/** How far an arrow key moves it, as a share of the width. */
const STEP = 0.02;
const STEPS: Readonly<Record<string, number>> = {
    ArrowLeft: -STEP,
    ArrowDown: -STEP,
    ArrowRight: STEP,
    ArrowUp: STEP,
    PageDown: -5 * STEP,
    PageUp: 5 * STEP,
    Home: -1,
    End: 1,
};

export class Divider {
    readonly #leftTag = h('span', { class: 'fp-tag fp-tag-left', 'aria-hidden': 'true' });
    readonly #rightTag = h('span', { class: 'fp-tag fp-tag-right', 'aria-hidden': 'true' });
    readonly element = h(
        'div',
        {
            class: 'fp-divider',
            role: 'slider',
            tabindex: 0,
            hidden: true,
            'aria-orientation': 'horizontal',
            'aria-valuemin': 0,
            'aria-valuemax': 100,
        },
        h('span', { class: 'fp-grip', 'aria-hidden': 'true' }),
        this.#leftTag,
        this.#rightTag,
    );
    readonly #stage: HTMLElement;
    readonly #right: HTMLElement;
    #share = 0.5;
    /** The two pictures, within a sentence. */
    #words: readonly [string, string] = ['photograph', 'render'];

    /** `right` is the upper picture on `stage`: it shows to the right of the divider. */
    constructor(stage: HTMLElement, right: HTMLElement) {
        this.#stage = stage;
        this.#right = right;
        this.element.addEventListener('pointerdown', (event) => {
            this.element.setPointerCapture(event.pointerId);
            event.preventDefault();
            this.element.focus();
        });
        this.element.addEventListener('pointermove', (event) => {
            if (this.element.hasPointerCapture(event.pointerId)) {
                this.#moveTo(event);
            }
        });
        // A press anywhere on the picture brings the divider there.
        stage.addEventListener('click', (event) => {
            if (!this.element.hidden && event.target !== this.element) {
                this.#moveTo(event);
            }
        });
        this.element.addEventListener('keydown', (event) => {
            const step = STEPS[event.key];
            if (step !== undefined) {
                event.preventDefault();
                this.#move(this.#share + step);
            }
        });
    }

    /** Says which two pictures it divides: each on a tag, and within a sentence. */
    name(left: readonly [string, string], right: readonly [string, string]): void {
        setText(this.#leftTag, left[0]);
        setText(this.#rightTag, right[0]);
        this.#words = [left[1], right[1]];
        this.element.setAttribute('aria-label', `Divider between ${left[1]} and ${right[1]}`);
    }

    /** Puts it where it was. */
    draw(): void {
        this.#move(this.#share);
    }

    #moveTo(event: MouseEvent): void {
        const box = this.#stage.getBoundingClientRect();
        this.#move((event.clientX - box.left) / box.width);
    }

    #move(to: number): void {
        this.#share = Math.min(1, Math.max(0, to));
        const percent = 100 * this.#share;
        this.element.style.left = `${percent}%`;
        this.#right.style.clipPath = `inset(0 0 0 ${percent}%)`;
        this.element.setAttribute('aria-valuenow', String(Math.round(percent)));
        this.element.setAttribute('aria-valuetext', `${Math.round(percent)} % ${this.#words[0]}, then ${this.#words[1]}`);
    }
}
