// One chart of the curves: uPlot, with zoom along x that all charts share, and keys for what the mouse does.

import uPlot from 'uplot';

import { h } from '../../viewer/dom.ts';
import { colourReader, setText } from './elements.ts';
import { duration } from './format.ts';
import { type Along, type ChartWords, type Line, joined, placeText, valueAt } from './curve-points.ts';

/** A series as the chart draws it. */
export interface DrawnLine {
    readonly task: string;
    readonly label: string;
    readonly line: Line;
    readonly colour: string;
    readonly dash: readonly number[];
    /** Thin and without a value below the chart: what the others are compared with. */
    readonly isBehind?: boolean;
    /** An edge of a band, which is no line by itself; it is behind too. */
    readonly isEdge?: boolean;
    /** Of the upper edge of a band: the task of its lower edge. */
    readonly bandTo?: string;
}

export interface Zoom {
    readonly min: number;
    readonly max: number;
}

export interface ChartActions {
    zoom(to: Zoom | null): void;
    /** The cursor is at this place of x; null where it left. */
    point(x: number | null): void;
}

const HEIGHT = 190;
const WIDTH = 1.75;
const WIDTH_BEHIND = 0.75;
/** How much of a line behind is seen, as two digits after a colour. */
const OPACITY_BEHIND = '80';
/** Steps between marks along time, seconds. */
const TIME_STEPS = [
    1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10_800, 21_600, 43_200, 86_400, 172_800,
];
/** How much of a band is seen. */
const OPACITY_BAND = '2e';
const FONT = '12px system-ui, sans-serif';

/** Of the marks of a logarithm only 1, 2 and 5 times powers of ten; the rest would be a wall of lines. */
const roundOnly = (_: uPlot, splits: number[]): (number | null)[] =>
    splits.map((value) =>
        [1, 2, 5].includes(Math.round(value / 10 ** Math.floor(Math.log10(value * (1 + 1e-9))))) ? value : null,
    );

export class Chart {
    readonly element: HTMLElement;
    readonly #words: ChartWords;
    readonly #actions: ChartActions;
    readonly #title = h('h3');
    readonly #place = h('span', { class: 'fp-curve-place' });
    readonly #stage: HTMLElement;
    readonly #readout = h('ul', { class: 'fp-curve-readout' });
    readonly #nothing = h('p', { class: 'fp-curve-nothing', hidden: true });
    #plot: uPlot | null = null;
    #lines: readonly DrawnLine[] = [];
    #key = '';
    #along: Along = 'iteration';
    #whole: Zoom = { min: 0, max: 1 };
    #zoom: Zoom | null = null;
    #x: number | null = null;

