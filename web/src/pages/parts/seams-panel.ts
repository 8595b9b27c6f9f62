// The seams of a model: the verdict, the numbers with what they mean, and the lines on the plan.

import type { CameraEntry } from '../../viewer/scene.ts';
import { h } from '../../viewer/dom.ts';
import { foldedTable, svg } from './elements.ts';
import { brief, counted, decibels, grouped } from './format.ts';
import './parts.css';
import type { Part } from './part.ts';
import { type PlanContent, areaOf, placeCameras } from './plan-layout.ts';
import { type SeamLine, borders, middles } from './seam-lines.ts';
import { type SeamContent, type SeamView, seamRows, seamVerdict, stepText } from './seam-report.ts';
import './seams-panel.css';

export interface SeamsData {
    readonly seams: SeamContent;
    readonly views: readonly SeamView[];
    /** Content of plan.json; null if it cannot be read. */
    readonly plan: PlanContent | null;
    /** Content of cameras.json. */
    readonly cameras: readonly CameraEntry[] | null;
}

/** The longer side of the drawing of a plan, in its own units. */
const SIDE = 1000;

export function seamsPanel(container: HTMLElement): Part<SeamsData> {
    const element = h('div', { class: 'fp fp-seams' });
    container.append(element);
    return {
        update: (data) => element.replaceChildren(...contentOf(data)),
        destroy: () => element.remove(),
    };
}

function contentOf({ seams, views, plan, cameras }: SeamsData): readonly Node[] {
    const { shows, text } = seamVerdict(seams);
    const step = stepText(seams.range_step);
    const remedy =
        shows === true
            ? h(
                  'p',
                  { class: 'fp-note' },
                  'There are two settings for this: ',
                  h('code', {}, 'borders.enabled=true'),
                  ' and ',
                  h('code', {}, 'partition.neighbours_from=0.85'),
                  '.',
              )
            : null;
    const shown = views.filter((view) => (view.border_pixels ?? 0) > 0);
    const perView = foldedTable(
        'Each held-out view as a table',
        'Held-out views that show a border',
        ['View', 'Pixels near a border', 'PSNR there', 'PSNR elsewhere', 'PSNR where nothing was cut'],
        () =>
            shown.map((view) => [
                view.name,
                grouped(view.border_pixels ?? 0),
                decibels(view.border_psnr ?? null),
                decibels(view.interior_psnr ?? null),
                decibels(view.control_psnr ?? null),
            ]),
    );
    const numbers = h(
        'div',
        {},
        h('p', { class: 'fp-seam-verdict' }, text),
        step === '' ? null : h('p', {}, step),
        remedy,
        table(seams),
        shown.length === 0 ? null : perView.element,
    );
    return [
        h(
            'div',
            { class: 'fp-seam-pair' },
            numbers,
            plan === null ? null : drawing(plan, cameras, seams.band),
        ),
    ];
}

function table(seams: SeamContent): HTMLElement {
    const heads = ['Measure', 'Borders', 'Nothing cut'].map((head) => h('th', { scope: 'col' }, head));
    const rows = seamRows(seams).map(({ title, meaning, border, control }) =>
        h(
            'tr',
            {},
            h('th', { scope: 'row' }, title, meaning === '' ? null : h('small', {}, meaning)),
            h('td', { class: 'fp-number' }, border),
            h('td', { class: 'fp-number' }, control),
        ),
    );
    return h(
        'table',
        { class: 'fp-table' },
        h(
            'caption',
            { class: 'fp-unseen' },
            'Quality along the borders of cells, and along lines where nothing was cut',
        ),
        h('thead', {}, h('tr', {}, ...heads)),
        h('tbody', {}, ...rows),
    );
}

const key = (kind: string, words: string): HTMLElement =>
    h('li', {}, h('span', { class: `fp-seam-key ${kind}`, 'aria-hidden': 'true' }), words);

/** The plan from above: borders and control lines in their bands, and the cameras. */
function drawing(plan: PlanContent, entries: readonly CameraEntry[] | null, band: number): HTMLElement {
    const cameras = placeCameras(plan, entries);
    const area = areaOf(plan, cameras);
    const scale = SIDE / Math.max(area.x1 - area.x0, area.z1 - area.z0);
    const [width, height] = [(area.x1 - area.x0) * scale, (area.z1 - area.z0) * scale];
    // As on the map of the plan, z points up.
    const toX = (x: number): number => (Math.min(area.x1, Math.max(area.x0, x)) - area.x0) * scale;
    const toY = (z: number): number => (area.z1 - Math.min(area.z1, Math.max(area.z0, z))) * scale;
    const ends = ({ axis, at, from, to }: SeamLine): Record<string, number> =>
        axis === 'x'
            ? { x1: toX(at), x2: toX(at), y1: toY(from), y2: toY(to) }
            : { x1: toX(from), x2: toX(to), y1: toY(at), y2: toY(at) };
    const lines = (all: readonly SeamLine[], kind: string): SVGElement[] =>
        all.flatMap((one) => [
            svg('line', { ...ends(one), class: `fp-seam-band ${kind}`, 'stroke-width': 2 * band * scale }),
            svg('line', { ...ends(one), class: `fp-seam-line ${kind}` }),
        ]);
    const found = borders(plan.partitions.map(({ cell }) => cell));
    const label = `The plan from above with ${counted(found.length, 'border')} between cells.`;
    const picture = svg(
        'svg',
        { viewBox: `0 0 ${width} ${height}`, class: 'fp-seam-plan', role: 'img', 'aria-label': label },
        ...cameras.map(({ x, z }) =>
            svg('circle', { cx: toX(x), cy: toY(z), r: 5, class: 'fp-seam-camera' }),
        ),
        ...lines(middles(plan, band), 'fp-seam-control'),
        ...lines(found, 'fp-seam-border'),
    );
    return h(
        'figure',
        {},
        picture,
        h(
            'figcaption',
            {},
            h(
                'ul',
                { class: 'fp-seam-keys' },
                key('fp-seam-border', 'Borders'),
                key('fp-seam-control', 'Lines where nothing was cut'),
            ),
            h(
                'p',
                { class: 'fp-note' },
                `Bands reach ${brief(band)} scene units to each side. Numbers are of all borders together.`,
            ),
        ),
    );
}
