// Marks on top of the picture: the positions of the photographs as small frusta.

import { pinholeOf } from './camera.ts';
import { type Vec3, add, mulMat, scale } from './vector.ts';
import type { Viewer } from './viewer.ts';

/** Depth of a mark, as a share of the viewing distance. */
const DEPTH = 0.08;

export function drawMarks(viewer: Viewer, canvas: HTMLCanvasElement): void {
    const density = Math.min(2, window.devicePixelRatio);
    const width = Math.round(viewer.canvas.clientWidth * density);
    const height = Math.round(viewer.canvas.clientHeight * density);
    if (canvas.width !== width || canvas.height !== height) {
        canvas.width = width;
        canvas.height = height;
    }
    const context = canvas.getContext('2d');
    if (context === null) {
        return;
    }
    context.clearRect(0, 0, width, height);
    if (!viewer.state.showsCameras) {
        return;
    }
    context.setTransform(density, 0, 0, density, 0, 0);
    const toScreen = viewer.toScreen();
    const depth = DEPTH * viewer.markScale;
    for (const camera of viewer.cameras) {
        const lens = pinholeOf(camera);
        const isHere = camera.img_name === viewer.state.photograph;
        const corner = (x: number, y: number): Vec3 =>
            add(
                camera.position,
                scale(mulMat(camera.rotation, [(x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy, 1]), depth),
            );
        const eye = toScreen(camera.position);
        const corners = [corner(0, 0), corner(lens.width, 0), corner(lens.width, lens.height), corner(0, lens.height)];
        const ends = corners.map(toScreen);
        if (isHere || eye === null || ends.some((end) => end === null)) {
            continue;
        }
        context.beginPath();
        ends.forEach((end, i) => {
            const next = ends[(i + 1) % 4]!;
            context.moveTo(eye.x, eye.y);
            context.lineTo(end!.x, end!.y);
            context.lineTo(next.x, next.y);
        });
        // A dark line below a light one is seen on any picture.
        context.lineWidth = 3;
        context.strokeStyle = 'rgb(0 0 0 / 45%)';
        context.stroke();
        context.lineWidth = 1.25;
        context.strokeStyle = '#ffd166';
        context.stroke();
    }
    context.setTransform(1, 0, 0, 1, 0, 0);
}
