// The viewer without its controls: state, camera, sorting and drawing. The panel and the handle for tests work
// on this.

import {
    type Lens,
    type Pinhole,
    type Pose,
    type ToPixel,
    type View,
    freeLensLike,
    pictureArea,
    pinholeOf,
    poseOf,
    project,
    projectorOf,
} from './camera.ts';
import { Input } from './input.ts';
import type { Bookmark, RightSide, SavedView } from './link.ts';
import { type Control, type Place, axesOf, lookingAt, moved, turned, zoomed } from './navigation.ts';
import type { Frame, Mode, Renderer } from './renderer.ts';
import type { CameraEntry, Plan, Scene } from './scene.ts';
import type { Sorter } from './sorter.ts';
import { type Vec3, add, dot, length, rotate, scale, sub, unit } from './vector.ts';
import type { WaterRecord } from './water.ts';

/** What the controls show and change. */
export interface State {
    readonly place: Place;
    readonly lens: Lens;
    /** The photograph whose camera is used exactly. */
    readonly photograph: string | null;
    readonly left: Mode;
    readonly right: RightSide;
    readonly split: number;
    readonly amount: number;
    readonly control: Control;
    readonly showsCameras: boolean;
}

/** Pixels of the canvas by CSS pixel are at most this; more costs time and shows nothing. */
const MOST_DENSITY = 2;
/** If frames take longer than this while the camera moves, they are drawn smaller. Milliseconds. */
const SLOW_FRAME = 55;
/** Time without movement after which a frame is drawn in full. Milliseconds. */
const REST = 180;
const FIELD_OF_VIEW = (55 * Math.PI) / 180;

const median = (values: number[]): number => values.toSorted((a, b) => a - b)[Math.floor(values.length / 2)] ?? 0;

/** The vertical: from the plan, or the mean over the cameras, or up in a COLMAP model without either. */
export function upOf(plan: Plan | null, cameras: readonly CameraEntry[]): Vec3 {
    if (plan !== null) {
        return unit(scale(plan.alignment.down, -1), [0, -1, 0]);
    }
    const ups = cameras.map((entry): Vec3 => scale(entry.rotation.map((row) => row[1]) as unknown as Vec3, -1));
    return unit(
        ups.reduce<Vec3>((sum, up) => add(sum, up), [0, 0, 0]),
        [0, -1, 0],
    );
}

/** Middle and size of a model, from at most 4096 of its centres, so that far Gaussians do not matter. */
function extentOf(centres: Float32Array): { middle: Vec3; size: number } {
    const count = centres.length / 3;
    const step = Math.max(1, Math.floor(count / 4096));
    const sampled = Array.from({ length: Math.ceil(count / step) }, (_, i) => i * step);
    const along = (axis: number): number => median(sampled.map((i) => centres[3 * i + axis]!));
    const middle: Vec3 = [along(0), along(1), along(2)];
    const distances = sampled.map((i) =>
        length(sub([centres[3 * i]!, centres[3 * i + 1]!, centres[3 * i + 2]!], middle)),
    );
    return { middle, size: median(distances) || 1 };
}

export class Viewer {
    readonly scene: Scene;
    readonly cameras: readonly CameraEntry[];
    water: WaterRecord | null;
    readonly up: Vec3;
    readonly hasPartitions: boolean;
    readonly canvas: HTMLCanvasElement;
    state: State;
    bookmarks: Bookmark[] = [];
    /** Photographs whose cameras are offered as views. */
    suggested: readonly string[] = [];
    /** 2nd and 98th percentile of the ranges in the picture, scene units. */
    rangeScale: readonly [number, number] = [0, 1];
    /** Called after each change of the state. */
    onChange: () => void = () => {};
    /** Called after each frame. */
    onFrame: () => void = () => {};

