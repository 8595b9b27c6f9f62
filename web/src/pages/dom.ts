// Elements, and what changes them without touching what stays the same.

import { freshId, h } from '../viewer/dom.ts';

export { freshId, h };

/** Sets the text of an element unless it has it: a selection and a screen reader stay where they are. */
export function setText(element: HTMLElement, text: string): void {
    if (element.textContent !== text) {
        element.textContent = text;
    }
}

/** Sets an attribute, or removes it with null, unless it is so already. */
export function setAttribute(element: Element, name: string, value: string | null): void {
    if (value === null) {
        element.removeAttribute(name);
    } else if (element.getAttribute(name) !== value) {
        element.setAttribute(name, value);
    }
}

/**
 * Shows one element for each item, in their order. `make` is called for a new key, `update` for every item.
 * Elements of known keys stay, with focus and selection.
 */
export class Keyed<T, E extends HTMLElement = HTMLElement> {
    readonly #parent: HTMLElement;
    readonly #keyOf: (item: T) => string;
    readonly #make: (item: T) => E;
    readonly #update: (element: E, item: T) => void;
    readonly #elements = new Map<string, E>();

    constructor(
        parent: HTMLElement,
        keyOf: (item: T) => string,
        make: (item: T) => E,
        update: (element: E, item: T) => void,
    ) {
        this.#parent = parent;
        this.#keyOf = keyOf;
        this.#make = make;
        this.#update = update;
    }

    show(items: readonly T[]): void {
        const kept = new Set<string>();
        let before: Element | null = this.#parent.firstElementChild;
        for (const item of items) {
            const key = this.#keyOf(item);
            kept.add(key);
            let element = this.#elements.get(key);
            if (element === undefined) {
                element = this.#make(item);
                this.#elements.set(key, element);
            }
            this.#update(element, item);
            if (element === before) {
                before = before.nextElementSibling;
            } else {
                this.#parent.insertBefore(element, before);
            }
        }
        for (const [key, element] of this.#elements) {
            if (!kept.has(key)) {
                element.remove();
                this.#elements.delete(key);
            }
        }
    }
}

export interface Column<T> {
    readonly title: string;
    /** A class of its cells. */
    readonly kind?: string;
    /** Whether its cell names the row. */
    readonly isHeader?: boolean;
    /** Fills a cell. It is called again with the same cell when the item changes. */
    readonly show: (cell: HTMLElement, item: T) => void;
}

/** A table whose rows become cards on a phone. Roles are written out, since such a layout would lose them. */
export class Table<T> {
    readonly element: HTMLElement;
    readonly #rows: Keyed<T>;

    constructor(label: string, kind: string, columns: readonly Column<T>[], keyOf: (item: T) => string) {
        const titles = columns.map(({ title, kind: ofColumn }) =>
            h('th', { scope: 'col', role: 'columnheader', class: ofColumn ?? '' }, title),
        );
        const body = h('tbody', { role: 'rowgroup' });
        this.element = h(
            'table',
            { class: `table ${kind}`, role: 'table', 'aria-label': label },
            h('thead', { role: 'rowgroup' }, h('tr', { role: 'row' }, ...titles)),
            body,
        );
        const make = (): HTMLElement => {
            const cells = columns.map(({ title, kind: ofColumn, isHeader }) =>
                isHeader === true
                    ? h('th', { scope: 'row', role: 'rowheader', class: ofColumn ?? '' })
                    : h('td', { role: 'cell', class: ofColumn ?? '', 'data-label': title }),
            );
            return h('tr', { role: 'row' }, ...cells);
        };
        this.#rows = new Keyed<T>(body, keyOf, make, (row, item) => {
            columns.forEach((column, index) => column.show(row.children[index] as HTMLElement, item));
        });
    }

    show(items: readonly T[]): void {
        this.#rows.show(items);
    }
}

/** The child that `make` made when this was first called for an element. */
export function only<E extends HTMLElement>(parent: HTMLElement, make: () => E): E {
    const child = parent.firstElementChild;
    if (child !== null) {
        return child as E;
    }
    const made = make();
    parent.append(made);
    return made;
}

/** A bar that shows a share of 1. */
export function progressBar(label: string): { readonly element: HTMLElement; set(share: number, text: string): void } {
    const fill = h('div', { class: 'bar-fill' });
    const element = h(
        'div',
        { class: 'bar', role: 'progressbar', 'aria-label': label, 'aria-valuemin': 0, 'aria-valuemax': 100 },
        fill,
    );
    return {
        element,
        set: (share, text) => {
            const percent = 100 * Math.min(1, Math.max(0, share));
            fill.style.width = `${percent.toFixed(2)}%`;
            setAttribute(element, 'aria-valuenow', String(Math.floor(percent)));
            setAttribute(element, 'aria-valuetext', text);
        },
    };
}

/** A short state with a colour. */
export function chip(parent: HTMLElement, word: string, label: string): void {
    const element = only(parent, () => h('span', { class: 'chip' }));
    setText(element, label);
    setAttribute(element, 'data-state', word);
}

/** A text with a button that copies it. */
export function copyField(label: string, text: string): HTMLElement {
    const id = freshId();
    const field = h('input', { id, type: 'text', readonly: true, value: text, class: 'mono', autocomplete: 'off' });
    const said = h('span', { class: 'soft', role: 'status' });
    const copy = async (): Promise<void> => {
        try {
            await navigator.clipboard.writeText(text);
            said.textContent = 'Copied.';
        } catch {
            // Browsers allow it only over HTTPS and on this machine.
            field.focus();
            field.select();
            said.textContent = 'The browser does not allow copying. The text is selected: press Ctrl+C.';
        }
    };
    return h(
        'div',
        { class: 'field' },
        h('label', { for: id }, label),
        h('div', { class: 'row nowrap' }, field, h('button', { type: 'button', onclick: () => void copy() }, 'Copy')),
        said,
    );
}
