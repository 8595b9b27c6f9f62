// Draws the map of a plan on a canvas. A canvas and not SVG, because a plan may have thousands of cells and
// tens of thousands of cameras.

import { decibels, percent } from './format.ts';
import { type ShownState, shownPsnr } from './part.ts';
import {
    type CellState,
    type MapCamera,
    type PlanContent,
    type PlanPartition,
    type Projection,
    isCrowded,
    quietPlace,
} from './plan-layout.ts';
import { drawScale, scaleOf } from './plan-scale.ts';
import { type Shade, type Shading, inkOn, mixed } from './plan-shades.ts';

export interface MapPicture {
    readonly plan: PlanContent;
    readonly cameras: readonly MapCamera[];
    readonly states: ReadonlyMap<number, CellState>;
    /** How cells are shaded; null by their states. */
    readonly shading: Shading | null;
    /** Cells whose extended boxes are drawn: the selected one and the one under the pointer. */
    readonly marked: readonly PlanPartition[];
    readonly camera: MapCamera | null;
    /** Area of the map for each camera, which sets how large they are drawn. */
    readonly pixelsPerCamera: number;
}

type Context = CanvasRenderingContext2D;
type Rect = readonly [number, number, number, number];

/** Least width and height of a cell, pixels, for each amount of text. */
const ROOM_FOR_ALL = [160, 96] as const;
const ROOM_FOR_STATE = [62, 40] as const;
const ROOM_FOR_NUMBER = [24, 16] as const;
const ROOM_FOR_SIGN = 7;
/** Least height for a line at the level of the progress. */
const ROOM_FOR_LEVEL = 24;
/** Where cameras have less of the map each, pixels, they would hide the cells. */
const LEAST_PIXELS = 16;

export function drawMap(
    context: Context,
    width: number,
    height: number,
    projection: Projection,
    picture: MapPicture,
    colour: (name: string) => string,
): void {
    context.fillStyle = colour('--panel');
    context.fillRect(0, 0, width, height);
    for (const partition of picture.plan.partitions) {
        const rect = projection.rect(partition.cell);
        if (rect[2] > 0 && rect[0] < width && rect[3] > 0 && rect[1] < height) {
            drawCell(context, clip(rect, width, height), rect, partition, picture, colour);
        }
    }
    drawFailures(context, projection, picture, colour);
    drawCameras(context, width, height, projection, picture, colour);
    // What words should not hide: cameras, and the scale, which is given as points of its own.
    const { box } = scaleOf(context, width, projection);
    const shares = [0, 0.2, 0.4, 0.6, 0.8, 1];
    const places = shares.flatMap((share) =>
        [height - 46, height - 27, height - 8].map((y) => [8 + share * box, y] as const),
    );
    if (!isCrowded(picture.pixelsPerCamera)) {
        picture.cameras.forEach(({ x, z }) => places.push([projection.x(x), projection.y(z)]));
    }
    // Words come last, so that no camera hides them.
    for (const partition of picture.plan.partitions) {
        const rect = projection.rect(partition.cell);
        if (rect[2] > 0 && rect[0] < width && rect[3] > 0 && rect[1] < height) {
            drawWords(context, clip(rect, width, height), partition, picture, places, colour);
        }
    }
    picture.marked.forEach((partition) => drawBox(context, projection, partition, colour));
    if (picture.camera !== null) {
        drawChosenCamera(context, projection, picture.camera, colour);
    }
    drawScale(context, width, height, projection, colour);
}

const clip = ([left, top, right, bottom]: Rect, width: number, height: number): Rect => [
    Math.max(0, left),
    Math.max(0, top),
    Math.min(width, right),
    Math.min(height, bottom),
];