    readonly #renderer: Renderer;
    #sorter: Sorter;
    readonly #input: Input;
    readonly #resized: ResizeObserver;
    /** Length of a second of movement, scene units. */
    readonly #pace: number;
    readonly #home: State;
    readonly #overview: { place: Place; lens: Lens; photograph: null };
    #background: Vec3 = [0, 0, 0];
    #frameAsked = 0;
    #lastFrame = 0;
    #lastMovement = 0;
    #slow = false;
    #frameTimes: number[] = [];
    #sorted: Pose | null = null;
    #sorting: Pose | null = null;
    #settled: (() => void)[] = [];
    #busy: Promise<unknown> = Promise.resolve();
    #isBusy = false;

    constructor(
        scene: Scene,
        water: WaterRecord | null,
        canvas: HTMLCanvasElement,
        renderer: Renderer,
        sorter: Sorter,
        centres: Float32Array,
        hasPartitions: boolean,
    ) {
        this.scene = scene;
        this.cameras = scene.cameras ?? [];
        this.water = water;
        this.canvas = canvas;
        this.hasPartitions = hasPartitions;
        this.up = upOf(scene.plan, this.cameras);
        this.#renderer = renderer;
        this.#sorter = sorter;
        const { middle, size } = extentOf(centres);
        const home = this.#start(middle, size);
        this.#overview = this.#overviewOf(middle, size);
        this.#pace = home.place.distance * 0.6;
        this.#home = home;
        this.state = home;
        this.#input = new Input(canvas, {
            turn: (yaw, pitch) => this.go(turned(this.state.place, this.state.control, this.up, yaw, pitch)),
            pan: (x, y) => {
                const step = this.state.place.distance / this.#screenCamera().fx;
                this.go(moved(this.state.place, 'fly', this.up, [-x * step, y * step, 0]));
            },
            zoom: (factor) => {
                const place = zoomed(this.state.place, this.state.control, factor);
                // At the pivot an orbit could neither turn nor leave.
                if (place.distance > 1e-3 * home.place.distance || factor > 1) {
                    this.go(place);
                }
            },
            move: (right, rise, forward) => {
                const steps: Vec3 = [right * this.#pace, rise * this.#pace, forward * this.#pace];
                this.go(moved(this.state.place, this.state.control, this.up, steps));
            },
            click: (x, y) => this.#clickCamera(x, y),
            pick: (x, y) => void this.#pickPivot(x, y),
            pickMiddle: () => {
                const { x, y, width, height } = this.area();
                void this.#pickPivot(x + width / 2, y + height / 2);
            },
            reset: () => this.reset(),
            photograph: (step) => this.stepPhotograph(step),
        });
        this.#resized = new ResizeObserver(() => this.redraw());
        this.#resized.observe(canvas);
    }

    get hasPhotograph(): boolean {
        const name = this.state.photograph;
        return name !== null && Object.hasOwn(this.scene.photographs, name);
    }

    setBackground(colour: Vec3): void {
        this.#background = colour;
        this.redraw();
    }

    /** Changes the state and draws. */
    set(change: Partial<State>): void {
        this.state = { ...this.state, ...change };
        if (this.state.right === 'photograph' && !this.hasPhotograph) {
            this.state = { ...this.state, right: 'none' };
        }
        this.redraw();
        this.onChange();
    }

    /** Moves the camera by hand: the lens is free from then on. */
    go(place: Place): void {
        this.#lastMovement = performance.now();
        const lens = this.state.lens.kind === 'exact' ? freeLensLike(this.state.lens.pinhole) : this.state.lens;
        this.set({ place, lens, photograph: null });
    }

    reset(): void {
        const { place, lens, photograph } = this.#home;
        this.set({ place, lens, photograph });
    }

    /** Exactly the camera of a photograph. */
    goToPhotograph(name: string): boolean {
        const entry = this.cameras.find((camera) => camera.img_name === name);
        if (entry === undefined) {
            return false;
        }
        const place = { pose: poseOf(entry), distance: this.state.place.distance };
        this.set({ place, lens: { kind: 'exact', pinhole: pinholeOf(entry) }, photograph: name });
        return true;
    }

    overview(): void {
        this.set(this.#overview);
    }

    stepPhotograph(step: number): void {
        const count = this.cameras.length;
        if (count > 0) {
            const at = this.cameras.findIndex((camera) => camera.img_name === this.state.photograph);
            const from = at < 0 && step < 0 ? 0 : at;
            this.goToPhotograph(this.cameras[(from + step + count) % count]!.img_name);
        }
    }

    saved(): SavedView {
        const { place, lens, photograph, left, right, split, amount } = this.state;
        const fov = lens.kind === 'free' ? lens.fov : null;
        return { pose: place.pose, fov, photograph, left, right, split, amount };
    }

    show(view: SavedView): void {
        const { left, right, split, amount } = view;
        const exists = view.photograph !== null && this.goToPhotograph(view.photograph);
        if (!exists) {
            const lens: Lens = { kind: 'free', fov: view.fov ?? FIELD_OF_VIEW };
            this.set({ place: { ...this.state.place, pose: view.pose }, lens, photograph: null });
        }
        const available = (mode: Mode): Mode => (this.modes().includes(mode) ? mode : 'clear');
        const isMode = right !== 'none' && right !== 'photograph';
        this.set({ left: available(left), right: isMode ? available(right) : right, split, amount });
    }

    /** The modes that this scene has. */
    modes(): Mode[] {
        const ofWater: Mode[] = this.water === null ? [] : ['water', 'veil'];
        const ofPlan: Mode[] = this.hasPartitions ? ['partition'] : [];
        return ['clear', ...ofWater, 'range', 'normal', 'alpha', ...ofPlan];
    }

    /** The rectangle of the picture, CSS pixels from the top left of the canvas. */
    area(): { x: number; y: number; width: number; height: number } {
        return pictureArea(this.state.lens, this.canvas.clientWidth, this.canvas.clientHeight);
    }

    /** From points of the scene to CSS pixels from the top left of the canvas. */
    toScreen(): ToPixel {
        const area = this.area();
        const camera = this.#screenCamera();
        const shifted = { ...camera, cx: camera.cx + area.x, cy: camera.cy + area.y };
        return projectorOf(this.state.place.pose, shifted);
    }

    redraw(): void {
        if (this.#frameAsked === 0) {
            this.#frameAsked = requestAnimationFrame((now) => this.#frame(now));
        }
    }

    /** Resolves when the picture on the screen is sorted for its camera and has full size. */
    settled(): Promise<void> {
        this.redraw();
        return new Promise((done) => this.#settled.push(done));
    }

    /** A picture of any camera and size: RGBA, rows from the top. */
    async picture(request: {
        readonly width: number;
        readonly height: number;
        readonly view?: View;
        readonly left?: Mode;
        readonly right?: Mode;
        readonly split?: number;
    }): Promise<ImageData> {
        const view = request.view ?? { pose: this.state.place.pose, lens: this.state.lens };
        const { width, height } = request;
        if (Math.max(width, height) > this.#renderer.largestSide) {
            throw new RangeError(`a picture may have ${this.#renderer.largestSide} pixels on a side on this device`);
        }
        // One picture at a time: the order of the Gaussians on the device belongs to one camera.
        const before = this.#busy;
        const { promise, resolve: free } = Promise.withResolvers<void>();
        this.#busy = promise;
        await before;
        this.#isBusy = true;
        try {
            const camera = project(view.lens, width, height);
            await this.#sortFor(view.pose, camera);
            const pixels = await this.#renderer.picture({
                ...this.#frameOf(view.pose, camera),
                left: request.left ?? this.state.left,
                right: request.right ?? this.#rightMode(),
                split: request.split ?? this.#split(),
            });
            return new ImageData(pixels, width, height);
        } finally {
            this.#isBusy = false;
            free();
            this.redraw();
        }
    }

    /** Milliseconds of each of `count` frames at the present size, each sorted and finished. */
    async measure(count: number): Promise<{ frame: number[]; sort: number[] }> {
        await this.settled();
        const [frame, sort]: [number[], number[]] = [[], []];
        const { pose } = this.state.place;
        for (let i = 0; i < count; i++) {
            await this.#sortFor(pose, this.#screenCamera());
            sort.push(this.#sorter.lastMilliseconds);
            const started = performance.now();
            this.#draw();
            this.#renderer.finish();
            frame.push(performance.now() - started);
        }
        return { frame, sort };
    }

    /** Shows another model, which the renderer has loaded. The camera and what is shown stay. */
    replace(sorter: Sorter, water: WaterRecord | null): void {
        this.#sorter.destroy();
        this.#sorter = sorter;
        this.water = water;
        this.#sorted = null;
        this.#sorting = null;
        this.redraw();
    }

    destroy(): void {
        cancelAnimationFrame(this.#frameAsked);
        this.#input.destroy();
        this.#resized.disconnect();
        this.#sorter.destroy();
        this.#renderer.destroy();
    }

    /** The whole model, from above and from the side. */
    #overviewOf(middle: Vec3, size: number): { place: Place; lens: Lens; photograph: null } {
        const side: Vec3 = [0.4, 0.2, -1];
        const level = unit(sub(side, scale(this.up, dot(side, this.up))));
        const eye = add(middle, add(scale(level, 2.6 * size), scale(this.up, 1.3 * size)));
        const place = { pose: lookingAt(eye, middle, this.up), distance: length(sub(middle, eye)) };
        return { place, lens: { kind: 'free', fov: FIELD_OF_VIEW }, photograph: null };
    }

    /** The first view: the photograph in the middle of all, or the whole model. */
    #start(middle: Vec3, size: number): State {
        const common = {
            left: this.water === null ? ('clear' as const) : ('water' as const),
            right: 'none' as const,
            split: 0.5,
            amount: 1,
            control: 'orbit' as const,
            showsCameras: false,
            photograph: null,
        };
        if (this.cameras.length === 0) {
            return { ...common, ...this.#overviewOf(middle, size) };
        }
        const total = this.cameras.reduce<Vec3>((sum, camera) => add(sum, camera.position), [0, 0, 0]);
        const mean = scale(total, 1 / this.cameras.length);
        const from = (camera: CameraEntry): number => length(sub(camera.position, mean));
        const first = this.cameras.reduce((a, b) => (from(b) < from(a) ? b : a));
        const pose = poseOf(first);
        const ahead = dot(sub(middle, pose.position), axesOf(pose.rotation).forward);
        const distance = this.scene.plan?.extent?.viewing_distance ?? (ahead > 0 ? ahead : size);
        return { ...common, place: { pose, distance }, lens: freeLensLike(pinholeOf(first)) };
    }

    #screenCamera(): Pinhole {
        const { width, height } = this.area();
        return project(this.state.lens, Math.max(1, width), Math.max(1, height));
    }

    #rightMode(): Mode {
        const { left, right } = this.state;
        return right === 'none' || right === 'photograph' ? left : right;
    }

    /** Where the renderer changes to the right side: a photograph lies over the picture instead. */
    #split(): number {
        const { right, split } = this.state;
        return right === 'none' || right === 'photograph' ? 1 : split;
    }

    #frameOf(pose: Pose, camera: Pinhole): Frame {
        return {
            pose,
            camera,
            left: this.state.left,
            right: this.#rightMode(),
            split: this.#split(),
            amount: this.state.amount,
            rangeScale: this.rangeScale,
            background: this.#background,
        };
    }

    async #sortFor(pose: Pose, camera: Pinhole): Promise<boolean> {
        const sorted = await this.#sorter.order(this.#renderer.poseForSorting(pose), camera);
        if (sorted === null) {
            return false;
        }
        this.#renderer.setOrder(sorted);
        this.#sorter.giveBack(sorted.order);
        this.#sorted = pose;
        const [near, far] = sorted.ranges;
        this.rangeScale = [near, Math.max(far, near * 1.01)];
        return true;
    }

    #frame(now: number): void {
        this.#frameAsked = 0;
        const seconds = Math.min(0.1, (now - this.#lastFrame) / 1000);
        this.#lastFrame = now;
        if (this.#input.isHeld) {
            this.#input.advance(seconds);
            this.redraw();
        }
        const { pose } = this.state.place;
        if (this.#sorted !== pose && this.#sorting === null && !this.#isBusy) {
            this.#sorting = pose;
            void this.#sortFor(pose, this.#screenCamera()).then(() => {
                this.#sorting = null;
                this.redraw();
            });
        }
        if (this.#isBusy) {
            return;
        }
        const moves = performance.now() - this.#lastMovement < REST;
        if (moves) {
            this.#frameTimes.push(seconds * 1000);
            this.#frameTimes = this.#frameTimes.slice(-5);
            const mean = this.#frameTimes.reduce((sum, time) => sum + time, 0) / this.#frameTimes.length;
            if (this.#frameTimes.length >= 5) {
                // Far below the limit even full frames are fast enough.
                this.#slow = mean > SLOW_FRAME || (this.#slow && mean > SLOW_FRAME / 3);
            }
            this.redraw();
        } else {
            this.#frameTimes = [];
        }
        this.#draw(moves && this.#slow ? 0.5 : 1);
        if (this.#sorted === pose && !moves) {
            const waiting = this.#settled;
            this.#settled = [];
            // The browser shows what was drawn with its next frame.
            requestAnimationFrame(() => waiting.forEach((done) => done()));
        }
        this.onFrame();
    }

    #draw(quality = 1): void {
        const { clientWidth, clientHeight } = this.canvas;
        const density = Math.min(MOST_DENSITY, window.devicePixelRatio) * quality;
        const most = this.#renderer.largestSide;
        const width = Math.min(most, Math.max(1, Math.round(clientWidth * density)));
        const height = Math.min(most, Math.max(1, Math.round(clientHeight * density)));
        if (this.canvas.width !== width || this.canvas.height !== height) {
            this.canvas.width = width;
            this.canvas.height = height;
        }
        const area = pictureArea(this.state.lens, width, height);
        const camera = project(this.state.lens, area.width, area.height);
        const fromBelow = { ...area, y: height - area.y - area.height };
        this.#renderer.draw(this.#frameOf(this.state.place.pose, camera), fromBelow);
    }

    /** A click on the mark of a camera goes there. */
    #clickCamera(x: number, y: number): void {
        if (!this.state.showsCameras) {
            return;
        }
        const toScreen = this.toScreen();
        let best: { name: string; apart: number } | null = null;
        for (const camera of this.cameras) {
            const at = toScreen(camera.position);
            const apart = at === null ? Infinity : Math.hypot(at.x - x, at.y - y);
            if (apart < 14 && apart < (best?.apart ?? Infinity)) {
                best = { name: camera.img_name, apart };
            }
        }
        if (best !== null) {
            this.goToPhotograph(best.name);
        }
    }

    /** Chooses the point that an orbit turns about: what is seen at this place of the canvas. */
    async #pickPivot(x: number, y: number): Promise<void> {
        const area = this.area();
        const camera = this.#screenCamera();
        const density = this.canvas.width / Math.max(1, this.canvas.clientWidth);
        const [px, py] = [x - area.x, y - area.y];
        const range = await this.#renderer.rangeAt(
            Math.floor(px * density),
            Math.floor((area.height - py) * density),
        );
        if (range === null) {
            return;
        }
        const ray = unit([(px - camera.cx) / camera.fx, (py - camera.cy) / camera.fy, 1]);
        const { pose } = this.state.place;
        const pivot = add(pose.position, scale(rotate(pose.rotation, ray), range));
        const distance = length(sub(pivot, pose.position));
        this.go({ pose: lookingAt(pose.position, pivot, this.up), distance });
    }

    /** Length that marks in the scene are in proportion to, scene units. */
    get markScale(): number {
        return this.#home.place.distance;
    }
}
