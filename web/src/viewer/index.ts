// The viewer as a module: `openViewer` puts it into an element.

import { Fragment } from './address.ts';
import { type View, pinholeOf, poseOf } from './camera.ts';
import { h } from './dom.ts';
import { download, megabytes } from './download.ts';
import { ViewerError, explained } from './errors.ts';
import { type RightSide, readFragment } from './link.ts';
import { drawMarks } from './marks.ts';
import { Panel } from './panel.ts';
import { partitionsOf } from './partitions.ts';
import { Photographs } from './photographs.ts';
import { frameAmong, isAntialiased, isInLinearLight, isPly, readHeader, waterAmong } from './ply.ts';
import { spreadOver } from './presets.ts';
import { type Mode, Renderer } from './renderer.ts';
import { type CameraEntry, type FetchFile, type Scene, checkScene } from './scene.ts';
import { Sorter } from './sorter.ts';
import { savePicture } from './still.ts';
import { type Quat, type Vec3, quatInverse, rotate } from './vector.ts';
import { Viewer } from './viewer.ts';
import type { WaterRecord } from './water.ts';
import './viewer.css';

export type { CameraEntry, FetchFile, Plan, Scene } from './scene.ts';
export type { RightSide } from './link.ts';
export type { Mode } from './renderer.ts';
export type { WaterRecord } from './water.ts';
export { ViewerError } from './errors.ts';
export { checkScene } from './scene.ts';

export interface Options {
    /** Keeps the view in the fragment of the page's address, so that links hold it. Off by default. */
    readonly useFragment?: boolean;
    /** Views to begin with: the fragment of a link to the viewer, with its bookmarks. */
    readonly views?: string;
    /** Without bookmarks in `views`, offers some cameras of photographs as "View 1", "View 2" and so on. */
    readonly suggestsViews?: boolean;
}

/** How many views are suggested. */
const SUGGESTED = 6;

/**
 * A viewer that is open. It is also the property `fathomViewer` of the container, so that tests and scripts
 * of a page reach it.
 */
export interface ViewerHandle {
    /** Sets the camera to exactly this one: its pose, its lens and its principal point. */
    setCamera(camera: CameraEntry): void;
    /** Sets what is shown; `split` is the place of the divider, 0 to 1. */
    setModes(left: Mode, right?: RightSide, split?: number): void;
    /** How many times the usual distance the water is; 1 is the water that was trained. */
    setAmount(amount: number): void;
    /** Resolves when the picture on the screen is complete for its camera. */
    settled(): Promise<void>;
    /** A picture of any size, RGBA, rows from the top. Without a camera it is that of the screen. */
    picture(request: {
        readonly width: number;
        readonly height: number;
        readonly camera?: CameraEntry;
        readonly mode?: Mode;
    }): Promise<ImageData>;
    /** Milliseconds for drawing and for sorting each of `count` frames. */
    measure(count: number): Promise<{ frame: number[]; sort: number[] }>;
    /** Number of Gaussians. */
    readonly gaussians: number;
    /**
     * Shows another model of the same scene; the camera, and what is shown, stay. Rejects with a
     * `ViewerError`, and then the model before stays too.
     */
    replaceModel(path: string): Promise<void>;
    /** Removes the viewer and frees its memory. */
    destroy(): void;
}

declare global {
    interface HTMLElement {
        fathomViewer?: ViewerHandle;
    }
}

/** A model that the renderer has. */
interface LoadedModel {
    /** Model axes. */
    readonly centres: Float32Array;
    /** Scene axes. */
    readonly inScene: Float32Array;
    readonly water: WaterRecord | null;
    readonly comments: readonly string[];
}

const viewOf = (camera: CameraEntry): View => ({
    pose: poseOf(camera),
    lens: { kind: 'exact', pinhole: pinholeOf(camera) },
});

/**
 * Opens a scene in `container`, which needs a size. Rejects with a `ViewerError` after showing it in the
 * container.
 */
export async function openViewer(
    container: HTMLElement,
    scene: Scene,
    fetchFile: FetchFile,
    options: Options = {},
): Promise<ViewerHandle> {
    const root = h('div', { class: 'fathom-viewer' });
    container.replaceChildren(root);
    try {
        return await open(container, root, checkScene(scene), fetchFile, options);
    } catch (thrown) {
        const error = explained(thrown);
        showError(container, error);
        throw error;
    }
}

