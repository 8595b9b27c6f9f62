// The trained water: the parameters with their errors, and what it does to colours.

import { freshId, h } from '../../viewer/dom.ts';
import { ViewerError } from '../../viewer/errors.ts';
import { checkWater } from '../../viewer/water.ts';
import { svg } from './elements.ts';
import { brief, percent } from './format.ts';
import './parts.css';
import './water-panel.css';
import type { Part } from './part.ts';
import {
    CHANNELS,
    DISTANCES,
    PARAMETERS,
    type Parameter,
    type PartitionWater,
    SURFACES,
    type WaterContent,
    type WaterValue,
    cssColour,
    lengthText,
    lightLeft,
    longest,
    openColour,
    patch,
    remarksOf,
    valuesOf,
    waterOf,
} from './water-values.ts';

export interface WaterData {
    /** Content of water.json; null for a scene in air, and as long as there is none. */
    readonly water: WaterContent | null;
    /** `extent.viewing_distance` of plan.json, scene units. */
    readonly viewingDistance: number | null;
}

export function waterPanel(container: HTMLElement): Part<WaterData> {
    const panel = new WaterPanel();
    container.append(panel.element);
    return panel;
}

class WaterPanel implements Part<WaterData> {
    readonly element = h('div', { class: 'fp fp-water' });
    readonly #picker = h('div', { class: 'fp-bar', hidden: true });
    readonly #select: HTMLSelectElement;
    readonly #content = h('div');
    #data: WaterData | null = null;

    constructor() {
        const id = freshId();
        this.#select = h('select', { id, onchange: () => this.#draw() });
        this.#picker.append(h('label', { for: id }, 'Water of'), this.#select);
        this.element.append(this.#picker, this.#content);
    }

    update(data: WaterData): void {
        const isOther = data.water !== this.#data?.water;
        this.#data = data;
        if (isOther) {
            const partitions = data.water?.partitions ?? [];
            const chosen = this.#select.value;
            this.#picker.hidden = partitions.length === 0;
            this.#select.replaceChildren(
                h('option', { value: '' }, 'the whole scene'),
                ...partitions.map(({ partition }) => h('option', { value: partition }, `partition ${partition}`)),
            );
            this.#select.value = chosen;
            if (this.#select.selectedIndex < 0) {
                this.#select.value = '';
            }
        }
        this.#draw();
    }

    destroy(): void {
        this.element.remove();
    }

    #draw(): void {
        const { water, viewingDistance } = this.#data ?? { water: null, viewingDistance: null };
        if (water === null) {
            this.#content.replaceChildren(
                h(
                    'p',
                    { class: 'fp-empty' },
                    'No water: this scene was trained as it looks in air, or its water is not estimated yet.',
                ),
            );
            return;
        }
        try {
            checkWater(water);
        } catch (error) {
            const words = error instanceof ViewerError ? `${error.message} ${error.remedy}` : String(error);
            this.#content.replaceChildren(h('p', { class: 'fp-empty', role: 'alert' }, words));
            return;
        }
        const partition = water.partitions?.find((one) => String(one.partition) === this.#select.value) ?? null;
        this.#content.replaceChildren(
            ...numberTables(water, partition),
            colourTable(waterOf(water, partition), viewingDistance),
        );
    }
}

/** The nine numbers with their errors, and what has to be said about them. */
export function numberTables(water: WaterContent, partition: PartitionWater | null): HTMLElement[] {
    const remarks = [...remarksOf(water), ...errorRemarks(water, partition)].map((text) =>
        h('p', { class: 'fp-note' }, text),
    );
    const parameters = (Object.keys(PARAMETERS) as Parameter[]).map((parameter) =>
        parameterTable(water, parameter, partition),
    );
    return [
        h('div', { class: 'fp-water-grid' }, ...parameters),
        h('div', { class: 'fp-water-remarks' }, ...remarks),
    ];
}

/** What the columns leave unsaid. */
function errorRemarks(water: WaterContent, partition: PartitionWater | null): string[] {
    if (partition !== null) {
        return partition.far_off.length > 0
            ? ['Far off: far from the values of the other partitions, so it counts less.']
            : [];
    }
    const values = (Object.keys(PARAMETERS) as Parameter[]).flatMap((parameter) => valuesOf(water, parameter, null));
    const open = values.some(({ error }) => error === null) ? ' –: the photographs do not determine it.' : '';
    return [`±: one standard error, drawn on the bars.${open}`];
}

