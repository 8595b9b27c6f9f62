// How the training goes: loss, PSNR, Gaussians, speed and memory of each task, in charts that share x.

import 'uplot/dist/uPlot.min.css';

import { freshId, h } from '../../viewer/dom.ts';
import { Chart, type DrawnLine, type Zoom, dashStyle } from './curve-chart.ts';
import {
    type Along,
    type CurvePoint,
    type CurveSeries,
    type CurvesData,
    Looks,
    MOST_DRAWN,
    QUANTITIES,
    type Quantity,
    currentPoints,
    currentPreviews,
    firstDrawn,
    isOfPreviews,
    lineOf,
    previewLine,
    psnrTitle,
    spanOf,
    startOf,
    valueOf,
} from './curve-points.ts';
import './curves.css';
import { choice, foldedTable, oncePerFrame, setText, watchLook } from './elements.ts';
import { clock, counted, grouped } from './format.ts';
import './parts.css';
import type { Part } from './part.ts';

/** Beyond this many series the legend has a field to search in. */
const SEARCH_FROM = 24;

export function curves(container: HTMLElement): Part<CurvesData> {
    const view = new Curves();
    container.append(view.element);
    return view;
}

/** A value in words; nothing where it is not known. */
function valueText(point: CurvePoint, quantity: Quantity): string {
    const known = valueOf(point, quantity);
    return known === null ? '' : QUANTITIES[quantity].text(known);
}

