// How the water settles while it is trained: its nine numbers over the iterations, and how partitions differ.

import 'uplot/dist/uPlot.min.css';

import { freshId, h } from '../../viewer/dom.ts';
import { Chart, type DrawnLine, type Zoom } from './curve-chart.ts';
import { type ChartWords, currentPoints, lineBy, spanOf } from './curve-points.ts';
import './curves.css';
import { foldedTable, oncePerFrame, setText, tableRow, watchLook } from './elements.ts';
import { brief, counted, grouped, percent } from './format.ts';
import './parts.css';
import type { Part } from './part.ts';
import './water-panel.css';
import {
    type Spread,
    type WaterPoint,
    type WaterSeries,
    bandOf,
    errorBandOf,
    firstShown,
    spreadOfPartitions,
    waterAt,
} from './water-points.ts';
import { colourTable, numberTables } from './water-panel.ts';
import { CHANNELS, PARAMETERS, type Parameter } from './water-values.ts';

export interface WaterSettlingData {
    /** In the order of the tasks. */
    readonly series: readonly WaterSeries[];
    /** Whether the latest water is shown: its numbers with their errors, and the colours that it makes. */
    readonly showsLatest?: boolean;
    /** `extent.viewing_distance` of plan.json, scene units. */
    readonly viewingDistance?: number | null;
}

/** Short, so that the three charts fit beside each other. */
const TITLES: Readonly<Record<Parameter, string>> = {
    beta_d: 'Attenuation, 1/scene unit',
    beta_b: 'Backscatter, 1/scene unit',
    b_inf: 'Open water, linear light',
};
const COLOURS = ['--red-light', '--green-light', '--blue-light'] as const;
const NAMES = Object.keys(PARAMETERS) as Parameter[];

export function waterSettling(container: HTMLElement): Part<WaterSettlingData> {
    const part = new WaterSettling();
    container.append(part.element);
    return part;
}

const wordsOf = (name: Parameter): ChartWords => ({
    title: TITLES[name],
    isLog: false,
    text: (value) => brief(value),
    axisText: (value) => String(Number(value.toPrecision(3))),
    nothing: 'No values yet.',
});

const spreadCell = ({ lowest, highest, share }: Spread): Node =>
    h(
        'span',
        { class: 'fp-number' },
        `${brief(lowest)} to ${brief(highest)}`,
        share === null ? null : h('small', {}, ` ${percent(share)} apart`),
    );

/** The spread of one channel between tasks, and their mean; nothing for one task, and where all agree. */
function bandLines(series: readonly WaterSeries[], name: Parameter, channel: number): DrawnLine[] {
    const band = bandOf(series, (point) => point[name][channel]!);
    if (band === null || band.highest.ys.every((value, i) => value === band.lowest.ys[i])) {
        return [];
    }
    const common = { label: '', colour: COLOURS[channel]!, dash: [], isBehind: true };
    const [lowest, highest] = [`lowest ${channel}`, `highest ${channel}`];
    return [
        { ...common, task: lowest, line: band.lowest, isEdge: true },
        { ...common, task: highest, line: band.highest, isEdge: true, bandTo: lowest },
        { ...common, task: `mean ${channel}`, line: band.mean, dash: [4, 3] },
    ];
}

interface ErrorLines {
    readonly lines: readonly DrawnLine[];
    /** Whether an error is so large that not all of it is drawn. */
    readonly isCut: boolean;
}

/** One standard error around the line of each channel, where it is determined. */
function errorLines(series: WaterSeries, name: Parameter): ErrorLines {
    const top = Math.max(...series.points.flatMap((point) => point[name]), 1e-9);
    let isCut = false;
    const lines = CHANNELS.flatMap((_, channel): DrawnLine[] => {
        const band = errorBandOf(series, name, channel, top);
        if (band === null) {
            return [];
        }
        isCut ||= band.isCut;
        const common = { label: '', colour: COLOURS[channel]!, dash: [], isBehind: true, isEdge: true };
        const [lower, upper] = [`${series.task} lower ${channel}`, `${series.task} upper ${channel}`];
        return [
            { ...common, task: lower, line: band.lower },
            { ...common, task: upper, line: band.upper, bandTo: lower },
        ];
    });
    return { lines, isCut };
}

