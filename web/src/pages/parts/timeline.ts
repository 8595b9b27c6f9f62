// The course of a job: a row for each task, a bar for each attempt, and a list of what went wrong.

import { h } from '../../viewer/dom.ts';
import { setText, svg } from './elements.ts';
import { clock, counted, duration, grouped, timeStep } from './format.ts';
import './parts.css';
import './timeline.css';
import type { Part } from './part.ts';
import {
    type Bar,
    type Note,
    OUTCOMES,
    type Outcome,
    type Row,
    type Timeline,
    type TimelineData,
    barText,
    timelineOf,
} from './timeline-bars.ts';

/** Rows of a stage at first, and how many more each press of the button adds. */
const FIRST_ROWS = 24;
const MORE_ROWS = 100;
const FIRST_NOTES = 20;
/** Least width of a bar, percent of the track: the shortest attempt can still be seen and hit. */
const LEAST_BAR = 0.4;

/** The width that a letter of a label of the axis may need, pixels. */
const LETTER_PX = 7;

export function timeline(container: HTMLElement): Part<TimelineData> {
    const view = new TimelineView();
    container.append(view.element);
    return view;
}

interface RowElements {
    readonly element: HTMLElement;
    readonly label: HTMLElement;
    readonly track: HTMLElement;
    readonly bars: Map<string, HTMLElement>;
}

const more = (onclick: () => void): HTMLButtonElement => h('button', { type: 'button', class: 'fp-button', onclick });

const sample = (outcome: Outcome): HTMLElement =>
    h('span', { class: 'fp-time-bar fp-time-sample', 'data-outcome': outcome, 'aria-hidden': 'true' });

