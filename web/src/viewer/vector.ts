// Small vectors, quaternions and 3 x 3 matrices. Plain arrays, so that they pass through JSON unchanged.

export type Vec3 = readonly [number, number, number];
/** Order x y z w. */
export type Quat = readonly [number, number, number, number];
/** Three rows. */
export type Mat3 = readonly [Vec3, Vec3, Vec3];

export const add = (a: Vec3, b: Vec3): Vec3 => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a: Vec3, b: Vec3): Vec3 => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a: Vec3, s: number): Vec3 => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a: Vec3, b: Vec3): number => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a: Vec3): number => Math.hypot(a[0], a[1], a[2]);
export const cross = (a: Vec3, b: Vec3): Vec3 => [
    a[1] * b[2] - a[2] * b[1],
    a[2] * b[0] - a[0] * b[2],
    a[0] * b[1] - a[1] * b[0],
];

/** The vector at length 1, or `otherwise` if it has no direction. */
export function unit(a: Vec3, otherwise: Vec3 = [0, 0, 1]): Vec3 {
    const size = length(a);
    return size > 1e-12 && Number.isFinite(size) ? scale(a, 1 / size) : otherwise;
}

export const mulMat = (m: Mat3, v: Vec3): Vec3 => [dot(m[0], v), dot(m[1], v), dot(m[2], v)];

export const transpose = (m: Mat3): Mat3 => [
    [m[0][0], m[1][0], m[2][0]],
    [m[0][1], m[1][1], m[2][1]],
    [m[0][2], m[1][2], m[2][2]],
];

export const quatOfAxis = (axis: Vec3, angle: number): Quat => {
    const [x, y, z] = scale(axis, Math.sin(angle / 2));
    return [x, y, z, Math.cos(angle / 2)];
};

/** First `b`, then `a`. */
export const quatMul = (a: Quat, b: Quat): Quat => [
    a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
    a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
    a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
    a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
];

export const quatInverse = (q: Quat): Quat => [-q[0], -q[1], -q[2], q[3]];

export function quatUnit(q: Quat): Quat {
    const size = Math.hypot(...q);
    return [q[0] / size, q[1] / size, q[2] / size, q[3] / size];
}

export function matOfQuat(q: Quat): Mat3 {
    const [x, y, z, w] = q;
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ];
}

export const rotate = (q: Quat, v: Vec3): Vec3 => mulMat(matOfQuat(q), v);

/** The quaternion of a rotation matrix (Shepperd 1978: the largest component first, for accuracy). */
export function quatOfMat(m: Mat3): Quat {
    const trace = m[0][0] + m[1][1] + m[2][2];
    if (trace > 0) {
        const s = Math.sqrt(trace + 1) * 2;
        return quatUnit([(m[2][1] - m[1][2]) / s, (m[0][2] - m[2][0]) / s, (m[1][0] - m[0][1]) / s, s / 4]);
    }
    if (m[0][0] > m[1][1] && m[0][0] > m[2][2]) {
        const s = Math.sqrt(1 + m[0][0] - m[1][1] - m[2][2]) * 2;
        return quatUnit([s / 4, (m[0][1] + m[1][0]) / s, (m[0][2] + m[2][0]) / s, (m[2][1] - m[1][2]) / s]);
    }
    if (m[1][1] > m[2][2]) {
        const s = Math.sqrt(1 + m[1][1] - m[0][0] - m[2][2]) * 2;
        return quatUnit([(m[0][1] + m[1][0]) / s, s / 4, (m[1][2] + m[2][1]) / s, (m[0][2] - m[2][0]) / s]);
    }
    const s = Math.sqrt(1 + m[2][2] - m[0][0] - m[1][1]) * 2;
    return quatUnit([(m[0][2] + m[2][0]) / s, (m[1][2] + m[2][1]) / s, s / 4, (m[1][0] - m[0][1]) / s]);
}
