// The viewer of a job: on the finished model, and before that on what its tasks have trained so far. A large
// model is loaded when somebody asks for it.

import type { CameraEntry, Plan, Scene, ViewerHandle, WaterRecord } from '../../viewer/index.ts';
import { ViewerError } from '../../viewer/errors.ts';
import { problemOf } from '../context.ts';
import { h, setText } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { bytesText } from '../format.ts';
import { filePath } from '../api.ts';
import { LiveModel, camerasOf } from './live-model.ts';
import { type Live, liveBytes, liveOf, liveText, nothingText } from './live-state.ts';
import { Photographs } from './photographs.ts';
import type { JobContext, Section } from './section.ts';

const MODEL = 'model.ply';
/** What the coordinator makes of it for viewing, with about a quarter of the bytes. */
const COPY = 'model.compressed.ply';
/** Of smaller models the copy is not worth its errors. */
const COPY_FROM_BYTES = 32e6;
/** Before the names of models that are made here: each has a name of its own. */
const LIVE = 'live:';
/** Before the names of photographs, which are blobs and no files of the job. */
const PHOTOGRAPH = 'photograph:';
/** Smaller models are loaded without a question. */
const ASK_FROM_BYTES = 100e6;

const loadingText = (text: string): HTMLElement => h('p', { class: 'loading', role: 'status' }, text);

