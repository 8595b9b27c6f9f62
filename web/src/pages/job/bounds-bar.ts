// What bounds a job, as a sentence, a bar, and the same as a list.

import { h, setText } from '../dom.ts';
import { type Verdict, partText } from './bounds.ts';

export interface BoundsBar {
    readonly element: HTMLElement;
    show(verdict: Verdict | null): void;
}

export function boundsBar(): BoundsBar {
    const text = h('p', { class: 'bounds-text' });
    const advice = h('p', { class: 'soft' });
    const bar = h('div', { class: 'bounds-bar', 'aria-hidden': 'true' });
    const list = h('ul', { class: 'bounds-list', 'aria-label': 'Where the time of the job went' });
    const element = h('section', { class: 'card bounds', hidden: true }, text, bar, list, advice);
    return {
        element,
        show: (verdict) => {
            element.hidden = verdict === null;
            if (verdict === null) {
                return;
            }
            setText(text, verdict.text);
            setText(advice, verdict.advice);
            advice.hidden = verdict.advice === '';
            const pieces = verdict.parts.map(({ part, share }) => {
                const piece = h('span', { 'data-part': part });
                piece.style.flexGrow = String(share);
                return piece;
            });
            bar.replaceChildren(...pieces);
            const words = verdict.parts.map(partText);
            if (words.join() !== [...list.children].map((item) => item.textContent).join()) {
                list.replaceChildren(
                    ...verdict.parts.map((one) => h('li', { 'data-part': one.part }, partText(one))),
                );
            }
        },
    };
}