/** What the bands around lines are. */
function bandWords(errors: readonly ErrorLines[]): string {
    if (errors.every(({ lines }) => lines.length === 0)) {
        return '';
    }
    const cut = errors.some(({ isCut }) => isCut) ? ' The largest are cut off above.' : '';
    return ` Bands: ± one standard error.${cut}`;
}

class WaterSettling implements Part<WaterSettlingData> {
    readonly element = h('div', { class: 'fp fp-water' });
    readonly #select: HTMLSelectElement;
    readonly #picker: HTMLElement;
    readonly #about = h('p', { class: 'fp-note fp-curve-hint' });
    readonly #charts: ReadonlyMap<Parameter, Chart>;
    readonly #latest = h('div', { class: 'fp-water-now', hidden: true });
    readonly #spread = h('section', { class: 'fp-water-spread', hidden: true });
    readonly #table = foldedTable(
        'The latest water of each task as a table',
        'Latest water parameters of each task',
        [
            'Task',
            'Iteration',
            ...NAMES.flatMap((name) => CHANNELS.map((channel) => `${name} ${channel.toLowerCase()}`)),
        ],
        () => this.#rows(),
    );
    readonly #frame = oncePerFrame(() => this.#charts.forEach((chart) => chart.showPlace(this.#x)));
    readonly #stop: () => void;
    #series: readonly WaterSeries[] = [];
    #data: WaterSettlingData = { series: [] };
    /** Of which moment the numbers and colours are. */
    #latestOf = '';
    #options = '';
    #isChosen = false;
    #zoom: Zoom | null = null;
    #x: number | null = null;
    #isDark = matchMedia('(prefers-color-scheme: dark)').matches;

    constructor() {
        const id = freshId();
        this.#select = h('select', {
            id,
            onchange: () => {
                this.#isChosen = true;
                this.#setZoom(null);
                this.#draw();
            },
        });
        this.#picker = h('div', { class: 'fp-bar' }, h('label', { for: id }, 'Water of'), this.#select);
        const actions = {
            zoom: (to: Zoom | null): void => this.#setZoom(to),
            point: (x: number | null): void => {
                this.#x = x;
                this.#frame.request();
            },
        };
        this.#charts = new Map(NAMES.map((name) => [name, new Chart(wordsOf(name), actions)]));
        const charts = [...this.#charts.values()];
        this.element.append(
            this.#picker,
            this.#about,
            h('div', { class: 'fp-water-grid fp-water-curves' }, ...charts.map(({ element }) => element)),
            this.#latest,
            this.#spread,
            this.#table.element,
        );
        this.#stop = watchLook(this.element, () => this.#look());
    }

    update(data: WaterSettlingData): void {
        this.#data = data;
        this.#series = data.series
            .map((one) => ({ ...one, points: currentPoints(one.points) }))
            .filter(({ points }) => points.length > 0);
        const options = this.#series.map(({ task }) => task).join(' ');
        const chosen = this.#isChosen ? this.#select.value : '';
        if (options !== this.#options) {
            this.#options = options;
            this.#select.replaceChildren(
                ...this.#series.map(({ task, label }) => h('option', { value: task }, label)),
            );
        }
        const shown = this.#series.find(({ task }) => task === chosen) ?? firstShown(this.#series);
        this.#select.value = shown?.task ?? '';
        this.#picker.hidden = this.#series.length < 2;
        this.#draw();
    }

    destroy(): void {
        this.#stop();
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
        this.#charts.forEach((chart) => chart.setZoom(zoom));
    }

    #draw(): void {
        const shown = this.#series.find(({ task }) => task === this.#select.value);
        if (shown === undefined) {
            return;
        }
        const ofStage = this.#series.filter((one) => one.stage === shown.stage);
        const last = shown.points.at(-1)!;
        const place = `${shown.label} at iteration ${grouped(last.iteration)}.`;
        const whole = spanOf(ofStage, 'iteration', 0);
        // What is drawn last lies on top.
        const between = new Map(
            NAMES.map((name) => [name, CHANNELS.flatMap((_, i) => bandLines(ofStage, name, i))]),
        );
        // Two kinds of bands of the same colours could not be told apart.
        const isSpread = [...between.values()].some((lines) => lines.length > 0);
        const errors = new Map(NAMES.map((name) => [name, errorLines(shown, name)]));
        for (const [name, chart] of this.#charts) {
            const bands = isSpread ? between.get(name)! : errors.get(name)!.lines;
            const own = CHANNELS.map((channel, i): DrawnLine => ({
                task: `${shown.task} ${channel}`,
                label: channel,
                line: lineBy(shown.points, (point) => point[name][i]!, 'iteration', 0),
                colour: COLOURS[i]!,
                dash: [],
            }));
            chart.draw([...bands, ...own], 'iteration', whole, this.#zoom);
        }
        const drawn = isSpread
            ? ` Bands: lowest to highest of ${counted(ofStage.length, 'task')} of this stage, dashed: their mean.`
            : bandWords([...errors.values()]);
        setText(this.#about, `${place} Lines are red, green and blue light.${drawn}`);
        this.#drawLatest(shown, last);
        this.#drawSpread();
        this.#table.refresh();
    }

    #drawLatest(shown: WaterSeries, last: WaterPoint): void {
        const { showsLatest = false, viewingDistance = null } = this.#data;
        this.#latest.hidden = !showsLatest;
        const key = `${shown.task} ${last.attempt} ${last.iteration} ${viewingDistance}`;
        // Made only for another water, so that a selection stays.
        if (showsLatest && key !== this.#latestOf) {
            this.#latestOf = key;
            const water = waterAt(last);
            const whose = `The latest water of ${shown.label}, at iteration ${grouped(last.iteration)}.`;
            // Without errors the numbers below the charts say the same.
            const numbers = last.standard_error === undefined ? [] : numberTables(water, null);
            this.#latest.replaceChildren(...numbers, colourTable(water, viewingDistance, whose));
        }
    }

    #drawSpread(): void {
        const spread = spreadOfPartitions(this.#series);
        this.#spread.hidden = spread === null;
        if (spread === null) {
            return;
        }
        const rows = NAMES.map((name) => {
            const title = h('span', {}, PARAMETERS[name].title, ' ', h('code', {}, name));
            return tableRow([title, ...spread.of[name].map(spreadCell)]);
        });
        this.#spread.replaceChildren(
            h('h3', {}, 'How partitions differ'),
            h(
                'p',
                { class: 'fp-note' },
                `The latest values of ${spread.partitions} partitions, each with its own water: lowest to ` +
                    'highest, and their distance as a share of the mean.',
            ),
            h(
                'div',
                {
                    class: 'fp-scroll',
                    tabindex: 0,
                    role: 'region',
                    'aria-label': 'Spread between partitions',
                },
                h(
                    'table',
                    { class: 'fp-table' },
                    h('caption', { class: 'fp-unseen' }, 'Spread of the water between partitions'),
                    h(
                        'thead',
                        {},
                        h(
                            'tr',
                            {},
                            ...['Parameter', ...CHANNELS].map((head) => h('th', { scope: 'col' }, head)),
                        ),
                    ),
                    h('tbody', {}, ...rows),
                ),
            ),
        );
    }

    #rows(): string[][] {
        return this.#series.map(({ label, points }) => {
            const last: WaterPoint = points.at(-1)!;
            return [
                label,
                grouped(last.iteration),
                ...NAMES.flatMap((name) =>
                    last[name].map((value, channel) => {
                        const error = last.standard_error?.[name]?.[channel] ?? null;
                        return error === null ? brief(value) : `${brief(value)} ±\u00a0${brief(error, 2)}`;
                    }),
                ),
            ];
        });
    }
}