export function open(container: HTMLElement, context: JobContext): Section {
    const { id, session, signal } = context;
    const photographs = new Photographs(context);
    const host = h('div', { class: 'viewer-host' });
    const shownText = h('span');
    const newText = h('span');
    const refresh = h('button', { type: 'button', onclick: () => void renew() }, 'Show it');
    const whole = h(
        'button',
        {
            type: 'button',
            hidden: true,
            onclick: () => {
                wantsWhole = true;
                void renew();
            },
        },
        'Load the whole model',
    );
    const line = h(
        'div',
        { class: 'row between live' },
        h('p', { role: 'status' }, shownText),
        h('div', { class: 'row' }, h('p', { role: 'status' }, newText), refresh, whole),
    );
    let handle: ViewerHandle | null = null;
    let models: Promise<LiveModel> | null = null;
    /** What the viewer shows, or is about to show. */
    let shown: Live | null = null;
    /** Whether the copy of the model does not do. */
    let wantsWhole = false;
    /** What is said about the copy that is shown; empty where it is the model itself. */
    let copyText = '';
    /** What is told in place of the viewer. */
    let told = '';
    let isBusy = false;
    /** Whether the viewer could not be opened. */
    let isBroken = false;
    /** A PLY that was made here, until the viewer has read it. */
    let made: { readonly path: string; readonly bytes: Uint8Array<ArrayBuffer> } | null = null;
    let count = 0;

    const fetchFile = async (path: string): Promise<Response> => {
        if (path === made?.path) {
            return new Response(made.bytes);
        }
        if (!path.startsWith(PHOTOGRAPH)) {
            return session.api.fetch(filePath(id, path), { signal });
        }
        const content = await photographs.fetch(path.slice(PHOTOGRAPH.length));
        return content === null ? new Response(null, { status: 404 }) : new Response(content);
    };

    const readPlan = async (): Promise<Plan | null> => {
        const digest = context.job.plan?.digest ?? '';
        return digest === '' ? null : ((await session.api.json(digest, id, signal)) as Plan);
    };

    const readCameras = async (): Promise<CameraEntry[] | null> => {
        const digest = context.job.manifest?.digest ?? '';
        // Without cameras the model can still be seen.
        const manifest = digest === '' ? null : await session.api.json(digest, id, signal).catch(() => null);
        const cameras = camerasOf(manifest);
        return cameras.length === 0 ? null : cameras;
    };

    /** The file of the finished model that is loaded, and how many bytes the model and this file have. */
    async function fileOf(): Promise<{ path: string; bytes: number; modelBytes: number }> {
        const files = await context.files();
        const bytesOf = (name: string): number => Number(files.find(({ path }) => path === name)?.blob?.sizeBytes ?? 0);
        const [modelBytes, copyBytes] = [bytesOf(MODEL), bytesOf(COPY)];
        const isCopy = !wantsWhole && modelBytes >= COPY_FROM_BYTES && copyBytes > 0;
        return { path: isCopy ? COPY : MODEL, bytes: isCopy ? copyBytes : modelBytes, modelBytes };
    }

    /** The path of a model for the viewer, and what is said about a copy. A model that is not finished is made. */
    async function pathOf(live: Live, onStep: (text: string) => void): Promise<{ path: string; words: string }> {
        if (live.kind === 'finished') {
            const { path, bytes, modelBytes } = await fileOf();
            const sizes = `${bytesText(bytes)} instead of ${bytesText(modelBytes)}`;
            return { path, words: path === COPY ? `A copy for viewing: ${sizes}.` : '' };
        }
        models ??= readPlan().then((plan) => {
            if (plan === null) {
                throw new Error('The job has no plan yet.');
            }
            return new LiveModel(context, plan);
        });
        const model = await models.catch((error: unknown) => {
            models = null;
            throw error;
        });
        const bytes = await model.ply(live, (done, total) =>
            onStep(total > 1 ? `Loading model ${done + 1} of ${total} …` : 'Loading the model …'),
        );
        count += 1;
        made = { path: `${LIVE}${count}.ply`, bytes };
        return { path: made.path, words: '' };
    }

    async function sceneOf(live: Live, onStep: (text: string) => void): Promise<Scene> {
        const isFinished = live.kind === 'finished';
        const [water, cameras, plan, digests] = await Promise.all([
            isFinished ? context.json('water.json') : null,
            isFinished ? context.json('cameras.json') : readCameras(),
            isFinished ? context.json('plan.json') : readPlan(),
            // Without photographs the model can still be seen.
            photographs.digests().catch(() => new Map<string, string>()),
        ]);
        const { path, words } = await pathOf(live, onStep);
        copyText = words;
        return {
            name: context.job.name === '' ? id : context.job.name,
            model: path,
            // Without a record, that among the comments of the model is taken.
            water: water as WaterRecord | null,
            cameras: cameras as CameraEntry[] | null,
            plan: plan as Plan | null,
            photographs: Object.fromEntries(
                [...digests.keys()].map((name) => [name, `${PHOTOGRAPH}${name}`]),
            ),
            credits: '',
        };
    }

    const failed = (error: unknown): void => {
        const fault = faultOf(error);
        const text = problemOf('The viewer cannot be opened', fault);
        if (text !== null && !signal.aborted) {
            const again = h('button', { type: 'button', onclick: () => start() }, 'Try again');
            text.append(again);
            container.replaceChildren(text);
        }
    };

    async function load(live: Live): Promise<void> {
        isBusy = true;
        shown = live;
        const loading = loadingText('Loading the viewer …');
        container.replaceChildren(loading);
        try {
            const onStep = (text: string): void => setText(loading, text);
            const [{ openViewer }, scene] = await Promise.all([
                import('../../viewer/index.ts'),
                sceneOf(live, onStep),
            ]);
            if (signal.aborted) {
                return;
            }
            container.replaceChildren(line, host);
            // The viewer itself shows what is wrong.
            const opened = await openViewer(host, scene, fetchFile).catch(() => null);
            isBroken = opened === null;
            if (signal.aborted) {
                opened?.destroy();
            } else {
                handle = opened;
            }
        } catch (error) {
            failed(error);
        } finally {
            made = null;
            isBusy = false;
            drawLine();
        }
    }

    /** Shows the newest model in place of the one before; the camera stays. */
    async function renew(): Promise<void> {
        const live = liveOf(context.job);
        if (live === null || handle === null || isBusy) {
            return;
        }
        isBusy = true;
        refresh.disabled = true;
        whole.disabled = true;
        // Only the button for the whole model asks for another file of the same model.
        const which = live.key === shown?.key ? 'whole' : 'newer';
        try {
            const { path, words } = await pathOf(live, (text) => setText(newText, text));
            setText(newText, 'Loading …');
            await handle.replaceModel(path);
            // Until now the line is about the model before.
            copyText = words;
            shown = live;
        } catch (error) {
            wantsWhole &&= copyText === '';
            const why =
                error instanceof ViewerError ? `${error.message} ${error.remedy}` : faultOf(error).message;
            context.say(`The ${which} model cannot be shown. ${why}`);
        } finally {
            made = null;
            refresh.disabled = false;
            whole.disabled = false;
            isBusy = false;
            drawLine();
        }
    }

    function drawLine(): void {
        const newest = liveOf(context.job);
        const isNew = handle !== null && newest !== null && newest.key !== shown?.key;
        const isCopy = shown?.kind === 'finished' && copyText !== '';
        // A viewer that was opened on the finished model needs no words.
        line.hidden = shown?.kind === 'finished' && !isNew && !isCopy;
        setText(shownText, shown === null ? '' : isCopy ? copyText : liveText(shown));
        whole.hidden = !isCopy || handle === null;
        if (!isBusy) {
            setText(newText, isNew ? `There is more: ${liveText(newest)}` : '');
        }
        refresh.hidden = !isNew;
    }

    function tell(text: string): void {
        if (told !== text) {
            told = text;
            container.replaceChildren(
                h('div', { class: 'empty' }, h('h2', {}, 'Nothing yet'), h('p', {}, text)),
            );
        }
    }

    /** Asks before a large model is loaded. */
    async function offer(live: Live): Promise<void> {
        isBusy = true;
        container.replaceChildren(loadingText('Loading the viewer …'));
        try {
            const bytes = live.kind === 'finished' ? (await fileOf()).bytes : liveBytes(live);
            if (bytes < ASK_FROM_BYTES) {
                await load(live);
                return;
            }
            const words = `Load the model (${bytesText(bytes)})`;
            const button = h(
                'button',
                { type: 'button', class: 'primary', onclick: () => void load(liveOf(context.job) ?? live) },
                words,
            );
            const why = 'The whole model is loaded into the memory of this computer and its graphics card.';
            container.replaceChildren(
                h('div', { class: 'empty' }, h('h2', {}, 'A large model'), h('p', {}, why), button),
            );
        } catch (error) {
            failed(error);
        }
        isBusy = false;
    }

    function start(): void {
        const live = liveOf(context.job);
        shown = live;
        isBroken = false;
        if (live === null) {
            tell(nothingText(context.job));
        } else {
            told = '';
            void offer(live);
        }
    }

    start();
    return {
        update: () => {
            const isOther = isBroken && liveOf(context.job)?.key !== shown?.key;
            if ((shown === null || isOther) && !isBusy) {
                start();
            } else {
                drawLine();
            }
        },
        destroy: () => handle?.destroy(),
    };
}
