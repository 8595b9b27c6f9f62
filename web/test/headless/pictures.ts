// Pictures in tests: PNG files, and how far two pictures are apart.

import { readFileSync } from 'node:fs';
import { PNG } from 'pngjs';

/** RGBA, rows from the top. */
export interface Picture {
    readonly width: number;
    readonly height: number;
    readonly data: Uint8Array;
}

export const readPng = (path: string): Picture => PNG.sync.read(readFileSync(path));
export const decodePng = (bytes: Buffer): Picture => PNG.sync.read(bytes);

/** PSNR over red, green and blue, dB; infinite for equal pictures. */
export function psnr(a: Picture, b: Picture): number {
    if (a.width !== b.width || a.height !== b.height) {
        throw new Error(`sizes differ: ${a.width}x${a.height} and ${b.width}x${b.height}`);
    }
    let sum = 0;
    for (let i = 0; i < a.data.length; i++) {
        sum += i % 4 === 3 ? 0 : (a.data[i]! - b.data[i]!) ** 2;
    }
    return 10 * Math.log10(255 ** 2 / (sum / (a.width * a.height * 3)));
}

/** A rectangle of a picture. */
export function cropped(picture: Picture, x: number, y: number, width: number, height: number): Picture {
    const data = new Uint8Array(width * height * 4);
    for (let row = 0; row < height; row++) {
        const from = ((y + row) * picture.width + x) * 4;
        data.set(picture.data.subarray(from, from + width * 4), row * width * 4);
    }
    return { width, height, data };
}
