// What every page has.

import type { Connection } from './connection.ts';
import { h } from './dom.ts';
import type { Fault } from './faults.ts';
import type { Session } from './session.ts';

export interface Context {
    readonly session: Session;
    readonly connection: Connection;
    /** Ends when the page is left. */
    readonly signal: AbortSignal;
    /** Sets the title of the window. */
    title(text: string): void;
    /** Says something for a while, also to a screen reader. */
    say(text: string): void;
}

/** A message in place of something that cannot be shown. */
export function problem(title: string, text: string, ...more: readonly (Node | null)[]): HTMLElement {
    return h('div', { class: 'empty', role: 'alert' }, h('h2', {}, title), h('p', {}, text), ...more);
}

/** A message in place of a whole page. */
export function problemPage(title: string, text: string, ...more: readonly (Node | null)[]): HTMLElement {
    return h('div', { class: 'empty', role: 'alert' }, h('h1', { tabindex: -1 }, title), h('p', {}, text), ...more);
}

/** What a page shows in place of its content after a fault; null where it is shown elsewhere or passes. */
export function problemOf(title: string, fault: Fault): HTMLElement | null {
    return fault.kind === 'ended' || fault.kind === 'token' || fault.kind === 'lost' ? null : problem(title, fault.message);
}
