// A field of a form: its label, a hint, and what is wrong in it.

import { freshId, h, setAttribute } from './dom.ts';

export type Control = HTMLInputElement | HTMLSelectElement | HTMLTextAreaElement;

export class FormRow {
    readonly element: HTMLElement;
    readonly control: Control;
    readonly #error: HTMLElement;

    constructor(label: string, control: Control, hint = '', ...more: readonly HTMLElement[]) {
        const [id, hintId, errorId] = [freshId(), freshId(), freshId()];
        this.control = control;
        control.id = id;
        setAttribute(control, 'aria-describedby', hint === '' ? errorId : `${hintId} ${errorId}`);
        this.#error = h('p', { class: 'bad-text', id: errorId, role: 'alert', hidden: true });
        this.element = h(
            'div',
            { class: 'field' },
            h('label', { for: id }, label),
            control,
            ...more,
            hint === '' ? null : h('p', { class: 'soft', id: hintId }, hint),
            this.#error,
        );
        control.addEventListener('input', () => this.say(''));
    }

    get value(): string {
        return this.control.value.trim();
    }

    /** Says what is wrong; an empty text is nothing. */
    say(text: string): void {
        this.#error.textContent = text;
        this.#error.hidden = text === '';
        setAttribute(this.control, 'aria-invalid', text === '' ? null : 'true');
    }
}

export const numberInput = (value: number, minimum: number, maximum: number): HTMLInputElement =>
    h('input', { type: 'number', value, min: minimum, max: maximum, step: 1, required: true });

export const selectInput = (options: readonly (readonly [value: string, label: string])[], chosen = ''): HTMLSelectElement =>
    h('select', {}, ...options.map(([value, label]) => h('option', { value, selected: value === chosen }, label)));