function drawCell(
    context: Context,
    [left, top, right, bottom]: Rect,
    whole: Rect,
    partition: PlanPartition,
    picture: MapPicture,
    colour: (name: string) => string,
): void {
    const { state, share } = picture.states.get(partition.id)!;
    const [w, h] = [right - left, bottom - top];
    if (picture.shading !== null) {
        fillShade(context, [left, top, right, bottom], picture.shading.of(partition).shade, colour);
    } else {
        context.fillStyle = colour(`--${state === 'running' ? 'waiting' : state}-fill`);
        context.fillRect(left, top, w, h);
        if (state === 'running') {
            // The done share of the whole cell, from below.
            const level = whole[3] - share * (whole[3] - whole[1]);
            context.fillStyle = colour('--running-fill');
            context.fillRect(left, Math.max(top, level), w, Math.max(0, bottom - Math.max(top, level)));
            context.fillStyle = colour('--running');
            if (level > top && level < bottom && h >= ROOM_FOR_LEVEL) {
                context.fillRect(left, level - 1, w, 2);
            }
        } else if (state === 'cancelled') {
            hatch(context, [left, top, right, bottom], colour('--line'));
        }
    }
    context.strokeStyle = colour('--soft');
    context.globalAlpha = w < ROOM_FOR_STATE[0] ? 0.25 : 0.55;
    context.lineWidth = 1;
    context.strokeRect(whole[0] + 0.5, whole[1] + 0.5, whole[2] - whole[0], whole[3] - whole[1]);
    context.globalAlpha = 1;
}

/** The colour of a shade on the ground of the map, as #rrggbb. */
const fillOf = ({ fill, share }: Shade, colour: (name: string) => string): string =>
    mixed(colour('--panel'), fill.startsWith('--') ? colour(fill) : fill, share);

function fillShade(context: Context, rect: Rect, shade: Shade, colour: (name: string) => string): void {
    const [left, top, right, bottom] = rect;
    context.fillStyle = fillOf(shade, colour);
    context.fillRect(left, top, right - left, bottom - top);
    if (shade.pattern !== 'plain') {
        // Lines of the ink would hide words that have the same ink.
        context.globalAlpha = shade.stroke === '--ink' ? 0.45 : 1;
        hatch(context, rect, colour(shade.stroke));
        if (shade.pattern === 'crossed') {
            hatch(context, rect, colour(shade.stroke), true);
        }
        context.globalAlpha = 1;
    }
}

/** Outlines of failed cells, inside of them, so that neighbours do not cover them. */
function drawFailures(
    context: Context,
    projection: Projection,
    picture: MapPicture,
    colour: (name: string) => string,
): void {
    if (picture.shading !== null) {
        return;
    }
    context.strokeStyle = colour('--failed');
    context.lineWidth = 2;
    for (const partition of picture.plan.partitions) {
        if (picture.states.get(partition.id)!.state === 'failed') {
            const [left, top, right, bottom] = projection.rect(partition.cell);
            context.strokeRect(left + 1.5, top + 1.5, right - left - 2, bottom - top - 2);
        }
    }
}

function hatch(context: Context, [left, top, right, bottom]: Rect, stroke: string, isMirrored = false): void {
    const step = Math.min(8, Math.max(3, (right - left) / 4));
    context.save();
    context.beginPath();
    context.rect(left, top, right - left, bottom - top);
    context.clip();
    context.beginPath();
    // Through multiples of the step, so that the lines of neighbours meet.
    const [start, end] = isMirrored ? [left - bottom, right - top] : [left + top, right + bottom];
    const lean = isMirrored ? -1 : 1;
    for (let at = Math.floor(start / step) * step; at < end; at += step) {
        context.moveTo(at - lean * top, top);
        context.lineTo(at - lean * bottom, bottom);
    }
    context.strokeStyle = stroke;
    context.lineWidth = 1;
    context.stroke();
    context.restore();
}

