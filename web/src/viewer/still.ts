// A still of what is shown, as a PNG file.

import { h } from './dom.ts';
import type { Panel } from './panel.ts';
import type { Viewer } from './viewer.ts';

/** Saves the picture with the pixels of the screen, the photograph beside it included. */
export async function savePicture(viewer: Viewer, photograph: HTMLImageElement, panel: Panel): Promise<void> {
    const area = viewer.area();
    const density = Math.min(2, window.devicePixelRatio);
    const [width, height] = [Math.round(area.width * density), Math.round(area.height * density)];
    const picture = h('canvas', { width, height });
    const context = picture.getContext('2d');
    context?.putImageData(await viewer.picture({ width, height }), 0, 0);
    if (viewer.state.right === 'photograph' && photograph.naturalWidth > 0) {
        const { split } = viewer.state;
        const [w, x] = [photograph.naturalWidth, Math.round(split * width)];
        context?.drawImage(photograph, split * w, 0, (1 - split) * w, photograph.naturalHeight, x, 0, width - x, height);
    }
    const blob = await new Promise<Blob | null>((done) => picture.toBlob(done, 'image/png'));
    if (blob === null) {
        panel.say('The browser could not write the picture. Make the window smaller.');
        return;
    }
    const address = URL.createObjectURL(blob);
    const name = viewer.scene.name.replace(/[^\p{L}\p{N}._-]+/gu, '_');
    h('a', { href: address, download: `${name}.png` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10_000);
    panel.say(`Saved ${width} x ${height} pixels.`);
}
