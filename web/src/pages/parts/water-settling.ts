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
    firstShown,
    spreadOfPartitions,
} from './water-points.ts';
import { CHANNELS, PARAMETERS, type Parameter } from './water-values.ts';

export interface WaterSettlingData {
    /** In the order of the tasks. */
    readonly series: readonly WaterSeries[];
}

/** Most tasks whose lines are drawn behind those of the chosen one. */
const MOST_BEHIND = 24;
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

class WaterSettling implements Part<WaterSettlingData> {
    readonly element = h('div', { class: 'fp fp-water' });
    readonly #select: HTMLSelectElement;
    readonly #picker: HTMLElement;
    readonly #about = h('p', { class: 'fp-note fp-curve-hint' });
    readonly #charts: ReadonlyMap<Parameter, Chart>;
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
            this.#spread,
            this.#table.element,
        );
        this.#stop = watchLook(this.element, () => this.#look());
    }

    update({ series }: WaterSettlingData): void {
        this.#series = series
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
        const behind = this.#series
            .filter((one) => one !== shown && one.stage === shown.stage)
            .slice(0, MOST_BEHIND);
        const last = shown.points.at(-1)!;
        const others =
            behind.length === 0 ? '' : ` Thin lines: ${counted(behind.length, 'other task')} of this stage.`;
        const place = `${shown.label} at iteration ${grouped(last.iteration)}.`;
        setText(this.#about, `${place} Lines are red, green and blue light.${others}`);
        const whole = spanOf([shown, ...behind], 'iteration', 0);
        for (const [name, chart] of this.#charts) {
            // What is drawn last lies on top.
            const lines = [...behind, shown].flatMap((one) =>
                CHANNELS.map((channel, i): DrawnLine => ({
                    task: `${one.task} ${channel}`,
                    label: channel,
                    line: lineBy(one.points, (point) => point[name][i]!, 'iteration', 0),
                    colour: COLOURS[i]!,
                    dash: [],
                    isBehind: one !== shown,
                })),
            );
            chart.draw(lines, 'iteration', whole, this.#zoom);
        }
        this.#drawSpread();
        this.#table.refresh();
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
                ...NAMES.flatMap((name) => last[name].map((value) => brief(value))),
            ];
        });
    }
}
