// The viewer of a job that has succeeded. The model is loaded when somebody asks for it, since it may be
// large.

import type { CameraEntry, Plan, Scene, ViewerHandle, WaterRecord } from '../../viewer/index.ts';
import { problemOf } from '../context.ts';
import { h } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { bytesText } from '../format.ts';
import { filePath } from '../api.ts';
import { Photographs } from './photographs.ts';
import { type JobContext, type Section, whenSucceeded } from './section.ts';

const MODEL = 'model.ply';
/** Before the names of photographs, which are blobs and no files of the job. */
const PHOTOGRAPH = 'photograph:';
/** Smaller models are loaded without a question. */
const ASK_FROM_BYTES = 100e6;

async function sceneOf(context: JobContext, photographs: Photographs): Promise<Scene> {
    const [water, cameras, plan, digests] = await Promise.all([
        context.json('water.json'),
        context.json('cameras.json'),
        context.json('plan.json'),
        // Without photographs the model can still be seen.
        photographs.digests().catch(() => new Map<string, string>()),
    ]);
    return {
        name: context.job.name === '' ? context.id : context.job.name,
        model: MODEL,
        water: water as WaterRecord | null,
        cameras: cameras as CameraEntry[] | null,
        plan: plan as Plan | null,
        photographs: Object.fromEntries([...digests.keys()].map((name) => [name, `${PHOTOGRAPH}${name}`])),
        credits: '',
    };
}

export function open(container: HTMLElement, context: JobContext): Section {
    const { id, session, signal } = context;
    let handle: ViewerHandle | null = null;
    const photographs = new Photographs(context);
    const fetchFile = async (path: string): Promise<Response> => {
        if (!path.startsWith(PHOTOGRAPH)) {
            return session.api.fetch(filePath(id, path), { signal });
        }
        const content = await photographs.fetch(path.slice(PHOTOGRAPH.length));
        return content === null ? new Response(null, { status: 404 }) : new Response(content);
    };
    const load = async (): Promise<void> => {
        const host = h('div', { class: 'viewer-host' });
        container.replaceChildren(h('p', { class: 'loading', role: 'status' }, 'Loading the viewer …'));
        try {
            const [{ openViewer }, scene] = await Promise.all([import('../../viewer/index.ts'), sceneOf(context, photographs)]);
            if (signal.aborted) {
                return;
            }
            container.replaceChildren(host);
            const opened = await openViewer(host, scene, fetchFile).catch(() => null);
            if (signal.aborted) {
                opened?.destroy();
            } else {
                handle = opened;
            }
        } catch (error) {
            const shown = problemOf('The viewer cannot be opened', faultOf(error));
            if (shown !== null && !signal.aborted) {
                container.replaceChildren(shown);
            }
        }
    };
    const offer = async (): Promise<void> => {
        container.replaceChildren(h('p', { class: 'loading', role: 'status' }, 'Loading the viewer …'));
        try {
            const model = (await context.files()).find(({ path }) => path === MODEL);
            const bytes = Number(model?.blob?.sizeBytes ?? 0);
            if (bytes < ASK_FROM_BYTES) {
                await load();
                return;
            }
            const start = h('button', { type: 'button', class: 'primary', onclick: () => void load() }, `Load the model (${bytesText(bytes)})`);
            container.replaceChildren(
                h('div', { class: 'empty' }, h('h2', {}, 'A large model'), h('p', {}, 'The whole model is loaded into the memory of this computer and its graphics card.'), start),
            );
        } catch (error) {
            const shown = problemOf('The viewer cannot be opened', faultOf(error));
            if (shown !== null && !signal.aborted) {
                container.replaceChildren(shown);
            }
        }
    };
    const section = whenSucceeded(container, context, 'The trained scene', () => void offer());
    return { update: section.update, destroy: () => handle?.destroy() };
}