class TimelineView implements Part<TimelineData> {
    readonly element = h('div', { class: 'fp fp-time' });
    readonly #empty = h(
        'p',
        { class: 'fp-empty' },
        'Nothing has run yet. Attempts appear here as workers take tasks.',
    );
    readonly #body = h('div', { hidden: true });
    readonly #summary = h('p', { class: 'fp-note' });
    readonly #axis = h('div', { class: 'fp-time-axis', 'aria-hidden': 'true' });
    readonly #list = h('ol', { class: 'fp-time-rows' });
    readonly #legend = h('ul', { class: 'fp-time-legend', 'aria-label': 'How attempts end' });
    readonly #detail = h('p', { class: 'fp-time-detail', 'aria-live': 'polite' });
    readonly #more: HTMLButtonElement;
    readonly #notesTitle = h('h3');
    readonly #notes = h('ol', { class: 'fp-notes' });
    readonly #moreNotes: HTMLButtonElement;
    readonly #rows = new Map<string, RowElements>();
    #mostRows = FIRST_ROWS;
    #mostNotes = FIRST_NOTES;
    #data: TimelineData | null = null;
    #shown: { readonly bar: string; readonly row: string } | null = null;
    #notesKey = '';

    constructor() {
        this.#more = more(() => {
            this.#mostRows += MORE_ROWS;
            this.#draw();
        });
        this.#moreNotes = more(() => {
            this.#mostNotes = Infinity;
            this.#draw();
        });
        this.#body.append(
            this.#summary,
            h('div', { class: 'fp-time-chart' }, this.#axis, this.#list),
            this.#more,
            this.#legend,
            this.#detail,
            h('section', { class: 'fp-time-notes' }, this.#notesTitle, this.#notes, this.#moreNotes),
        );
        this.element.append(this.#empty, this.#body);
    }

    update(data: TimelineData): void {
        this.#data = data;
        this.#draw();
    }

    destroy(): void {
        this.element.remove();
    }

    #draw(): void {
        if (this.#data === null) {
            return;
        }
        const time = timelineOf(this.#data, this.#mostRows);
        const isEmpty =
            time.rows.every(({ bars, folded }) => bars.length === 0 && folded === null) && time.notes.length === 0;
        this.#empty.hidden = !isEmpty;
        this.#body.hidden = isEmpty;
        if (isEmpty) {
            return;
        }
        const pauses = time.pauses.length === 0 ? '' : ' Hatched: the job was paused.';
        setText(
            this.#summary,
            `Begun ${clock(time.startMs)}; ${duration(time.endMs - time.startMs)} so far.${pauses}`,
        );
        if (this.#data.events.some(({ kind, state }) => kind === 'job_state' && state === 'succeeded')) {
            setText(
                this.#summary,
                `Begun ${clock(time.startMs)}; took ${duration(time.endMs - time.startMs)}.${pauses}`,
            );
        }
        this.#drawAxis(time);
        this.#drawRows(time);
        this.#more.hidden = time.hidden === 0;
        const all = time.hidden <= MORE_ROWS;
        setText(
            this.#more,
            all
                ? `Show ${counted(time.hidden, 'more task', 'more tasks')}`
                : `Show ${MORE_ROWS} of ${grouped(time.hidden)} more tasks`,
        );
        this.#drawLegend(time);
        this.#drawNotes(time);
    }

    #drawAxis({ startMs, endMs, pauses }: Timeline): void {
        const length = endMs - startMs;
        const step = timeStep(length, this.#axis.clientWidth < 420 ? 4 : 8);
        const at = (ms: number): string => `${(100 * ms) / length}%`;
        const marks: HTMLElement[] = [];
        for (let ms = 0; ms <= length; ms += step) {
            const text = ms === 0 ? '0' : duration(ms);
            const isLast = ms / length > 0.94;
            // On a phone the label of a mark near the end would leave the window.
            const room = (1 - ms / length) * this.#axis.clientWidth;
            const hasRoom = isLast || ms === 0 || room >= LETTER_PX * text.length;
            const mark = h('span', { class: 'fp-time-mark' }, h('span', {}, hasRoom ? text : ''));
            mark.style.left = at(ms);
            mark.classList.toggle('fp-time-last', isLast);
            marks.push(mark);
        }
        for (const pause of pauses) {
            const band = h('span', { class: 'fp-time-pause' });
            band.style.left = at(pause.startMs - startMs);
            band.style.width = at(pause.endMs - pause.startMs);
            marks.push(band);
        }
        this.#axis.replaceChildren(...marks);
    }

    #drawRows(time: Timeline): void {
        const keys = new Set(time.rows.map(({ key }) => key));
        for (const [key, row] of this.#rows) {
            if (!keys.has(key)) {
                row.element.remove();
                this.#rows.delete(key);
            }
        }
        time.rows.forEach((row, i) => {
            const elements = this.#rows.get(row.key) ?? this.#makeRow(row);
            // Moved only where its place is another, so that the focus stays.
            if (this.#list.children[i] !== elements.element) {
                this.#list.insertBefore(elements.element, this.#list.children[i] ?? null);
            }
            setText(elements.label, row.label);
            if (row.folded !== null) {
                this.#drawFolded(row, elements, time);
            } else {
                this.#drawBars(row, elements, time);
            }
        });
    }

    #makeRow(row: Row): RowElements {
        const label = h('span', { class: 'fp-time-label' });
        const track = h('span', { class: 'fp-time-track' });
        const element = h(
            'li',
            { class: row.folded === null ? 'fp-time-row' : 'fp-time-row fp-time-many' },
            label,
            track,
        );
        const elements = { element, label, track, bars: new Map<string, HTMLElement>() };
        this.#rows.set(row.key, elements);
        return elements;
    }

    #drawBars(row: Row, { track, bars }: RowElements, { startMs, endMs }: Timeline): void {
        const length = endMs - startMs;
        const keys = new Set<string>();
        row.bars.forEach((bar) => {
            const key = `${bar.attempt} ${bar.startMs}`;
            keys.add(key);
            const element = bars.get(key) ?? this.#makeBar(key, row.key);
            if (!bars.has(key)) {
                bars.set(key, element);
                track.append(element);
            }
            const width = Math.max(LEAST_BAR, (100 * (bar.endMs - bar.startMs)) / length);
            element.style.left = `${Math.min(100 - LEAST_BAR, (100 * (bar.startMs - startMs)) / length)}%`;
            element.style.width = `${width}%`;
            element.dataset['outcome'] = bar.outcome;
            element.setAttribute('aria-label', barText(bar));
            if (this.#shown?.row === row.key && this.#shown.bar === key) {
                this.#describe(bar);
            }
        });
        for (const [key, element] of bars) {
            if (!keys.has(key)) {
                element.remove();
                bars.delete(key);
            }
        }
        const waits =
            row.bars.length === 0 ? (row.state === 'ready' || row.state === 'blocked' ? 'waiting' : row.state) : '';
        if (waits === '') {
            delete track.dataset['text'];
        } else {
            track.dataset['text'] = waits;
        }
    }

    #makeBar(key: string, row: string): HTMLElement {
        const show = (): void => {
            this.#shown = { bar: key, row };
            this.#draw();
        };
        const button = h('button', {
            type: 'button',
            class: 'fp-time-bar',
            onpointerenter: show,
            onfocus: show,
            onclick: show,
        });
        return button;
    }

    #describe(bar: Bar): void {
        setText(this.#detail, `${clock(bar.startMs)}: ${barText(bar)}.`);
    }

    /** Many tasks in one row: how many of them run at each time. */
    #drawFolded({ folded }: Row, { track }: RowElements, { startMs, endMs }: Timeline): void {
        const { load, words } = folded!;
        const most = Math.max(1, ...load.map(({ count }) => count));
        const x = (ms: number): string => ((1000 * (ms - startMs)) / (endMs - startMs)).toFixed(2);
        const y = (count: number): string => (20 - (18 * count) / most).toFixed(2);
        const steps = load.map(({ timeMs, count }) => `H${x(timeMs)}V${y(count)}`).join('');
        const area = load.length === 0 ? '' : `M${x(load[0]!.timeMs)} 20${steps}V20Z`;
        const text = `${words}; at most ${most} at a time`;
        const picture = svg('svg', { viewBox: '0 0 1000 20', preserveAspectRatio: 'none', 'aria-hidden': 'true' });
        picture.append(svg('path', { d: area }));
        track.replaceChildren(picture, h('span', { class: 'fp-time-words' }, load.length === 0 ? words : text));
    }

    /** The marks that are drawn now. */
    #drawLegend({ rows }: Timeline): void {
        const drawn = new Set(rows.flatMap(({ bars }) => bars.map(({ outcome }) => outcome)));
        const shown = (Object.keys(OUTCOMES) as Outcome[]).filter((outcome) => drawn.has(outcome));
        this.#legend.replaceChildren(...shown.map((outcome) => h('li', {}, sample(outcome), OUTCOMES[outcome])));
    }

    #drawNotes({ notes }: Timeline): void {
        setText(this.#notesTitle, notes.length === 0 ? 'Nothing went wrong so far' : 'What happened');
        const shown = notes.slice(0, this.#mostNotes);
        this.#moreNotes.hidden = shown.length === notes.length;
        setText(this.#moreNotes, `Show all ${notes.length}`);
        const key = shown.map(({ timeMs, text }) => `${timeMs} ${text}`).join('\n');
        if (key === this.#notesKey) {
            return;
        }
        this.#notesKey = key;
        const entry = ({ timeMs, task, text }: Note): HTMLElement =>
            h(
                'li',
                {},
                h('time', { datetime: new Date(timeMs).toISOString() }, clock(timeMs, this.#data?.nowMs)),
                h('span', {}, task === null ? null : h('strong', {}, task), task === null ? text : ` ${text}`),
            );
        this.#notes.replaceChildren(...shown.map(entry));
    }
}