/** Shows an error in place of the viewer. */
export function showError(container: HTMLElement, error: ViewerError): void {
    const text = h(
        'div',
        { class: 'fv-error', role: 'alert' },
        h('h1', {}, 'The scene cannot be shown'),
        h('p', {}, error.message),
        h('p', { class: 'fv-remedy' }, error.remedy),
    );
    container.replaceChildren(h('div', { class: 'fathom-viewer' }, text));
}

async function open(
    container: HTMLElement,
    root: HTMLElement,
    scene: Scene,
    fetchFile: FetchFile,
    options: Options,
): Promise<ViewerHandle> {
    const canvas = h('canvas', {
        class: 'fv-canvas',
        tabindex: 0,
        role: 'application',
        'aria-label': `3D view of ${scene.name}. Arrow keys turn, W A S D move, plus and minus come nearer.`,
    });
    const marks = h('canvas', { class: 'fv-marks', 'aria-hidden': 'true' });
    const photograph = h('img', { class: 'fv-photograph', alt: '', hidden: true });
    const loading = h('div', { class: 'fv-loading', role: 'status' });
    const bar = h('progress', { max: 1, 'aria-label': 'Loading' });
    const progress = h('p');
    loading.append(h('h1', {}, scene.name), bar, progress);
    // The picture, and what lies on it.
    const stage = h('div', { class: 'fv-stage' }, canvas, photograph, marks);
    root.append(stage, loading);

    let viewer: Viewer | null = null;
    const lost = h('div', { class: 'fv-lost', role: 'alert', hidden: true }, 'The browser took the graphics memory away. Waiting for it to return …');
    stage.append(lost);
    const renderer = new Renderer(
        canvas,
        () => (lost.hidden = false),
        () => {
            lost.hidden = true;
            viewer?.redraw();
        },
    );
    const hasPartitions = scene.plan !== null && scene.plan.partitions.length > 1;
    /** Fetches a model and gives it to the renderer. */
    const loadModel = async (
        path: string,
        onProgress: (done: number, total: number) => void,
        onFetched: () => Promise<void>,
    ): Promise<LoadedModel> => {
        const bytes = await download(path, fetchFile, onProgress);
        await onFetched();
        const header = isPly(bytes) ? readHeader(bytes, path) : null;
        if (header === null && !/\.sog$/i.test(path)) {
            throw new ViewerError(
                `${path} is not a model that can be read.`,
                'Use a .ply of 3D Gaussians, a .compressed.ply or a .sog.',
            );
        }
        const kind = header === null ? 'sog' : 'ply';
        const comments = header?.comments ?? [];
        const toModel: Quat = frameAmong(comments) ?? [0, 0, 0, 1];
        const response = new Response(bytes as Uint8Array<ArrayBuffer>);
        const centres = await renderer.load(response, path, kind, isAntialiased(comments), toModel);
        const water = scene.water ?? waterAmong(comments);
        renderer.setWater(water);
        const inScene = turnedCentres(centres, quatInverse(toModel));
        if (scene.plan !== null && hasPartitions) {
            renderer.setPartitions(partitionsOf(scene.plan, inScene));
        }
        return { centres, inScene, water, comments };
    };
    const { centres, inScene, water, comments } = await loadModel(
        scene.model,
        (done, total) => {
            const ofTotal = total > 0 ? ` of ${megabytes(total)}` : '';
            progress.textContent = `${megabytes(done)}${ofTotal} MB`;
            if (total > 0) {
                bar.value = done / total;
            }
        },
        async () => {
            progress.textContent = 'Preparing the model';
            bar.removeAttribute('value');
            // Lets the browser show the text before it is busy.
            await new Promise((done) => setTimeout(done, 0));
        },
    );
    const sorter = new Sorter(centres);
    viewer = new Viewer(scene, water, canvas, renderer, sorter, inScene, hasPartitions);
    let gaussians = centres.length / 3;
    const opened = viewer;
    const begin = readFragment(options.views ?? '');
    opened.bookmarks = begin.bookmarks;
    if (options.suggestsViews === true && begin.bookmarks.length === 0) {
        opened.suggested = spreadOver(opened.cameras, SUGGESTED).map(({ img_name }) => img_name);
    }

    const panel = new Panel(opened, {
        hasLinks: options.useFragment === true,
        savePicture: () => savePicture(opened, photograph, panel),
    });
    stage.append(panel.divider, panel.legend);
    root.append(panel.element);
    const stop = new AbortController();
    const photographs = new Photographs(opened, photograph, fetchFile, panel);
    const fragment = options.useFragment === true ? new Fragment(opened, panel, stop.signal) : null;
    opened.onFrame = () => {
        drawMarks(opened, marks);
        placeDivider(opened, panel.divider, photograph);
        panel.updateLegend();
    };
    opened.onChange = () => {
        panel.update();
        void photographs.update();
        fragment?.write();
    };
    const dark = window.matchMedia('(prefers-color-scheme: dark)');
    const colour = (): void => opened.setBackground(backgroundOf(root));
    dark.addEventListener('change', colour, { signal: stop.signal });
    colour();
    if (begin.view !== null) {
        opened.show(begin.view);
    }
    fragment?.read();
    void photographs.update();
    await opened.settled();
    loading.remove();
    if (isInLinearLight(comments)) {
        panel.say('This file holds colours in linear light, so the picture is too dark. Open the model itself.');
    }

    const handle: ViewerHandle = {
        get gaussians() {
            return gaussians;
        },
        replaceModel: async (path) => {
            try {
                const next = await loadModel(path, () => {}, async () => {});
                opened.replace(new Sorter(next.centres), next.water);
                gaussians = next.centres.length / 3;
            } catch (thrown) {
                throw explained(thrown);
            }
            await opened.settled();
        },
        setCamera: (camera) => {
            const { pose, lens } = viewOf(camera);
            const isKnown = opened.cameras.some(({ img_name }) => img_name === camera.img_name);
            const place = { pose, distance: opened.state.place.distance };
            opened.set({ place, lens, photograph: isKnown ? camera.img_name : null });
        },
        setModes: (left, right = 'none', split = 0.5) => opened.set({ left, right, split }),
        setAmount: (amount) => opened.set({ amount }),
        settled: () => opened.settled(),
        picture: ({ width, height, camera, mode }) =>
            opened.picture({
                width,
                height,
                ...(camera === undefined ? {} : { view: viewOf(camera) }),
                ...(mode === undefined ? {} : { left: mode, right: mode, split: 1 }),
            }),
        measure: (count) => opened.measure(count),
        destroy: () => {
            stop.abort();
            photographs.destroy();
            opened.destroy();
            root.remove();
            delete container.fathomViewer;
        },
    };
    container.fathomViewer = handle;
    return handle;
}

