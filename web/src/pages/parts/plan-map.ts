// The plan from above: cells with the state of their training, cameras, and what belongs to the chosen cell.

import { freshId, h } from '../../viewer/dom.ts';
import type { CameraEntry } from '../../viewer/scene.ts';
import { colourReader, foldedTable, oncePerFrame, setText, watchLook } from './elements.ts';
import { counted, grouped, percent } from './format.ts';
import './parts.css';
import './plan-map.css';
import { type Part, SHOWN_STATES, type TaskInfo } from './part.ts';
import { PlanDetails, meaningOf, summaryOf, tableRows } from './plan-details.ts';
import { drawMap } from './plan-drawing.ts';
import { watchMap } from './plan-input.ts';
import {
    type Area,
    type CellState,
    type ManifestContent,
    type MapCamera,
    type MapView,
    type PlanContent,
    type PlanPartition,
    type Projection,
    areaOf,
    cameraAt,
    cellStates,
    clampView,
    countStates,
    isCrowded,
    nextPartition,
    partitionAt,
    pixelsPerCamera,
    placeCameras,
    project,
} from './plan-layout.ts';
import { type LegendEntry, SHADE_WORDS, type ShadeBy, type Shading, WorkerShades, shadingOf } from './plan-shades.ts';
import { PlanTip } from './plan-tip.ts';

export interface PlanMapOptions {
    /** Gives the address of a photograph by its name in the scene. Asked once for each name. */
    readonly onPhotograph?: (name: string) => Promise<string>;
}

export interface PlanMapData {
    /** Content of plan.json; null before the job is planned. Another object counts as another plan. */
    readonly plan: PlanContent | null;
    /** Content of cameras.json or of the manifest. */
    readonly cameras: readonly CameraEntry[] | ManifestContent | null;
    readonly tasks: readonly TaskInfo[];
}

/** How near to a camera the pointer must be, pixels. */
const REACH = 12;
const KEYS = 'Arrow keys choose a partition, + and − zoom, 0 shows the whole plan.';

export function planMap(container: HTMLElement, options: PlanMapOptions = {}): Part<PlanMapData> {
    const map = new PlanMap(options);
    container.append(map.element);
    return map;
}

const button = (text: string, label: string, onclick: () => void): HTMLButtonElement =>
    h('button', { type: 'button', class: 'fp-button', 'aria-label': label, onclick }, text);

function legendItem({ shade, text }: LegendEntry): HTMLElement {
    const swatch = h('span', { class: 'fp-shade', 'data-pattern': shade.pattern, 'aria-hidden': 'true' });
    const fill = shade.fill.startsWith('--') ? `var(${shade.fill})` : shade.fill;
    swatch.style.backgroundColor = `color-mix(in srgb, ${fill} ${100 * shade.share}%, var(--panel))`;
    swatch.style.color = `var(${shade.stroke})`;
    return h('li', {}, swatch, text);
}

