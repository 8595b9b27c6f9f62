// The header of a PLY: what the engine does not tell, such as the water in a comment.

import { ViewerError } from './errors.ts';
import { type Quat, quatUnit } from './vector.ts';
import { type WaterRecord, checkWater } from './water.ts';

export interface PlyHeader {
    readonly comments: readonly string[];
    /** Elements in the order of the file. */
    readonly elements: readonly {
        readonly name: string;
        readonly count: number;
        readonly rowBytes: number;
        readonly properties: readonly string[];
    }[];
    /** Bytes up to the first row. */
    readonly bytes: number;
}

const SIZES: Readonly<Record<string, number>> = {
    char: 1, int8: 1, uchar: 1, uint8: 1, short: 2, int16: 2, ushort: 2, uint16: 2,
    int: 4, int32: 4, uint: 4, uint32: 4, float: 4, float32: 4, double: 8, float64: 8,
};
/** A header that is longer than this is no header. */
const MOST_HEADER_BYTES = 1 << 20;
const REMEDY = 'Download the model again. If another program wrote it, export it as a binary PLY of 3D Gaussians.';

/** Whether the first bytes are those of a PLY. */
export const isPly = (bytes: Uint8Array): boolean => new TextDecoder().decode(bytes.subarray(0, 4)).startsWith('ply');

/** Reads the header and checks that all rows are there. `name` is used in messages. */
export function readHeader(bytes: Uint8Array, name: string): PlyHeader {
    const text = new TextDecoder('latin1').decode(bytes.subarray(0, MOST_HEADER_BYTES));
    const end = /\nend_header\r?\n/.exec(text);
    if (end === null) {
        throw new ViewerError(`${name} is damaged: its header has no end.`, REMEDY);
    }
    // Comments may hold names of other languages, so they are decoded as UTF-8.
    const header = new TextDecoder().decode(bytes.subarray(0, end.index));
    const comments: string[] = [];
    const elements: { name: string; count: number; rowBytes: number; properties: string[] }[] = [];
    for (const line of header.split(/\r?\n/)) {
        const words = line.split(' ');
        if (words[0] === 'comment') {
            comments.push(line.slice('comment '.length));
        } else if (words[0] === 'format' && words[1] !== 'binary_little_endian') {
            throw new ViewerError(`${name} has the format ${words[1]}; only binary_little_endian is read.`, REMEDY);
        } else if (words[0] === 'element') {
            elements.push({ name: words[1] ?? '', count: Number(words[2]), rowBytes: 0, properties: [] });
        } else if (words[0] === 'property') {
            const element = elements.at(-1);
            const size = SIZES[words[1] ?? ''];
            if (element === undefined || size === undefined) {
                throw new ViewerError(`${name} cannot be read: its header has the line "${line}".`, REMEDY);
            }
            element.rowBytes += size;
            element.properties.push(words[2] ?? '');
        }
    }
    const bytesOfHeader = end.index + end[0].length;
    const vertex = elements.find((element) => element.name === 'vertex');
    if (vertex === undefined || !(vertex.count > 0)) {
        throw new ViewerError(`${name} holds no Gaussians.`, REMEDY);
    }
    const has = (property: string): boolean => vertex.properties.includes(property);
    if (!has('packed_position') && !['x', 'opacity', 'scale_0', 'rot_0', 'f_dc_0'].every(has)) {
        throw new ViewerError(
            `${name} is a PLY without Gaussians: ${vertex.properties.slice(0, 6).join(', ')}, ...`,
            'Choose the file that a 3D Gaussian trainer wrote, with the properties opacity, scale_0, rot_0 and f_dc_0.',
        );
    }
    const expected = elements.reduce((sum, element) => sum + element.count * element.rowBytes, bytesOfHeader);
    if (bytes.length < expected) {
        throw new ViewerError(
            `${name} is incomplete: it has ${bytes.length} bytes, and its header states ${expected}.`,
            'Download the model again.',
        );
    }
    return { comments, elements, bytes: bytesOfHeader };
}

const after = (comments: readonly string[], start: string): string | undefined =>
    comments.find((comment) => comment.startsWith(start))?.slice(start.length);

/** The water among the comments of a header. */
export function waterAmong(comments: readonly string[]): WaterRecord | null {
    const json = after(comments, 'fathom_water ');
    if (json === undefined) {
        return null;
    }
    try {
        return checkWater(JSON.parse(json));
    } catch (error) {
        if (error instanceof ViewerError) {
            throw error;
        }
        throw new ViewerError('The water in the header of the model is not JSON.', REMEDY, error);
    }
}

/** Whether the model must be drawn with the 2D filter of Mip-Splatting. */
export const isAntialiased = (comments: readonly string[]): boolean =>
    comments.some((comment) => comment.startsWith('antialiased: ') || comment.startsWith('SplatRenderMode: mip'));

/** Whether the colours were exported in linear light, which the viewer would show too dark. */
export const isInLinearLight = (comments: readonly string[]): boolean =>
    comments.some((comment) => comment.startsWith('colours are in linear light'));

/** The rotation from the axes of the scene to those of the model, if they differ. */
export function frameAmong(comments: readonly string[]): Quat | null {
    const words = after(comments, 'fathom frame: scene_to_model_quat_wxyz ');
    const [w, x, y, z] = (words ?? '').split(' ').map(Number);
    const all = [x, y, z, w].every((value) => value !== undefined && Number.isFinite(value));
    return words !== undefined && all ? quatUnit([x!, y!, z!, w!]) : null;
}
