// Sorts Gaussians by depth, away from the thread that draws.
//
// The order is exact: two stable counting passes over the 32 bits of each depth. The sorters of the engine put
// depths into as few as 1024 classes, which shows as flicker between neighbours and as a wrong picture.

/** Gaussians nearer than this are not drawn, as in the trainer. Scene units. */
const NEAR = 0.01;
/** Gaussians that are looked at for the scale of the range colours. */
const SAMPLES = 20_000;

type Row = readonly [number, number, number, number];

export type ToWorker =
    | { readonly kind: 'centres'; readonly centres: Float32Array }
    | {
          readonly kind: 'sort';
          readonly number: number;
          /** Rows of world to camera, x y z and translation; the last gives the depth. */
          readonly rows: readonly [Row, Row, Row];
          /** Bounds of x/z and y/z of what is in the picture: minimum, maximum. */
          readonly ratios: readonly [number, number, number, number];
          /** An array to fill, if the caller has one to spare. */
          readonly order: Uint32Array | null;
      };

export interface FromWorker {
    readonly number: number;
    /** Indices of Gaussians, the farthest first; only the first `count` are set. */
    readonly order: Uint32Array;
    readonly count: number;
    /** 2nd and 98th percentile of the ranges of Gaussians in the picture. */
    readonly ranges: readonly [number, number];
    readonly milliseconds: number;
}

let centres = new Float32Array(0);
let keys = new Uint32Array(0);
let other = new Uint32Array(0);

/** Fills `order` with the Gaussians in front of the camera, the farthest first. Exported for the tests. */
export function sortByDepth(
    positions: Float32Array,
    [a, b, c, d]: Row,
    keyOf: Uint32Array,
    spare: Uint32Array,
    order: Uint32Array,
): number {
    const depths = new Float32Array(keyOf.buffer, keyOf.byteOffset, keyOf.length);
    const total = positions.length / 3;
    let count = 0;
    for (let i = 0; i < total; i++) {
        const z = a * positions[3 * i]! + b * positions[3 * i + 1]! + c * positions[3 * i + 2]! + d;
        depths[i] = z;
        // Positive, so that NaN fails.
        if (z > NEAR) {
            order[count++] = i;
        }
    }
    // Bits of positive floats are ordered like the floats. Descending, so that the farthest comes first.
    const starts = new Uint32Array(65_536);
    let from = order;
    let to = spare;
    for (const shift of [0, 16]) {
        starts.fill(0);
        for (let i = 0; i < count; i++) {
            starts[(keyOf[from[i]!]! >>> shift) & 0xffff]!++;
        }
        let sum = 0;
        for (let digit = 65_535; digit >= 0; digit--) {
            const size = starts[digit]!;
            starts[digit] = sum;
            sum += size;
        }
        for (let i = 0; i < count; i++) {
            const id = from[i]!;
            to[starts[(keyOf[id]! >>> shift) & 0xffff]!++] = id;
        }
        [from, to] = [to, from];
    }
    return count;
}

function rangesInPicture(
    { rows, ratios }: Extract<ToWorker, { kind: 'sort' }>,
    order: Uint32Array,
    count: number,
): [number, number] {
    const found: number[] = [];
    const [minX, minY, maxX, maxY] = ratios;
    for (let i = 0; i < count; i += Math.max(1, Math.floor(count / SAMPLES))) {
        const at = 3 * order[i]!;
        const along = ([a, b, c, d]: Row): number => a * centres[at]! + b * centres[at + 1]! + c * centres[at + 2]! + d;
        const [x, y, z] = [along(rows[0]), along(rows[1]), along(rows[2])];
        if (x > minX * z && x < maxX * z && y > minY * z && y < maxY * z) {
            found.push(Math.hypot(x, y, z));
        }
    }
    found.sort((a, b) => a - b);
    const end = (share: number): number => found[Math.floor(share * (found.length - 1))] ?? 1;
    return [end(0.02), end(0.98)];
}

function answer(message: Extract<ToWorker, { kind: 'sort' }>): FromWorker {
    const started = performance.now();
    const total = centres.length / 3;
    if (keys.length !== total) {
        keys = new Uint32Array(total);
        other = new Uint32Array(total);
    }
    const order = message.order?.length === total ? message.order : new Uint32Array(total);
    const count = sortByDepth(centres, message.rows[2], keys, other, order);
    const ranges = rangesInPicture(message, order, count);
    return { number: message.number, order, count, ranges, milliseconds: performance.now() - started };
}

// In tests the module is loaded outside a worker.
if (typeof self !== 'undefined' && typeof document === 'undefined') {
    self.addEventListener('message', (event: MessageEvent<ToWorker>) => {
        const message = event.data;
        if (message.kind === 'centres') {
            centres = new Float32Array(message.centres);
            return;
        }
        const result = answer(message);
        self.postMessage(result, { transfer: [result.order.buffer] });
    });
}