class PlanMap implements Part<PlanMapData> {
    readonly element = h('div', { class: 'fp fp-plan' });
    readonly #canvas: HTMLCanvasElement;
    readonly #tip: PlanTip;
    readonly #summary = h('p', { class: 'fp-note' });
    readonly #counts = h('ul', { class: 'fp-counts', 'aria-label': 'Partitions by state' });
    readonly #meaning = h('p', { class: 'fp-note' });
    readonly #details = new PlanDetails((camera) => this.#showCamera(camera));
    /** For screen readers: only when another partition is chosen, and not at every update. */
    readonly #spoken = h('p', { class: 'fp-unseen', role: 'status' });
    readonly #body: HTMLElement;
    readonly #empty = h(
        'p',
        { class: 'fp-empty' },
        'The plan is shown here as soon as the scene is cut into partitions.',
    );
    readonly #whole: HTMLButtonElement;
    readonly #shadeBy: HTMLSelectElement;
    readonly #legend = h('ul', { class: 'fp-shades', 'aria-label': 'Shades of the cells' });
    readonly #workers = new WorkerShades();
    readonly #table = foldedTable(
        'The plan as a table',
        'Partitions of the plan',
        [
            'Partition',
            'State',
            'Worker',
            'Iterations',
            'Attempts',
            'PSNR',
            'Own cameras',
            'Cameras trained on',
            'See enough',
        ],
        () => tableRows(this.#data?.plan ?? null, this.#states, (id) => this.#choose(id)),
    );
    readonly #frame = oncePerFrame(() => this.#draw());
    readonly #stop: (() => void)[];
    #data: PlanMapData | null = null;
    #cameras: readonly MapCamera[] = [];
    #states: ReadonlyMap<number, CellState> = new Map();
    #area: Area = { x0: 0, x1: 1, z0: 0, z1: 1 };
    #view: MapView = { zoom: 1, x: 0.5, z: 0.5 };
    #chosen: number | null = null;
    #hovered: PlanPartition | null = null;
    #camera: MapCamera | null = null;
    #shading: Shading | null = null;
    /** What the legend shows. */
    #legendKey = '';

    constructor(options: PlanMapOptions) {
        this.#tip = new PlanTip(options.onPhotograph ?? null);
        const hint = freshId();
        this.#canvas = h('canvas', {
            class: 'fp-plan-canvas',
            tabindex: 0,
            role: 'application',
            'aria-roledescription': 'map',
            'aria-describedby': hint,
        });
        const shadeId = freshId();
        this.#shadeBy = h(
            'select',
            { id: shadeId, onchange: () => this.#shade() },
            ...SHADE_WORDS.map(([value, text]) => h('option', { value }, text)),
        );
        this.#whole = button('Whole plan', 'Show the whole plan', () => this.#look({ ...this.#view, zoom: 1 }));
        const stage = h('div', { class: 'fp-plan-stage' }, this.#canvas, this.#tip.element);
        this.#body = h(
            'div',
            { hidden: true },
            h('div', { class: 'fp-bar' }, this.#counts),
            h(
                'div',
                { class: 'fp-bar' },
                h('label', { for: shadeId }, 'Shade cells by'),
                this.#shadeBy,
                h('span', { class: 'fp-fill' }),
                h(
                    'span',
                    { class: 'fp-together' },
                    button('−', 'Smaller', () => this.#zoom(1 / 1.5)),
                    button('+', 'Larger', () => this.#zoom(1.5)),
                    this.#whole,
                ),
            ),
            this.#legend,
            h('div', { class: 'fp-plan-pair' }, stage, this.#details.element),
            this.#meaning,
            this.#spoken,
            h('p', { class: 'fp-unseen', id: hint }, KEYS),
            this.#table.element,
        );
        this.element.append(this.#summary, this.#empty, this.#body);
        this.#stop = [
            watchLook(stage, () => this.#frame.request()),
            watchMap(this.#canvas, {
                move: (left, top) => this.#hover(left, top),
                leave: () => this.#hover(-1e6, -1e6),
                press: (left, top) => this.#press(left, top),
                pan: (dx, dy) => {
                    const { pixelsPerUnit } = this.#projection();
                    this.#look({
                        ...this.#view,
                        x: this.#view.x - dx / pixelsPerUnit,
                        z: this.#view.z + dy / pixelsPerUnit,
                    });
                },
                zoom: (factor, left, top) => this.#zoom(factor, left, top),
                step: (dx, dz) => this.#step(dx, dz),
                whole: () => this.#look({ ...this.#view, zoom: 1 }),
                clear: () => this.#choose(null),
                isZoomed: () => this.#view.zoom > 1,
            }),
        ];
        this.#showMeaning();
    }

    update(data: PlanMapData): void {
        const before = this.#data;
        this.#data = data;
        const { plan } = data;
        this.#body.hidden = plan === null;
        this.#empty.hidden = plan !== null;
        this.#summary.hidden = plan === null;
        if (plan === null) {
            return;
        }
        if (before?.plan !== plan || before.cameras !== data.cameras) {
            this.#cameras = placeCameras(plan, data.cameras);
            this.#area = areaOf(plan, this.#cameras);
            if (before?.plan !== plan) {
                const { x0, x1, z0, z1 } = this.#area;
                this.#view = { zoom: 1, x: (x0 + x1) / 2, z: (z0 + z1) / 2 };
                this.#chosen = null;
                this.#hovered = null;
            }
        }
        this.#states = cellStates(plan, data.tasks);
        this.#shade();
        setText(this.#summary, summaryOf(plan, this.#cameras.length));
        const counts = countStates(this.#states.values());
        const shown = SHOWN_STATES.filter((state) => counts[state] > 0);
        this.#counts.replaceChildren(
            ...shown.map((state) =>
                h('li', { class: 'fp-state', 'data-state': state }, `${grouped(counts[state])} ${state}`),
            ),
        );
        // Before there is a job, nothing waits.
        this.#counts.hidden = data.tasks.length === 0;
        const words = shown.map((state) => `${counts[state]} ${state}`).join(', ');
        this.#canvas.setAttribute(
            'aria-label',
            `Map of ${counted(plan.partitions.length, 'partition')}${data.tasks.length === 0 ? '' : `: ${words}`}. ${KEYS}`,
        );
        this.#showDetails();
        this.#table.refresh();
        this.#frame.request();
    }

    destroy(): void {
        this.#stop.forEach((stop) => stop());
        this.#frame.cancel();
        this.element.remove();
    }

    #size(): { width: number; height: number } {
        // Before the first layout it has no size.
        return { width: Math.max(1, this.#canvas.clientWidth), height: Math.max(1, this.#canvas.clientHeight) };
    }

    #projection(): Projection {
        const { width, height } = this.#size();
        return project(this.#area, width, height, this.#view);
    }

    #draw(): void {
        const plan = this.#data?.plan;
        const context = this.#canvas.getContext('2d');
        if (!plan || context === null || !this.#canvas.isConnected) {
            return;
        }
        // As high as the scene is, within limits, so that long scenes do not leave a gap.
        const width = Math.max(1, this.#canvas.clientWidth);
        const aspect = (this.#area.z1 - this.#area.z0) / (this.#area.x1 - this.#area.x0);
        const height = Math.round(
            Math.min(Math.max(width * aspect, Math.min(200, width)), Math.max(340, width * 0.85)),
        );
        this.#canvas.style.height = `${height}px`;
        this.#view = clampView(this.#area, width, height, this.#view);
        const ratio = window.devicePixelRatio || 1;
        const [w, h2] = [Math.round(width * ratio), Math.round(height * ratio)];
        if (this.#canvas.width !== w || this.#canvas.height !== h2) {
            [this.#canvas.width, this.#canvas.height] = [w, h2];
        }
        context.setTransform(ratio, 0, 0, ratio, 0, 0);
        const chosen = this.#chosenPartition();
        const marked = [chosen, this.#hovered].filter((one): one is PlanPartition => one !== null);
        drawMap(
            context,
            width,
            height,
            this.#projection(),
            {
                plan,
                cameras: this.#cameras,
                states: this.#states,
                shading: this.#shading,
                marked: [...new Set(marked.toReversed())],
                camera: this.#camera,
                pixelsPerCamera: pixelsPerCamera(this.#area, this.#projection(), this.#cameras),
            },
            colourReader(this.element),
        );
        this.#whole.disabled = this.#view.zoom === 1;
        this.#canvas.classList.toggle('fp-zoomed', this.#view.zoom > 1);
    }

    #chosenPartition(): PlanPartition | null {
        return this.#data?.plan?.partitions.find(({ id }) => id === this.#chosen) ?? null;
    }

    #look(view: MapView): void {
        const { width, height } = this.#size();
        this.#view = clampView(this.#area, width, height, view);
        this.#showCamera(null);
        this.#showMeaning();
    }

    /** The place under the pointer stays where it is; without a pointer, the chosen cell or the middle. */
    #zoom(factor: number, left?: number, top?: number): void {
        const { width, height } = this.#size();
        const projection = this.#projection();
        const chosen = this.#chosenPartition();
        let [x, y] = [left ?? width / 2, top ?? height / 2];
        if (left === undefined && chosen !== null) {
            const rect = projection.rect(chosen.cell);
            [x, y] = [(rect[0] + rect[2]) / 2, (rect[1] + rect[3]) / 2];
        }
        const fixed = projection.at(x, y);
        const { zoom } = clampView(this.#area, width, height, { ...this.#view, zoom: this.#view.zoom * factor });
        const by = this.#view.zoom / zoom;
        this.#look({ zoom, x: fixed.x + (this.#view.x - fixed.x) * by, z: fixed.z + (this.#view.z - fixed.z) * by });
    }

    #step(dx: number, dz: number): void {
        const plan = this.#data?.plan;
        const first = plan?.partitions[0];
        if (!plan || first === undefined) {
            return;
        }
        const from = this.#chosenPartition();
        const to = from === null ? first : nextPartition(plan, this.#area, from, dx, dz);
        this.#choose(to.id);
        // Keep what was chosen in sight.
        const { width, height } = this.#size();
        const [left, top, right, bottom] = this.#projection().rect(to.cell);
        if (right < 20 || left > width - 20 || bottom < 20 || top > height - 20) {
            const { x, z } = this.#projection().at((left + right) / 2, (top + bottom) / 2);
            this.#look({ ...this.#view, x, z });
        }
    }

    #hover(left: number, top: number): void {
        const plan = this.#data?.plan;
        if (!plan) {
            return;
        }
        const projection = this.#projection();
        const { x, z } = projection.at(left, top);
        const camera = left < 0 ? null : this.#cameraAt(projection, left, top);
        const partition = left < 0 ? null : partitionAt(plan, x, z);
        if (camera !== this.#camera) {
            this.#showCamera(camera);
        }
        if (partition !== this.#hovered) {
            this.#hovered = partition;
            this.#frame.request();
        }
    }

    #cameraAt(projection: Projection, left: number, top: number): MapCamera | null {
        // In a crowd there is a camera under every pixel, and then nobody could choose a cell.
        return isCrowded(pixelsPerCamera(this.#area, projection, this.#cameras))
            ? null
            : cameraAt(this.#cameras, projection, left, top, REACH);
    }

    #press(left: number, top: number): void {
        const plan = this.#data?.plan;
        const projection = this.#projection();
        const camera = this.#cameraAt(projection, left, top);
        const { x, z } = projection.at(left, top);
        if (camera !== null) {
            this.#showCamera(camera);
        } else if (plan) {
            this.#choose(partitionAt(plan, x, z)?.id ?? null);
        }
    }

    #choose(id: number | null): void {
        this.#chosen = id;
        this.#showCamera(null);
        const cell = id === null ? undefined : this.#states.get(id);
        const share = cell?.state === 'running' ? ` ${percent(cell.share)}` : '';
        setText(this.#spoken, cell === undefined ? '' : `Partition ${id}, ${cell.state}${share}`);
        this.#showDetails();
        this.#frame.request();
    }

    /** Shades the cells anew, and says what the shades mean. */
    #shade(): void {
        const plan = this.#data?.plan ?? null;
        this.#shading =
            plan === null ? null : shadingOf(this.#shadeBy.value as ShadeBy, plan, this.#states, this.#workers);
        const legend = this.#shading?.legend ?? [];
        const key = JSON.stringify(legend);
        if (key !== this.#legendKey) {
            this.#legendKey = key;
            this.#legend.replaceChildren(...legend.map(legendItem));
        }
        // The states are told above the map.
        this.#legend.hidden = legend.length === 0;
        this.#showMeaning();
    }

    #showMeaning(): void {
        const isDense = isCrowded(pixelsPerCamera(this.#area, this.#projection(), this.#cameras));
        setText(this.#meaning, meaningOf(this.#shadeBy.value as ShadeBy, isDense));
        this.#frame.request();
    }

    #showCamera(camera: MapCamera | null): void {
        this.#camera = camera;
        this.#frame.request();
        this.#tip.show(camera, ({ x, z }) => {
            const projection = this.#projection();
            return { x: projection.x(x), y: projection.y(z), ...this.#size() };
        });
    }

    #showDetails(): void {
        const partition = this.#chosenPartition();
        this.#details.update(partition, partition === null ? null : this.#states.get(partition.id)!, this.#cameras);
    }
}
