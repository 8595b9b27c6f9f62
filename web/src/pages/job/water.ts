// The water of a job with its errors: as it settles while tasks train it, and once the job has succeeded.

import type { TaskHistory } from '../../rpc/fathom/v1/job_pb.ts';
import { JobState } from '../../rpc/fathom/v1/job_pb.ts';
import { problemOf } from '../context.ts';
import { h } from '../dom.ts';
import { faultOf } from '../faults.ts';
import type { Part } from '../parts/part.ts';
import { waterPanel } from '../parts/water-panel.ts';
import { type WaterSettlingData, waterSettling } from '../parts/water-settling.ts';
import type { WaterContent } from '../parts/water-values.ts';
import { hasEnded } from '../words.ts';
import { followHistory } from './history.ts';
import type { JobContext, Section } from './section.ts';
import { isInAir, waterSeriesOf } from './water-history.ts';

/** After a failure the plan is asked for again, but not at once. */
const ASK_AGAIN_MS = 5000;

/** The keys of plan.json that are read. */
interface Plan {
    readonly extent?: { readonly viewing_distance?: number | null };
}

function emptyText(context: JobContext): string {
    const { state, configJson } = context.job;
    if (isInAir(configJson)) {
        return 'This job trains the scene as it looks in air (water.medium = none).';
    }
    return hasEnded(state)
        ? 'The job did not succeed, and none of its tasks reported a water.'
        : 'The water is shown here while it trains and once the job has succeeded, with its standard errors.';
}

export function open(container: HTMLElement, context: JobContext): Section {
    const { id, session, signal } = context;
    const finalHost = h('div', { class: 'section' });
    const settlingHost = h('div', { class: 'card' });
    const settlingTitle = h('h2', {}, 'How it settled');
    const emptyWords = h('p');
    const empty = h('div', { class: 'empty' }, h('h2', {}, 'Nothing yet'), emptyWords);
    let panel: { destroy(): void } | null = null;
    let settling: Part<WaterSettlingData> | null = null;
    let histories: readonly TaskHistory[] = [];
    let isFinalShown = false;
    /** Of the plan; null before it is known. */
    let viewingDistance: number | null = null;
    let isPlanAsked = false;

    /** Before the job has succeeded the plan is no file yet, only a blob. */
    const askPlan = async (digest: string): Promise<void> => {
        isPlanAsked = true;
        try {
            const plan = (await session.api.json(digest, id, signal)) as Plan | null;
            viewingDistance = plan?.extent?.viewing_distance ?? null;
            update();
        } catch {
            // Meanwhile the colours are shown at distances in scene units.
            setTimeout(() => (isPlanAsked = false), ASK_AGAIN_MS);
        }
    };

    const showFinal = async (): Promise<void> => {
        isFinalShown = true;
        finalHost.replaceChildren(h('p', { class: 'loading', role: 'status' }, 'Loading the water …'));
        try {
            const [water, plan] = await Promise.all([context.json('water.json'), context.json('plan.json')]);
            if (signal.aborted) {
                return;
            }
            const host = h('div', { class: 'card' });
            finalHost.replaceChildren(host);
            const shown = waterPanel(host);
            panel = shown;
            shown.update({
                water: water as WaterContent | null,
                viewingDistance: (plan as Plan | null)?.extent?.viewing_distance ?? null,
            });
        } catch (error) {
            const shown = problemOf('The water cannot be shown', faultOf(error));
            if (shown !== null) {
                finalHost.replaceChildren(shown);
            }
        }
    };

    function update(): void {
        const { state, tasks } = context.job;
        const hasFinal = state === JobState.SUCCEEDED;
        if (hasFinal && !isFinalShown) {
            void showFinal();
        }
        const series = waterSeriesOf(tasks, histories);
        const isSettling = series.length > 0;
        const { plan } = context.job;
        if (isSettling && !hasFinal && plan !== undefined && !isPlanAsked) {
            void askPlan(plan.digest);
        }
        emptyWords.textContent = emptyText(context);
        const parts = [
            ...(hasFinal ? [finalHost] : []),
            ...(isSettling && hasFinal ? [settlingTitle] : []),
            ...(isSettling ? [settlingHost] : []),
            ...(isSettling || hasFinal ? [] : [empty]),
        ];
        if (
            parts.length !== container.children.length ||
            parts.some((part, i) => part !== container.children[i])
        ) {
            container.replaceChildren(...parts);
        }
        if (isSettling) {
            settling ??= waterSettling(settlingHost);
            settling.update({ series, showsLatest: !hasFinal, viewingDistance });
        }
    }

    const polling = followHistory(
        context,
        ({ tasks }) => {
            histories = tasks;
            if (!signal.aborted) {
                update();
            }
        },
        // What was shown stays. The header says when the service does not answer.
        () => {},
    );
    let { state } = context.job;
    update();
    return {
        update: () => {
            if (context.job.state !== state) {
                ({ state } = context.job);
                polling.now();
                update();
            }
        },
        destroy: () => {
            panel?.destroy();
            settling?.destroy();
        },
    };
}