function parameterTable(water: WaterContent, parameter: Parameter, partition: PartitionWater | null): HTMLElement {
    const { title, meaning, perLength } = PARAMETERS[parameter];
    const values = valuesOf(water, parameter, partition);
    const hasMetres = values.some(({ perMetre }) => perMetre !== null);
    const unit = perLength ? '1/scene unit' : 'linear light';
    const most = longest(values);
    const hasErrors = partition === null;
    const heads = [
        'Colour',
        unit,
        ...(hasErrors ? ['±'] : []),
        ...(hasMetres ? ['1/m'] : []),
        'Bar with standard error',
    ];
    const row = (value: WaterValue): HTMLElement =>
        h(
            'tr',
            {},
            h('th', { scope: 'row' }, value.channel),
            h('td', { class: 'fp-number' }, h('b', {}, brief(value.value)), value.isFarOff ? ' far off' : null),
            hasErrors ? h('td', { class: 'fp-number' }, errorText(value)) : null,
            hasMetres ? h('td', { class: 'fp-number' }, value.perMetre === null ? '' : brief(value.perMetre)) : null,
            h('td', { class: 'fp-water-bar' }, bar(value, most)),
        );
    return h(
        'section',
        { class: 'fp-water-parameter' },
        h('h3', {}, title, ' ', h('code', {}, parameter)),
        h('p', { class: 'fp-note' }, meaning),
        h(
            'table',
            { class: 'fp-table' },
            h('caption', { class: 'fp-unseen' }, `${title} (${parameter})`),
            h(
                'thead',
                {},
                h(
                    'tr',
                    {},
                    ...heads.map((head, i) =>
                        h(
                            'th',
                            { scope: 'col' },
                            i === heads.length - 1 ? h('span', { class: 'fp-unseen' }, head) : head,
                        ),
                    ),
                ),
            ),
            h('tbody', {}, ...values.map(row)),
        ),
    );
}

/** One standard error. */
const errorText = ({ error }: WaterValue): string | Node =>
    error === null ? h('span', { 'aria-label': 'not determined' }, '–') : brief(error, 2);

/** A bar with one standard error to each side; an arrow where the error leaves the picture. */
function bar({ channel, value, error }: WaterValue, most: number): SVGSVGElement {
    const x = (of: number): number => (98 * of) / most;
    const picture = svg('svg', { viewBox: '0 0 100 14', preserveAspectRatio: 'none', 'aria-hidden': 'true' });
    picture.append(
        svg('rect', { x: 0, y: 3, width: Math.max(0.4, x(value)), height: 8, class: `fp-${channel.toLowerCase()}` }),
    );
    if (error !== null && error > 0) {
        const [lo, hi] = [Math.max(0, x(value - error)), Math.min(100, x(value + error))];
        const ends = `${lo > 0 ? `M${lo} 3.5V10.5` : ''}${hi < 100 ? `M${hi} 3.5V10.5` : ''}`;
        picture.append(svg('path', { d: `M${lo} 7H${hi}${ends}`, class: 'fp-water-error' }));
    }
    return picture;
}

/** What a water does to known colours. `whose` says of which moment of the training it is. */
export function colourTable(water: WaterContent, viewingDistance: number | null, whose = ''): HTMLElement {
    const unit = viewingDistance ?? 1;
    const metres = water.metres_per_unit;
    const heads = DISTANCES.map((times) => {
        const range = h('small', {}, lengthText(times * unit, metres));
        return h(
            'th',
            { scope: 'col' },
            times === 0 ? 'In air' : viewingDistance === null ? '' : `${times} ×`,
            ' ',
            range,
        );
    });
    const surface = ({ name, srgb }: (typeof SURFACES)[number]): HTMLElement =>
        h(
            'tr',
            {},
            h('th', { scope: 'row' }, name),
            ...DISTANCES.map((times) => patchCell(patch(water, srgb, times * unit))),
            h('td'),
        );
    const open = patch(water, [0, 0, 0], 1e9);
    const rows = SURFACES.map(surface);
    // Open water is one colour beside all surfaces, as it is at any distance.
    const openCell = patchCell(open.every(Number.isFinite) ? open : openColour(water));
    openCell.rowSpan = SURFACES.length;
    rows[0]!.lastElementChild!.replaceWith(openCell);
    rows.slice(1).forEach((row) => row.lastElementChild!.remove());
    const left = CHANNELS.map((channel, i) =>
        h(
            'tr',
            { class: 'fp-water-left' },
            h('th', { scope: 'row' }, channel),
            ...DISTANCES.map((times) => h('td', { class: 'fp-number' }, percent(lightLeft(water, times * unit)[i]!))),
            h('td'),
        ),
    );
    const about =
        viewingDistance === null
            ? 'Known colours as the trained water shows them at distances in scene units.'
            : `Known colours as the trained water shows them at multiples of the scene scale, ${lengthText(unit, metres)}: ` +
              'the median depth of the scene in the photographs.';
    return h(
        'section',
        { class: 'fp-water-colours' },
        h('h3', {}, 'What this water does to colours'),
        h('p', { class: 'fp-note' }, whose === '' ? about : `${whose} ${about}`),
        h(
            'div',
            { class: 'fp-scroll' },
            h(
                'table',
                { class: 'fp-water-patches' },
                h('caption', { class: 'fp-unseen' }, 'Colours of surfaces by distance, and the light that is left'),
                h('thead', {}, h('tr', {}, h('td'), ...heads, h('th', { scope: 'col' }, 'Open water'))),
                h('tbody', {}, ...rows),
                h(
                    'tbody',
                    {},
                    h(
                        'tr',
                        { class: 'fp-water-left' },
                        h(
                            'th',
                            { scope: 'colgroup', colspan: DISTANCES.length + 2 },
                            'Light of the scene that is left',
                        ),
                    ),
                    ...left,
                ),
            ),
        ),
    );
}

function patchCell(srgb: readonly [number, number, number]): HTMLTableCellElement {
    const words = srgb.map((value) => Math.round(255 * value)).join(' ');
    const cell = h(
        'td',
        { class: 'fp-patch', title: `sRGB ${words}` },
        h('span', { class: 'fp-unseen' }, `sRGB ${words}`),
    );
    cell.style.backgroundColor = cssColour(srgb);
    return cell;
}