function drawWords(
    context: Context,
    [left, top, right, bottom]: Rect,
    partition: PlanPartition,
    picture: MapPicture,
    cameras: readonly (readonly [number, number])[],
    colour: (name: string) => string,
): void {
    const cell = picture.states.get(partition.id)!;
    const [w, h] = [right - left, bottom - top];
    const fits = ([least, high]: readonly [number, number]): boolean => w >= least && h >= high;
    const [x, y] = [(left + right) / 2, (top + bottom) / 2];
    if (picture.shading !== null) {
        const { shade, words, number } = picture.shading.of(partition);
        if (fits(ROOM_FOR_STATE)) {
            const lines = [`${partition.id}`, shorten(words, Math.floor(w / 8))];
            pill(context, lines, [left, top, right, bottom], cameras, colour('--ink'), colour);
        } else if (fits(ROOM_FOR_NUMBER)) {
            context.fillStyle = inkOn(fillOf(shade, colour));
            context.font = '11px system-ui, sans-serif';
            context.textAlign = 'center';
            context.textBaseline = 'middle';
            context.fillText(number, x, y + 0.5);
        }
        return;
    }
    const ink = colour(`--${cell.state}`);
    const word = cell.isFirstPart && cell.state === 'running' ? 'first part' : cell.state;
    if (fits(ROOM_FOR_ALL)) {
        const lines = [`${partition.id}`];
        // Before there is a job, a cell has no state.
        if (cell.task !== null) {
            lines.push(cell.state === 'running' ? `${word} ${percent(cell.share)}` : word);
        }
        const worker = cell.task?.worker ?? null;
        const psnr = shownPsnr(cell.task);
        if (worker !== null && cell.state !== 'waiting') {
            lines.push(worker);
        }
        if (psnr !== null) {
            lines.push(`${decibels(psnr.value)}${psnr.isOfPreviews ? ', previews' : ''}`);
        }
        const shown = lines.map((line) => shorten(line, Math.floor(w / 8)));
        pill(context, shown, [left, top, right, bottom], cameras, ink, colour);
    } else if (fits(ROOM_FOR_STATE)) {
        const ofState = cell.state === 'running' ? percent(cell.share) : word;
        const lines = cell.task === null ? [`${partition.id}`] : [`${partition.id}`, ofState];
        pill(context, lines, [left, top, right, bottom], cameras, ink, colour);
    } else if (fits(ROOM_FOR_NUMBER) && picture.plan.partitions.length <= 200) {
        drawSign(context, x + 7, y, 9, cell.state, ink);
        context.fillStyle = ink;
        context.font = '11px system-ui, sans-serif';
        context.textAlign = 'right';
        context.textBaseline = 'middle';
        context.fillText(String(partition.id), x, y + 0.5);
    } else if (Math.min(w, h) >= ROOM_FOR_SIGN) {
        drawSign(context, x, y, Math.min(12, Math.min(w, h) * 0.62), cell.state, ink);
    }
}

const shorten = (text: string, most: number): string =>
    text.length <= most ? text : `${text.slice(0, Math.max(1, most - 1))}…`;

const font = (line: number): string =>
    line === 0 ? '600 14px system-ui, sans-serif' : '11.5px system-ui, sans-serif';

/** Lines of text on a ground that keeps them legible; the first is the largest. */
function pill(
    context: Context,
    lines: readonly string[],
    cell: Rect,
    cameras: readonly (readonly [number, number])[],
    ink: string,
    colour: (name: string) => string,
): void {
    const heights = lines.map((_, i) => (i === 0 ? 17 : 14));
    const widths = lines.map((line, i) => {
        context.font = font(i);
        return context.measureText(line).width;
    });
    const [w, h] = [Math.max(...widths) + 12, heights.reduce((a, b) => a + b, 0) + 6];
    const [x, y] = quietPlace(cell, w / 2, h / 2, cameras);
    context.fillStyle = colour('--panel');
    context.globalAlpha = 0.86;
    context.beginPath();
    context.roundRect(x - w / 2, y - h / 2, w, h, 5);
    context.fill();
    context.globalAlpha = 1;
    context.textAlign = 'center';
    context.textBaseline = 'middle';
    let at = y - h / 2 + 3;
    lines.forEach((line, i) => {
        context.font = font(i);
        context.fillStyle = i === 0 ? colour('--ink') : ink;
        context.fillText(line, x, at + heights[i]! / 2 + 0.5);
        at += heights[i]!;
    });
}

/** The sign of a state, drawn, so that it stays sharp in small cells. */
function drawSign(context: Context, x: number, y: number, size: number, state: ShownState, ink: string): void {
    const r = size / 2;
    context.strokeStyle = ink;
    context.fillStyle = ink;
    context.lineWidth = Math.max(1.2, size / 6);
    context.beginPath();
    if (state === 'done') {
        context.moveTo(x - r, y);
        context.lineTo(x - r * 0.3, y + r * 0.7);
        context.lineTo(x + r, y - r * 0.7);
    } else if (state === 'failed') {
        context.moveTo(x - r * 0.8, y - r * 0.8);
        context.lineTo(x + r * 0.8, y + r * 0.8);
        context.moveTo(x + r * 0.8, y - r * 0.8);
        context.lineTo(x - r * 0.8, y + r * 0.8);
    } else if (state === 'cancelled') {
        context.moveTo(x - r * 0.8, y);
        context.lineTo(x + r * 0.8, y);
    } else if (state === 'running') {
        context.moveTo(x - r * 0.6, y - r * 0.8);
        context.lineTo(x + r * 0.8, y);
        context.lineTo(x - r * 0.6, y + r * 0.8);
        context.fill();
        return;
    } else {
        context.arc(x, y, Math.max(0.8, size / 8), 0, 2 * Math.PI);
        context.fill();
        return;
    }
    context.stroke();
}

