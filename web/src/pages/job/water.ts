// The water of a job that has succeeded.

import { problemOf } from '../context.ts';
import { h } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { waterPanel } from '../parts/water-panel.ts';
import type { WaterContent } from '../parts/water-values.ts';
import { type JobContext, type Section, whenSucceeded } from './section.ts';

/** The keys of plan.json that are read. */
interface Plan {
    readonly extent?: { readonly viewing_distance?: number | null };
}

export function open(container: HTMLElement, context: JobContext): Section {
    let stop: (() => void) | null = null;
    const show = async (): Promise<void> => {
        container.replaceChildren(h('p', { class: 'loading', role: 'status' }, 'Loading the water …'));
        try {
            const [water, plan] = await Promise.all([context.json('water.json'), context.json('plan.json')]);
            if (context.signal.aborted) {
                return;
            }
            const host = h('div', { class: 'card' });
            container.replaceChildren(host);
            const panel = waterPanel(host);
            stop = () => panel.destroy();
            panel.update({
                water: water as WaterContent | null,
                viewingDistance: (plan as Plan | null)?.extent?.viewing_distance ?? null,
            });
        } catch (error) {
            const shown = problemOf('The water cannot be shown', faultOf(error));
            if (shown !== null) {
                container.replaceChildren(shown);
            }
        }
    };
    const section = whenSucceeded(container, context, 'The water', () => void show());
    return { update: section.update, destroy: () => stop?.() };
}
