// The scale and the axes in the corner of the map of a plan.

import { brief, roundLength } from './format.ts';
import type { Projection } from './plan-layout.ts';

/** Where the scale is, in the lower left corner. */
export function scaleOf(
    context: CanvasRenderingContext2D,
    width: number,
    projection: Projection,
): { words: string; pixels: number; box: number } {
    const length = roundLength((width * 0.24) / projection.pixelsPerUnit);
    const pixels = length * projection.pixelsPerUnit;
    const number = length >= 0.001 ? String(Number(length.toPrecision(1))) : brief(length, 1);
    const words = `${number} scene ${length === 1 ? 'unit' : 'units'}`;
    context.font = '12px system-ui, sans-serif';
    return { words, pixels, box: Math.max(pixels, context.measureText(words).width) + 68 };
}

/** A bar of a round length and the axes. */
export function drawScale(
    context: CanvasRenderingContext2D,
    width: number,
    height: number,
    projection: Projection,
    colour: (name: string) => string,
): void {
    const { words, pixels, box } = scaleOf(context, width, projection);
    const [left, y] = [8, height - 14];
    context.globalAlpha = 0.88;
    context.fillStyle = colour('--panel');
    context.beginPath();
    context.roundRect(left, height - 46, box, 38, 5);
    context.fill();
    context.globalAlpha = 1;
    const ink = colour('--ink');
    context.strokeStyle = ink;
    context.fillStyle = ink;
    context.lineWidth = 1.5;
    context.beginPath();
    const [x0, start] = [left + 10, left + 54];
    context.moveTo(x0, y - 22);
    context.lineTo(x0, y);
    context.lineTo(x0 + 22, y);
    context.moveTo(start, y - 4);
    context.lineTo(start, y);
    context.lineTo(start + pixels, y);
    context.lineTo(start + pixels, y - 4);
    context.stroke();
    context.textAlign = 'left';
    context.textBaseline = 'alphabetic';
    context.fillText('z', x0 + 4, y - 16);
    context.fillText('x', x0 + 26, y + 3);
    context.fillText(words, start, y - 10);
}