class Curves implements Part<CurvesData> {
    readonly element = h('div', { class: 'fp fp-curves' });
    readonly #empty = h(
        'p',
        { class: 'fp-empty' },
        'No curves yet. They begin with the first report of a worker that trains.',
    );
    readonly #body = h('div', { hidden: true });
    readonly #legend = h('ul', { class: 'fp-legend' });
    readonly #search: HTMLInputElement;
    readonly #drawnWords = h('span', { class: 'fp-note' });
    readonly #wholeButton: HTMLButtonElement;
    readonly #charts: ReadonlyMap<Quantity, Chart>;
    readonly #looks = new Looks();
    readonly #boxes = new Map<
        string,
        { element: HTMLElement; input: HTMLInputElement; swatch: HTMLElement; label: HTMLElement }
    >();
    readonly #stop: (() => void)[];
    readonly #table = foldedTable(
        'The latest values as a table',
        'Latest point of each task',
        [
            'Task',
            'Time',
            'Attempt',
            'Iteration',
            'Loss',
            'PSNR, dB',
            'Gaussians',
            'Iterations per second',
            'GPU memory',
        ],
        () => this.#rows(),
    );
    readonly #frame = oncePerFrame(() => this.#charts.forEach((chart) => chart.showPlace(this.#x)));
    #series: readonly CurveSeries[] = [];
    #along: Along = 'iteration';
    #zoom: Zoom | null = null;
    #drawn = new Set<string>();
    /** Whether the reader chose what is drawn; until then new tasks join. */
    #isChosen = false;
    #isDark = matchMedia('(prefers-color-scheme: dark)').matches;
    #x: number | null = null;

    constructor() {
        const actions = {
            zoom: (to: Zoom | null): void => this.#setZoom(to),
            point: (x: number | null): void => {
                this.#x = x;
                this.#frame.request();
            },
        };
        const quantities = Object.keys(QUANTITIES) as Quantity[];
        this.#charts = new Map(quantities.map((quantity) => [quantity, new Chart(QUANTITIES[quantity], actions)]));
        const along = choice<Along>(
            'Draw along',
            [
                ['iteration', 'Iterations'],
                ['time', 'Time'],
            ],
            'iteration',
            (value) => {
                this.#along = value;
                this.#x = null;
                this.#setZoom(null);
                this.#draw();
            },
        );
        this.#wholeButton = h(
            'button',
            { type: 'button', class: 'fp-button', disabled: true, onclick: () => this.#setZoom(null) },
            'Show everything',
        );
        const id = freshId();
        this.#search = h('input', {
            type: 'search',
            id,
            placeholder: 'Find a task',
            'aria-label': 'Find a task',
            oninput: () => this.#filter(),
        });
        const none = h(
            'button',
            {
                type: 'button',
                class: 'fp-button',
                onclick: () => {
                    this.#isChosen = true;
                    this.#drawn.clear();
                    this.#draw();
                },
            },
            'Draw none',
        );
        this.#body.append(
            h(
                'div',
                { class: 'fp-bar' },
                along.element,
                this.#wholeButton,
                h('span', { class: 'fp-fill' }),
                this.#drawnWords,
                this.#search,
                none,
            ),
            h(
                'fieldset',
                { class: 'fp-choice fp-legend-box' },
                h('legend', { class: 'fp-unseen' }, 'Tasks to draw'),
                this.#legend,
            ),
            h(
                'p',
                { class: 'fp-note fp-curve-hint' },
                'Drag across a chart to zoom, double click to see everything.',
            ),
            h('div', { class: 'fp-curve-grid' }, ...[...this.#charts.values()].map(({ element }) => element)),
            this.#table.element,
        );
        this.element.append(this.#empty, this.#body);
        this.#stop = [watchLook(this.element, () => this.#look())];
    }

    update({ series }: CurvesData): void {
        this.#series = series
            .map((one) => ({ ...one, points: currentPoints(one.points) }))
            .filter(({ points }) => points.length > 0);
        const known = new Set(this.#series.map(({ task }) => task));
        [...this.#drawn].filter((task) => !known.has(task)).forEach((task) => this.#drawn.delete(task));
        const isEmpty = this.#series.length === 0;
        this.#empty.hidden = !isEmpty;
        this.#body.hidden = isEmpty;
        if (!isEmpty) {
            if (!this.#isChosen && this.#drawn.size < MOST_DRAWN) {
                // What is drawn already stays, so that colours and lines do not jump.
                const more = firstDrawn(this.#series).filter((task) => !this.#drawn.has(task));
                more.slice(0, MOST_DRAWN - this.#drawn.size).forEach((task) => this.#drawn.add(task));
            }
            this.#draw();
        }
    }

    destroy(): void {
        this.#stop.forEach((stop) => stop());
        this.#frame.cancel();
        this.#charts.forEach((chart) => chart.destroy());
        this.element.remove();
    }

    #look(): void {
        const isDark = matchMedia('(prefers-color-scheme: dark)').matches;
        if (isDark !== this.#isDark) {
            this.#isDark = isDark;
            this.#charts.forEach((chart) => chart.recolour());
            this.#draw();
        }
        this.#charts.forEach((chart) => chart.resize());
    }

    #setZoom(zoom: Zoom | null): void {
        this.#zoom = zoom;
        this.#wholeButton.disabled = zoom === null;
        this.#charts.forEach((chart) => chart.setZoom(zoom));
    }

    #draw(): void {
        this.#looks.keep(this.#drawn);
        this.#drawLegend();
        const startMs = startOf(this.#series);
        const drawn = this.#series.filter(({ task }) => this.#drawn.has(task));
        // All charts show the same part of x, also where one of them has values for a part only.
        const whole = spanOf(drawn, this.#along, startMs);
        for (const [quantity, chart] of this.#charts) {
            const lines = drawn.map((one): DrawnLine => {
                const hasPreviews = quantity === 'psnr' && isOfPreviews(one);
                return {
                    task: one.task,
                    label: hasPreviews ? `${one.label}, previews` : one.label,
                    line: hasPreviews
                        ? previewLine(one, this.#along, startMs)
                        : lineOf(one.points, quantity, this.#along, startMs),
                    ...this.#looks.of(one.task),
                };
            });
            chart.call(quantity === 'psnr' ? psnrTitle(drawn) : QUANTITIES[quantity].title);
            chart.draw(lines, this.#along, whole, this.#zoom);
        }
        setText(this.#drawnWords, `${grouped(drawn.length)} of ${counted(this.#series.length, 'task')} drawn`);
        this.#table.refresh();
    }

    #drawLegend(): void {
        const known = new Set(this.#series.map(({ task }) => task));
        for (const [task, box] of this.#boxes) {
            if (!known.has(task)) {
                box.element.remove();
                this.#boxes.delete(task);
            }
        }
        const isLong = this.#series.length >= SEARCH_FROM;
        if (
            isLong &&
            this.#series.some(({ task }) => !this.#boxes.has(task)) &&
            !this.#legend.contains(document.activeElement)
        ) {
            // What is drawn comes first, where it is seen without scrolling.
            const order = this.#series.toSorted(
                (a, b) => Number(this.#drawn.has(b.task)) - Number(this.#drawn.has(a.task)),
            );
            order.forEach(({ task }) => this.#legend.append((this.#boxes.get(task) ?? this.#makeBox(task)).element));
        }
        for (const { task, label } of this.#series) {
            const box = this.#boxes.get(task) ?? this.#makeBox(task);
            const isDrawn = this.#drawn.has(task);
            const { colour, dash } = this.#looks.of(task);
            box.input.checked = isDrawn;
            setText(box.label, label);
            box.swatch.style.borderTopColor = isDrawn ? `var(${colour})` : 'var(--line)';
            box.swatch.style.borderTopStyle = isDrawn ? dashStyle(dash) : 'solid';
        }
        this.#legend.classList.toggle('fp-legend-long', isLong);
        this.#search.hidden = !isLong;
        this.#filter();
    }

    #makeBox(task: string): {
        element: HTMLElement;
        input: HTMLInputElement;
        swatch: HTMLElement;
        label: HTMLElement;
    } {
        const id = freshId();
        const input = h('input', {
            type: 'checkbox',
            id,
            onchange: () => {
                this.#isChosen = true;
                if (input.checked) {
                    this.#drawn.add(task);
                } else {
                    this.#drawn.delete(task);
                }
                this.#draw();
            },
        });
        const swatch = h('span', { class: 'fp-swatch', 'aria-hidden': 'true' });
        const label = h('label', { for: id });
        const element = h('li', { class: 'fp-check' }, input, swatch, label);
        this.#legend.append(element);
        const box = { element, input, swatch, label };
        this.#boxes.set(task, box);
        return box;
    }

    #filter(): void {
        const wanted = this.#search.value.trim().toLowerCase();
        for (const [task, { element, label }] of this.#boxes) {
            element.hidden = wanted !== '' && !`${task} ${label.textContent}`.toLowerCase().includes(wanted);
        }
    }

    #rows(): string[][] {
        return this.#series.map((series) => {
            const { label, points } = series;
            const last = points.at(-1)!;
            const preview = isOfPreviews(series) ? currentPreviews(series).at(-1) : undefined;
            return [
                label,
                clock(last.timeMs),
                String(last.attempt),
                grouped(last.iteration),
                valueText(last, 'loss'),
                preview === undefined ? valueText(last, 'psnr') : `${QUANTITIES.psnr.text(preview.psnr)} (previews)`,
                valueText(last, 'gaussians'),
                valueText(last, 'rate'),
                valueText(last, 'memory'),
            ];
        });
    }
}