function drawCameras(
    context: Context,
    width: number,
    height: number,
    projection: Projection,
    picture: MapPicture,
    colour: (name: string) => string,
): void {
    const radius = Math.min(5, Math.max(1, 0.12 * Math.sqrt(picture.pixelsPerCamera)));
    // In a crowd cameras are faint and without directions, but for those of a marked cell.
    const crowded = isCrowded(picture.pixelsPerCamera);
    const first = picture.marked[0] ?? null;
    const isHopeless = picture.pixelsPerCamera < LEAST_PIXELS;
    const chosen = first === null ? null : new Set(first.chosen_views);
    const groups = new Map<string, MapCamera[]>();
    for (const camera of picture.cameras) {
        const group = camera.isHeldOut ? 'heldOut' : chosen === null || chosen.has(camera.index) ? 'strong' : 'faint';
        groups.set(group, push(groups.get(group), camera));
    }
    for (const [group, cameras] of groups) {
        const isStrong = group === 'strong' && chosen !== null;
        const isFaint = group === 'faint' || (crowded && !isStrong);
        context.globalAlpha = isFaint ? 0.22 : 0.9;
        if (isFaint && isHopeless) {
            continue;
        }
        const ink = colour(isStrong ? '--accent' : '--ink');
        const r = isFaint && crowded ? 0.8 : isStrong ? Math.max(radius, 1.8) : radius;
        const places = cameras
            .map((camera) => ({ camera, x: projection.x(camera.x), y: projection.y(camera.z) }))
            .filter(({ x, y }) => x > -20 && y > -20 && x < width + 20 && y < height + 20);
        context.strokeStyle = ink;
        context.lineWidth = Math.max(0.75, r * 0.45);
        const drawDirections = (): void => {
            context.beginPath();
            for (const { camera, x, y } of places) {
                context.moveTo(x, y);
                context.lineTo(x + camera.dx * 4 * r, y - camera.dz * 4 * r);
            }
            context.stroke();
        };
        const drawDots = (size: number): void => {
            context.beginPath();
            for (const { x, y } of places) {
                context.moveTo(x + size, y);
                context.arc(x, y, size, 0, 2 * Math.PI);
            }
        };
        const hasDirections = !(crowded && isFaint);
        if (picture.shading !== null && !isFaint) {
            // A rim, since shades may be as dark or as light as the ink.
            const { lineWidth } = context;
            [context.strokeStyle, context.fillStyle] = [colour('--panel'), colour('--panel')];
            context.lineWidth = lineWidth + 2;
            drawDirections();
            drawDots(r + 1);
            context.fill();
            [context.strokeStyle, context.lineWidth] = [ink, lineWidth];
        }
        if (hasDirections) {
            drawDirections();
        }
        drawDots(r);
        const isRing = group === 'heldOut' && !crowded;
        context.fillStyle = isRing ? colour('--panel') : ink;
        context.fill();
        if (isRing) {
            context.stroke();
        }
    }
    context.globalAlpha = 1;
}

function push<T>(list: T[] | undefined, item: T): T[] {
    if (list === undefined) {
        return [item];
    }
    list.push(item);
    return list;
}

function drawBox(
    context: Context,
    projection: Projection,
    partition: PlanPartition,
    colour: (name: string) => string,
): void {
    const { min, max } = partition.extended_box;
    const rect = projection.rect(partition.cell);
    context.strokeStyle = colour('--accent');
    context.lineWidth = 2.5;
    context.strokeRect(rect[0], rect[1], rect[2] - rect[0], rect[3] - rect[1]);
    const [left, top] = [projection.x(min[0]), projection.y(max[2])];
    context.setLineDash([7, 5]);
    context.lineWidth = 1.5;
    context.strokeRect(left, top, projection.x(max[0]) - left, projection.y(min[2]) - top);
    context.setLineDash([]);
}

function drawChosenCamera(
    context: Context,
    projection: Projection,
    camera: MapCamera,
    colour: (name: string) => string,
): void {
    const [x, y] = [projection.x(camera.x), projection.y(camera.z)];
    context.lineWidth = 2.5;
    context.strokeStyle = colour('--warn');
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + camera.dx * 26, y - camera.dz * 26);
    context.moveTo(x + 7, y);
    context.arc(x, y, 7, 0, 2 * Math.PI);
    context.stroke();
}
