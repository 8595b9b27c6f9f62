// Elements that several parts use, beside `h` of the viewer.

import { freshId, h } from '../../viewer/dom.ts';

const SVG = 'http://www.w3.org/2000/svg';

/** Makes an SVG element. */
export function svg<K extends keyof SVGElementTagNameMap>(
    tag: K,
    attributes: Readonly<Record<string, string | number>> = {},
    ...children: readonly (Node | string)[]
): SVGElementTagNameMap[K] {
    const element = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(attributes)) {
        element.setAttribute(name, String(value));
    }
    element.append(...children);
    return element;
}

export interface Choice<T extends string> {
    readonly element: HTMLElement;
    /** The chosen value; setting it does not call `choose`. */
    value: T;
    /** Hides what is not possible now. */
    allow(values: ReadonlySet<T>): void;
}

/** A row of buttons of which one is chosen: radio buttons, so arrow keys move through them. */
export function choice<T extends string>(
    legend: string,
    values: readonly (readonly [T, string])[],
    first: T,
    choose: (value: T) => void,
): Choice<T> {
    const name = freshId();
    const options = values.map(([value, text]) => {
        const id = freshId();
        const input = h('input', { type: 'radio', name, id, value, onchange: () => choose(value) });
        input.checked = value === first;
        return { value, input, element: h('span', { class: 'fp-option' }, input, h('label', { for: id }, text)) };
    });
    const words = h('legend', { class: 'fp-unseen' }, legend);
    const row = h('div', { class: 'fp-choice-row' }, ...options.map((option) => option.element));
    return {
        element: h('fieldset', { class: 'fp-choice' }, words, row),
        get value() {
            return options.find(({ input }) => input.checked)?.value ?? first;
        },
        set value(chosen) {
            options.forEach(({ value, input }) => (input.checked = value === chosen));
        },
        allow(allowed) {
            options.forEach(({ value, element }) => (element.hidden = !allowed.has(value)));
        },
    };
}

/** A box with its label. */
export function checkbox(
    text: string,
    change: (checked: boolean) => void,
): { element: HTMLElement; input: HTMLInputElement } {
    const id = freshId();
    const input = h('input', { type: 'checkbox', id, onchange: () => change(input.checked) });
    return { element: h('span', { class: 'fp-check' }, input, h('label', { for: id }, text)), input };
}

/** A row of a table; the first cell heads the row. */
export function tableRow(cells: readonly (string | Node)[]): HTMLTableRowElement {
    return h('tr', {}, ...cells.map((cell, i) => (i === 0 ? h('th', { scope: 'row' }, cell) : h('td', {}, cell))));
}

export interface FoldedTable {
    readonly element: HTMLElement;
    /** Draws the rows again if the table is open. */
    refresh(): void;
}

/** A table that is made when it is opened, since it may have thousands of rows. */
export function foldedTable(
    title: string,
    caption: string,
    heads: readonly string[],
    rows: () => readonly (readonly (string | Node)[])[],
): FoldedTable {
    const body = h('tbody');
    const refresh = (): void => {
        if (details.open) {
            body.replaceChildren(...rows().map(tableRow));
        }
    };
    const details = h(
        'details',
        { class: 'fp-folded', ontoggle: refresh },
        h('summary', {}, title),
        h(
            'div',
            { class: 'fp-scroll', tabindex: 0, role: 'region', 'aria-label': caption },
            h(
                'table',
                { class: 'fp-table' },
                h('caption', { class: 'fp-unseen' }, caption),
                h('thead', {}, h('tr', {}, ...heads.map((head) => h('th', { scope: 'col' }, head)))),
                body,
            ),
        ),
    );
    return { element: details, refresh };
}

/** The values of CSS variables at an element, for one drawing of a canvas. */
export function colourReader(element: Element): (name: string) => string {
    const style = getComputedStyle(element);
    const known = new Map<string, string>();
    return (name) => {
        const value = known.get(name) ?? style.getPropertyValue(name).trim();
        known.set(name, value);
        return value;
    };
}

/** Calls `redraw` when the system changes between light and dark, and when the element changes its size. */
export function watchLook(element: Element, redraw: () => void): () => void {
    const scheme = matchMedia('(prefers-color-scheme: dark)');
    scheme.addEventListener('change', redraw);
    const observer = new ResizeObserver(redraw);
    observer.observe(element);
    return () => {
        scheme.removeEventListener('change', redraw);
        observer.disconnect();
    };
}

/** Collects calls until the next frame, so that many changes draw once. */
export function oncePerFrame(draw: () => void): { request(): void; cancel(): void } {
    let frame = 0;
    return {
        request() {
            frame ||= requestAnimationFrame(() => {
                frame = 0;
                draw();
            });
        },
        cancel() {
            cancelAnimationFrame(frame);
            frame = 0;
        },
    };
}

/** Sets text only where it differs, so that screen readers do not read the same again. */
export function setText(element: Element, text: string): void {
    if (element.textContent !== text) {
        element.textContent = text;
    }
}
