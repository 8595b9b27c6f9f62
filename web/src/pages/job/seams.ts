// The seams of a job that has succeeded: whether the borders of its partitions show.

import { JobState } from '../../rpc/fathom/v1/job_pb.ts';
import type { CameraEntry } from '../../viewer/scene.ts';
import { problemOf } from '../context.ts';
import { freshId, h } from '../dom.ts';
import { faultOf } from '../faults.ts';
import type { PlanContent } from '../parts/plan-layout.ts';
import type { SeamMetrics } from '../parts/seam-report.ts';
import { seamsPanel } from '../parts/seams-panel.ts';
import { Addresses } from './addresses.ts';
import { type JobContext, type Section, whenSucceeded } from './section.ts';

/** Pictures of borders are named after their views. */
const PICTURE = /^renders\/border_\d+_(.*)\.png$/;
const ONE_PARTITION = 'The scene was not cut, so there are no borders between partitions that could show.';

const emptyBox = (title: string, text: string): HTMLElement =>
    h('div', { class: 'empty' }, h('h2', {}, title), h('p', {}, text));

/** The pictures of borders, one at a time. */
function makePictures(context: JobContext, addresses: Addresses, paths: readonly string[]): HTMLElement {
    const { id, session, signal } = context;
    const selectId = freshId();
    const image = h('img', { class: 'border-picture', alt: '' });
    const said = h('p', { class: 'soft', role: 'status' });
    const show = async (path: string): Promise<void> => {
        try {
            said.textContent = '';
            const address = addresses.of(await session.api.file(id, path, signal));
            if (path === select.value) {
                image.src = address;
                const name = PICTURE.exec(path)?.[1] ?? path;
                image.alt = `Borders in the held-out view ${name}: render and difference`;
            }
        } catch (error) {
            const fault = faultOf(error);
            said.textContent = fault.kind === 'ended' ? '' : `The picture cannot be shown. ${fault.message}`;
        }
    };
    const options = paths.map((path) => h('option', { value: path }, PICTURE.exec(path)?.[1] ?? path));
    const select = h('select', { id: selectId, onchange: () => void show(select.value) }, ...options);
    void show(select.value);
    return h(
        'div',
        { class: 'card fp' },
        h('div', { class: 'fp-bar' }, h('label', { for: selectId }, 'Held-out view'), select),
        h(
            'p',
            { class: 'fp-note' },
            'The render and beside it the difference from the photograph, where bright pixels mark errors. ' +
                'Borders are yellow, lines where nothing was cut are blue.',
        ),
        image,
        said,
    );
}

export function open(container: HTMLElement, context: JobContext): Section {
    const addresses = new Addresses();
    let stop: (() => void) | null = null;
    const show = async (): Promise<void> => {
        container.replaceChildren(h('p', { class: 'loading', role: 'status' }, 'Loading the seams …'));
        try {
            const [found, plan, cameras, files] = await Promise.all([
                context.json('metrics.json'),
                context.json('plan.json'),
                context.json('cameras.json'),
                context.files(),
            ]);
            if (context.signal.aborted) {
                return;
            }
            const { seams, views } = (found ?? {}) as SeamMetrics;
            if (!seams) {
                const text = context.job.partitions === 1 ? ONE_PARTITION : 'Seams were not measured.';
                container.replaceChildren(emptyBox('No seams', text));
                return;
            }
            const host = h('div', { class: 'card' });
            const pictures = files.map(({ path }) => path).filter((path) => PICTURE.test(path));
            container.replaceChildren(host);
            const panel = seamsPanel(host);
            stop = () => panel.destroy();
            panel.update({
                seams,
                views: views ?? [],
                plan: plan as PlanContent | null,
                cameras: cameras as CameraEntry[] | null,
            });
            if (pictures.length > 0) {
                container.append(
                    h('h2', {}, 'Borders in held-out views'),
                    makePictures(context, addresses, pictures),
                );
            }
        } catch (error) {
            const shown = problemOf('The seams cannot be shown', faultOf(error));
            if (shown !== null) {
                container.replaceChildren(shown);
            }
        }
    };
    const section = whenSucceeded(container, context, 'The seams between partitions', () => void show());
    const isOne = emptyBox('No seams', ONE_PARTITION);
    const update = (): void => {
        section.update();
        const { partitions, state } = context.job;
        if (partitions === 1 && state !== JobState.SUCCEEDED && !isOne.isConnected) {
            container.replaceChildren(isOne);
        }
    };
    update();
    return {
        update,
        destroy: () => {
            stop?.();
            addresses.revoke();
        },
    };
}
