// How the camera moves. Pure functions from one pose to the next.
//
// Orbit turns about a point in front of the camera. Fly moves along the axes of the camera. Walk moves on the
// horizontal plane, at the same height.

import type { Pose } from './camera.ts';
import {
    type Quat,
    type Vec3,
    add,
    cross,
    dot,
    matOfQuat,
    quatMul,
    quatOfAxis,
    quatOfMat,
    quatUnit,
    scale,
    sub,
    transpose,
    unit,
} from './vector.ts';

export type Control = 'orbit' | 'fly' | 'walk';

/** A camera and the distance of the point that it turns about. */
export interface Place {
    readonly pose: Pose;
    readonly distance: number;
}

/** Closest angle between the viewing direction and the vertical, radians. */
const LEAST_ANGLE = 0.02;

interface Axes {
    readonly right: Vec3;
    readonly down: Vec3;
    readonly forward: Vec3;
}

export function axesOf(rotation: Quat): Axes {
    const [right, down, forward] = transpose(matOfQuat(rotation));
    return { right, down, forward };
}

/** The point that an orbit turns about. */
export const pivotOf = ({ pose, distance }: Place): Vec3 =>
    add(pose.position, scale(axesOf(pose.rotation).forward, distance));

/** A camera at `eye` that looks at `target`, with the picture upright. */
export function lookingAt(eye: Vec3, target: Vec3, up: Vec3): Pose {
    const forward = unit(sub(target, eye));
    const across = cross(forward, up);
    // Straight up or down any direction is upright.
    const other: Vec3 = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 0, 1];
    const right = unit(across, unit(cross(forward, other)));
    const down = cross(forward, right);
    return { position: eye, rotation: quatOfMat(transpose([right, down, forward])) };
}

/** Turns by angles in radians: `yaw` to the left about the vertical, `pitch` upwards. */
export function turned(place: Place, control: Control, up: Vec3, yaw: number, pitch: number): Place {
    const before = axesOf(place.pose.rotation);
    const angle = Math.acos(Math.min(1, Math.max(-1, dot(before.forward, up))));
    const tilt = Math.min(angle - LEAST_ANGLE, Math.max(angle - Math.PI + LEAST_ANGLE, pitch));
    let rotation = quatMul(quatOfAxis(up, yaw), quatMul(place.pose.rotation, quatOfAxis([1, 0, 0], tilt)));
    // Photographs may be rolled. The roll is taken out little by little, so that nothing jumps.
    const { right, down } = axesOf(rotation);
    const [x, y] = [dot(right, up), -dot(down, up)];
    if (Math.hypot(x, y) > 0.2) {
        const share = Math.min(1, 2 * (Math.abs(yaw) + Math.abs(tilt)));
        rotation = quatMul(rotation, quatOfAxis([0, 0, 1], share * Math.atan2(x, y)));
    }
    rotation = quatUnit(rotation);
    const pivot = pivotOf(place);
    const position =
        control === 'orbit' ? sub(pivot, scale(axesOf(rotation).forward, place.distance)) : place.pose.position;
    return { pose: { position, rotation }, distance: place.distance };
}

/** Moves by scene units to the right, upwards and forwards. */
export function moved(place: Place, control: Control, up: Vec3, [right, rise, forward]: Vec3): Place {
    const axes = axesOf(place.pose.rotation);
    let ahead = axes.forward;
    let above = scale(axes.down, -1);
    if (control === 'walk') {
        const flat = (v: Vec3): Vec3 => sub(v, scale(up, dot(v, up)));
        // A camera that looks straight down walks towards the top of its picture.
        ahead = unit(flat(axes.forward), unit(flat(above)));
        above = up;
    }
    const step = add(add(scale(axes.right, right), scale(above, rise)), scale(ahead, forward));
    return { ...place, pose: { ...place.pose, position: add(place.pose.position, step) } };
}

/** Comes nearer (`factor` below 1) or goes away. */
export function zoomed(place: Place, control: Control, factor: number): Place {
    const { forward } = axesOf(place.pose.rotation);
    const step = place.distance * (1 - factor);
    const position = add(place.pose.position, scale(forward, step));
    return {
        pose: { ...place.pose, position },
        distance: control === 'orbit' ? place.distance * factor : place.distance,
    };
}
