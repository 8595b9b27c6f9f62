// The words about a plan: the panel of the chosen partition with its own cameras, the table, the summary.

import { h } from '../../viewer/dom.ts';
import { counted, decibels, grouped, percent } from './format.ts';
import {
    type CellState,
    type MapCamera,
    type PlanContent,
    type PlanPartition,
    camerasOf,
    seenBy,
} from './plan-layout.ts';
import type { ShadeBy } from './plan-shades.ts';
import { shownPsnr } from './part.ts';

/** Most cameras that are listed for a partition. */
const MOST_LISTED = 60;

export class PlanDetails {
    readonly element = h('section', { class: 'fp-plan-details' });
    readonly #showCamera: (camera: MapCamera | null) => void;
    readonly #head = h('div');
    readonly #list = h('div', { class: 'fp-plan-cameras' });
    #listed: PlanPartition | null = null;
    #cameras: readonly MapCamera[] = [];

    constructor(showCamera: (camera: MapCamera | null) => void) {
        this.#showCamera = showCamera;
        this.element.append(this.#head, this.#list);
    }

    update(partition: PlanPartition | null, cell: CellState | null, cameras: readonly MapCamera[]): void {
        if (partition === null || cell === null) {
            this.#listed = null;
            this.#list.replaceChildren();
            this.#head.replaceChildren(
                h('p', { class: 'fp-note' }, 'Choose a partition on the map to see its cameras and more.'),
            );
            return;
        }
        const state = stateOf(cell);
        const facts = factsOf(partition, cell).flatMap(([name, value]) => [h('dt', {}, name), h('dd', {}, value)]);
        this.#head.replaceChildren(
            h('h3', {}, `Partition ${partition.id} `, state),
            h('dl', { class: 'fp-facts' }, ...facts),
        );
        if (this.#listed !== partition || this.#cameras !== cameras) {
            // Made once for each choice, so that updates do not take the focus from a camera.
            this.#list.replaceChildren(...this.#listCameras(partition, cameras));
            this.#listed = partition;
            this.#cameras = cameras;
        }
    }

    #listCameras(partition: PlanPartition, all: readonly MapCamera[]): Node[] {
        const cameras = camerasOf(partition, all);
        if (cameras.length === 0) {
            return [];
        }
        const entry = (camera: MapCamera): HTMLElement => {
            const show = (): void => this.#showCamera(camera);
            const hide = (): void => this.#showCamera(null);
            const name = h(
                'button',
                { type: 'button', class: 'fp-link', onclick: show, onfocus: show, onblur: hide },
                camera.name,
            );
            return h('li', {}, name, camera.isHeldOut ? ' held out' : null);
        };
        const nodes = [h('h4', {}, 'Its photographs'), h('ul', {}, ...cameras.slice(0, MOST_LISTED).map(entry))];
        const more = cameras.length - MOST_LISTED;
        return more > 0 ? [...nodes, h('p', { class: 'fp-note' }, `and ${counted(more, 'other')}`)] : nodes;
    }
}

/** What the panel says of a partition. */
function factsOf(partition: PlanPartition, { share, task, isFirstPart, state }: CellState): [string, string][] {
    const iterations = task?.iterations || partition.iterations;
    const facts: [string, string][] = [];
    if (isFirstPart) {
        facts.push(['Part', task?.state === 'done' ? 'first part done' : 'first part of its run']);
    }
    if (task?.worker) {
        facts.push([state === 'running' ? 'Worker' : 'Last worker', task.worker]);
    }
    facts.push(['Iterations', `${grouped(task?.iteration ?? 0)} of ${grouped(iterations)}, ${percent(share)}`]);
    if (task && task.attempts > 1) {
        facts.push(['Attempts', String(task.attempts)]);
    }
    const psnr = shownPsnr(task);
    if (psnr !== null) {
        facts.push([psnr.isOfPreviews ? 'PSNR of previews' : 'PSNR', decibels(psnr.value)]);
    }
    const filled = partition.filled_views > 0 ? `, ${partition.filled_views} of them see little of it` : '';
    facts.push(
        ['Own cameras', grouped(partition.base_views.length)],
        ['Trains on', `${counted(partition.chosen_views.length, 'camera')}${filled}`],
        ['Sparse points', grouped(partition.cell_points)],
        ['Most Gaussians', grouped(partition.max_gaussians)],
    );
    return facts;
}

/** What the lines and the shades of the map mean. */
export function meaningOf(by: ShadeBy, isDense: boolean): string {
    if (by === 'cameras') {
        return (
            'Number and shade: cameras that see enough of the dashed box of a cell. Hatched: fewer than the least number, ' +
            'so the plan added cameras that see less of it. Expect lower quality there.'
        );
    }
    if (by === 'worker') {
        return 'Shade: the worker that trains a cell, or trained it last.';
    }
    if (by === 'psnr') {
        return (
            'Number and shade: the latest PSNR of a cell on held-out photographs. Where none was measured, it is that of ' +
            'its latest previews. Lighter is better.'
        );
    }
    const zoom = isDense ? ' Zoom in to distinguish cameras.' : '';
    return (
        'Solid lines: cells, the part that a partition keeps. Dashed: what the partition under the pointer trains. ' +
        `Dots: cameras, with the direction they look. Rings: held-out photographs.${zoom}`
    );
}

/** The plan in a sentence. */
export function summaryOf(plan: PlanContent, cameras: number): string {
    const count = plan.partitions.length;
    const grid = plan.columns && plan.rows ? `${grouped(plan.columns)} × ${grouped(plan.rows)} partitions` : null;
    const cut = count === 1 ? 'one partition' : (grid ?? `${grouped(count)} partitions by recursive cuts`);
    const views = `${counted(plan.views - plan.held_out.length, 'training photograph')}, ${grouped(plan.held_out.length)} held out`;
    const unknown = cameras === 0 ? ' The positions of the cameras are not known here.' : '';
    return `Seen from above: ${cut}, ${views}.${unknown}`;
}

/** The state of a cell; nothing before there is a job. */
const stateOf = ({ state, task }: Pick<CellState, 'state' | 'task'>): Node | string =>
    task === null ? '' : h('span', { class: 'fp-state', 'data-state': state }, state);

/** The rows of the table of all partitions. */
export function tableRows(
    plan: PlanContent | null,
    states: ReadonlyMap<number, CellState>,
    choose: (id: number) => void,
): (string | Node)[][] {
    return (plan?.partitions ?? []).map((partition) => {
        const { state, task } = states.get(partition.id)!;
        const psnr = shownPsnr(task);
        return [
            h(
                'button',
                { type: 'button', class: 'fp-link', onclick: () => choose(partition.id) },
                String(partition.id),
            ),
            stateOf({ state, task }),
            task?.worker ?? '',
            task ? `${grouped(task.iteration)} of ${grouped(task.iterations || partition.iterations)}` : '',
            String(task?.attempts ?? 0),
            psnr === null ? '' : `${decibels(psnr.value)}${psnr.isOfPreviews ? ' (previews)' : ''}`,
            String(partition.base_views.length),
            String(partition.chosen_views.length),
            String(seenBy(partition)),
        ];
    });
}