function turnedCentres(centres: Float32Array, turn: Quat): Float32Array {
    if (turn[3] === 1) {
        return centres;
    }
    const result = new Float32Array(centres.length);
    for (let i = 0; i < centres.length; i += 3) {
        result.set(rotate(turn, [centres[i]!, centres[i + 1]!, centres[i + 2]!]), i);
    }
    return result;
}

/** The colour of the page behind the picture. */
function backgroundOf(root: HTMLElement): Vec3 {
    const parts = getComputedStyle(root).backgroundColor.match(/[\d.]+/g)?.map(Number) ?? [];
    return [(parts[0] ?? 0) / 255, (parts[1] ?? 0) / 255, (parts[2] ?? 0) / 255];
}

/** Puts the divider and the photograph where the picture is. */
function placeDivider(viewer: Viewer, divider: HTMLElement, photograph: HTMLImageElement): void {
    const area = viewer.area();
    const { split, right } = viewer.state;
    divider.style.left = `${area.x + split * area.width}px`;
    divider.style.top = `${area.y}px`;
    divider.style.height = `${area.height}px`;
    photograph.hidden = right !== 'photograph';
    photograph.style.left = `${area.x}px`;
    photograph.style.top = `${area.y}px`;
    photograph.style.width = `${area.width}px`;
    photograph.style.height = `${area.height}px`;
    photograph.style.clipPath = `inset(0 0 0 ${100 * split}%)`;
}
