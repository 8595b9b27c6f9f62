// Cameras: where they stand and how they project.
//
// Camera axes are x right, y down, z forward. Pixels are counted from the top left corner, with centres at
// +0.5. These are the conventions of cameras.json and of `fathom render`.

import type { CameraEntry } from './scene.ts';
import { type Mat3, type Quat, type Vec3, add, matOfQuat, mulMat, quatOfMat, scale, transpose } from './vector.ts';

export interface Pose {
    /** Scene units. */
    readonly position: Vec3;
    /** From camera to world. */
    readonly rotation: Quat;
}

/** A pinhole camera for pictures of one size, pixels. */
export interface Pinhole {
    readonly width: number;
    readonly height: number;
    readonly fx: number;
    readonly fy: number;
    readonly cx: number;
    readonly cy: number;
}

/** The lens of the viewer: free, or exactly that of a photograph. */
export type Lens =
    | {
          readonly kind: 'free';
          /** Field of view along the shorter side, radians. */
          readonly fov: number;
      }
    | { readonly kind: 'exact'; readonly pinhole: Pinhole };

export interface View {
    readonly pose: Pose;
    readonly lens: Lens;
}

/** Rows of world to camera: rotation and translation. */
export function worldToCamera(pose: Pose): { rotation: Mat3; translation: Vec3 } {
    const rotation = transpose(matOfQuat(pose.rotation));
    return { rotation, translation: scale(mulMat(rotation, pose.position), -1) };
}

/** The same camera for a picture of another size. With centres at +0.5 this is a pure scale. */
export function resized(camera: Pinhole, width: number, height: number): Pinhole {
    const [sx, sy] = [width / camera.width, height / camera.height];
    return { width, height, fx: camera.fx * sx, fy: camera.fy * sy, cx: camera.cx * sx, cy: camera.cy * sy };
}

export function poseOf(entry: CameraEntry): Pose {
    return { position: entry.position, rotation: quatOfMat(entry.rotation) };
}

export function pinholeOf(entry: CameraEntry): Pinhole {
    const { width, height, fx, fy } = entry;
    // 3DGS does not store the principal point; it uses the middle.
    return { width, height, fx, fy, cx: entry.cx ?? width / 2, cy: entry.cy ?? height / 2 };
}

/** The camera for a picture of the given size. For an exact lens the aspect ratio should be that of the lens. */
export function project(lens: Lens, width: number, height: number): Pinhole {
    if (lens.kind === 'exact') {
        return resized(lens.pinhole, width, height);
    }
    const focal = Math.min(width, height) / 2 / Math.tan(lens.fov / 2);
    return { width, height, fx: focal, fy: focal, cx: width / 2, cy: height / 2 };
}

/** The largest rectangle for the lens inside the canvas, whole pixels from the top left. */
export function pictureArea(
    lens: Lens,
    width: number,
    height: number,
): { x: number; y: number; width: number; height: number } {
    if (lens.kind === 'free') {
        return { x: 0, y: 0, width, height };
    }
    const factor = Math.min(width / lens.pinhole.width, height / lens.pinhole.height);
    const w = Math.max(1, Math.round(lens.pinhole.width * factor));
    const h = Math.max(1, Math.round(lens.pinhole.height * factor));
    return { x: Math.floor((width - w) / 2), y: Math.floor((height - h) / 2), width: w, height: h };
}

/** A point in pixels of a camera, with its depth; null behind the camera. */
export type ToPixel = (point: Vec3) => { x: number; y: number; z: number } | null;

/** From points of the world to pixels of the camera. */
export function projectorOf(pose: Pose, camera: Pinhole): ToPixel {
    const { rotation, translation } = worldToCamera(pose);
    return (point) => {
        const [x, y, z] = add(mulMat(rotation, point), translation);
        return z > 1e-6 ? { x: camera.cx + (camera.fx * x) / z, y: camera.cy + (camera.fy * y) / z, z } : null;
    };
}

/** The free lens that shows about as much as a photograph. */
export function freeLensLike(camera: Pinhole): Lens {
    const focal = camera.width < camera.height ? camera.fx : camera.fy;
    return { kind: 'free', fov: 2 * Math.atan(Math.min(camera.width, camera.height) / 2 / focal) };
}