    constructor(words: ChartWords, actions: ChartActions) {
        this.#words = words;
        this.#actions = actions;
        this.#stage = h('div', {
            class: 'fp-curve-stage',
            tabindex: 0,
            role: 'application',
            'aria-roledescription': 'chart',
            onkeydown: (event) => this.#press(event as KeyboardEvent),
            onblur: () => this.#actions.point(null),
        });
        const head = h('header', { class: 'fp-curve-head' }, this.#title, this.#place);
        this.element = h('section', { class: 'fp-curve' }, head, this.#nothing, this.#stage, this.#readout);
        this.call(words.title);
    }

    /** Gives the chart another title. */
    call(title: string): void {
        setText(this.#title, title);
        this.#stage.setAttribute(
            'aria-label',
            `${title}. Arrow keys move the cursor, + and − zoom, 0 shows everything.`,
        );
    }

    /** Draws lines; the zoom stays unless another is given. */
    draw(lines: readonly DrawnLine[], along: Along, whole: Zoom, zoom: Zoom | null): void {
        this.#whole = whole;
        this.#lines = lines;
        this.#zoom = zoom;
        const isEmpty = lines.every(({ line }) => line.xs.length === 0);
        this.#nothing.hidden = !isEmpty;
        this.#stage.hidden = isEmpty;
        this.#readout.hidden = isEmpty;
        this.#nothing.textContent = lines.length === 0 ? 'Choose a task above.' : this.#words.nothing;
        if (isEmpty) {
            this.#drop();
            return;
        }
        const { xs, columns } = joined(lines.map(({ line }) => line));
        const data = [xs, ...columns] as uPlot.AlignedData;
        const key = `${along} ${lines.map(({ task, colour, dash }) => `${task} ${colour} ${dash.join('-')}`).join(', ')}`;
        if (key !== this.#key || this.#plot === null) {
            // Other lines or another axis: uPlot takes its options only once.
            this.#drop();
            this.#key = key;
            this.#along = along;
            this.#plot = new uPlot(this.#options(lines, along), data, this.#stage);
        } else {
            // The scales follow in `#applyZoom`.
            this.#plot.setData(data, false);
        }
        this.#applyZoom();
        this.showPlace(this.#x);
    }

    setZoom(zoom: Zoom | null): void {
        this.#zoom = zoom;
        this.#applyZoom();
    }

    /** Shows the values at a place of x, also where the cursor is in another chart. */
    showPlace(x: number | null): void {
        this.#x = x;
        this.#place.textContent = x === null ? 'latest' : placeText(x, this.#along);
        const { text } = this.#words;
        const shown = this.#lines.filter(({ isBehind }) => isBehind !== true);
        this.#readout.replaceChildren(
            ...shown.map(({ label, line, colour, dash }) => {
                const value = x === null ? valueAt(line, Infinity) : valueAt(line, x);
                const mark = h('span', { class: 'fp-swatch', 'aria-hidden': 'true' });
                mark.style.borderTopColor = `var(${colour})`;
                mark.style.borderTopStyle = dashStyle(dash);
                return h('li', {}, mark, h('span', {}, `${label} `, h('b', {}, value === null ? '–' : text(value))));
            }),
        );
        const plot = this.#plot;
        if (plot !== null && x !== null && plot.cursor.idx !== plot.valToIdx(x)) {
            plot.setCursor({ left: plot.valToPos(x, 'x'), top: -10 }, false);
        } else if (plot !== null && x === null) {
            plot.setCursor({ left: -10, top: -10 }, false);
        }
    }

    resize(): void {
        const width = this.#stage.clientWidth;
        if (this.#plot !== null && width > 0 && width !== this.#plot.width) {
            this.#plot.setSize({ width, height: HEIGHT });
        }
    }

    /** Reads the colours again. */
    recolour(): void {
        this.#key = '';
    }

    destroy(): void {
        this.#drop();
        this.element.remove();
    }

    #drop(): void {
        this.#plot?.destroy();
        this.#plot = null;
        this.#key = '';
    }

    #applyZoom(): void {
        const plot = this.#plot;
        if (plot === null) {
            return;
        }
        plot.setScale('x', this.#zoom ?? this.#whole);
    }

    #options(lines: readonly DrawnLine[], along: Along): uPlot.Options {
        const colour = colourReader(this.element);
        const axis = { stroke: colour('--soft'), font: FONT, grid: { stroke: colour('--line'), width: 1 } };
        const { isLog, axisText, hasPoints, steps } = this.#words;
        const isTime = along === 'time';
        return {
            width: Math.max(200, this.#stage.clientWidth),
            height: HEIGHT,
            padding: [8, 24, 0, 0],
            legend: { show: false },
            scales: { x: { time: false }, y: isLog ? { distr: 3 } : {} },
            series: [
                {},
                ...lines.map(({ label, colour: name, dash, line, isBehind, isEdge }): uPlot.Series => ({
                    label,
                    stroke: isEdge === true ? 'transparent' : `${colour(name)}${isBehind === true ? OPACITY_BEHIND : ''}`,
                    width: isBehind === true ? WIDTH_BEHIND : WIDTH,
                    dash: [...dash],
                    points: {
                        show: isEdge !== true && (hasPoints === true || line.xs.length < 3),
                        size: 5,
                        fill: colour(name),
                    },
                })),
            ],
            // The first series is x.
            bands: lines.flatMap(({ bandTo, colour: name }, upper): uPlot.Band[] => {
                const lower = lines.findIndex(({ task }) => task === bandTo);
                return lower < 0
                    ? []
                    : [{ series: [upper + 1, lower + 1], fill: `${colour(name)}${OPACITY_BAND}` }];
            }),
            axes: [
                {
                    ...axis,
                    size: 28,
                    ticks: { stroke: colour('--line'), size: 4 },
                    ...(isTime ? { incrs: TIME_STEPS, space: 70 } : { space: 60 }),
                    values: (_, splits) =>
                        splits.map((x) => (isTime ? duration(1000 * x) : x.toLocaleString('en-GB'))),
                },
                {
                    ...axis,
                    size: 64,
                    ticks: { show: false },
                    ...(isLog ? { filter: roundOnly, grid: { ...axis.grid, filter: roundOnly } } : {}),
                    values: (_, splits) =>
                        splits.map((y: number | null) => (y === null ? '' : axisText(y))),
                    ...(steps === undefined ? {} : { incrs: [...steps] }),
                },
            ],
            cursor: {
                y: false,
                drag: { x: true, y: false, setScale: false },
                points: { size: 7 },
                bind: {
                    dblclick: () => () => {
                        this.#actions.zoom(null);
                        return null;
                    },
                },
            },
            hooks: {
                setSelect: [
                    (plot) => {
                        if (plot.select.width > 4) {
                            const { left, width } = plot.select;
                            this.#actions.zoom({
                                min: plot.posToVal(left, 'x'),
                                max: plot.posToVal(left + width, 'x'),
                            });
                            plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
                        }
                    },
                ],
                setCursor: [
                    (plot) => {
                        const { idx, left } = plot.cursor;
                        const x =
                            idx === null || idx === undefined || (left ?? -1) < 0
                                ? null
                                : (plot.data[0][idx] ?? null);
                        if (x !== this.#x) {
                            this.#actions.point(x);
                        }
                    },
                ],
            },
        };
    }

    #press(event: KeyboardEvent): void {
        const plot = this.#plot;
        if (plot === null || event.ctrlKey || event.metaKey || event.altKey) {
            return;
        }
        const xs = plot.data[0];
        const { min = 0, max = 1 } = plot.scales['x'] as { min?: number; max?: number };
        const at = this.#x === null ? plot.valToIdx(max) : plot.valToIdx(this.#x);
        const moves: Record<string, number> = {
            ArrowLeft: -1,
            ArrowRight: 1,
            PageUp: -10,
            PageDown: 10,
            Home: -Infinity,
            End: Infinity,
        };
        const by = moves[event.key];
        const middle = this.#x ?? (min + max) / 2;
        const zoom = (factor: number): void => {
            const [left, right] = [middle - (middle - min) * factor, middle + (max - middle) * factor];
            const [from, to] = [Math.max(left, this.#whole.min), Math.min(right, this.#whole.max)];
            this.#actions.zoom(from === this.#whole.min && to === this.#whole.max ? null : { min: from, max: to });
        };
        if (by !== undefined) {
            const to = Math.min(
                xs.length - 1,
                Math.max(0, this.#x === null && by < 0 && by > -Infinity ? at : at + by),
            );
            this.#actions.point(xs[to] ?? null);
        } else if (event.key === '+' || event.key === '=') {
            zoom(0.6);
        } else if (event.key === '-') {
            zoom(1 / 0.6);
        } else if (event.key === '0' || event.key === 'Escape') {
            this.#actions.zoom(null);
        } else {
            return;
        }
        event.preventDefault();
    }
}

/** The line style of a swatch, for dashes of a line. */
export const dashStyle = (dash: readonly number[]): string =>
    dash.length === 0 ? 'solid' : (dash[0] ?? 0) > 3 ? 'dashed' : 'dotted';
