// The page view.html: opens the scene that scene.json beside it describes.

import './page.css';
import { type Scene, ViewerError, openViewer, showError } from './viewer/index.ts';

const container = document.querySelector<HTMLElement>('#viewer')!;
const fetchFile = (path: string): Promise<Response> => fetch(new URL(path, document.baseURI));

async function readScene(): Promise<Scene> {
    const response = await fetchFile('scene.json');
    if (!response.ok) {
        throw new ViewerError(
            `scene.json cannot be fetched: the server answers ${response.status} ${response.statusText}.`,
            'Put scene.json beside this page. It names the model and holds the cameras and the water.',
        );
    }
    try {
        return (await response.json()) as Scene;
    } catch (error) {
        throw new ViewerError('scene.json is not JSON.', 'Make scene.json again.', error);
    }
}

try {
    const scene = await readScene();
    document.title = `${scene.name} - Fathom`;
    await openViewer(container, scene, fetchFile, { useFragment: true });
} catch (error) {
    if (!container.querySelector('[role=alert]')) {
        const known = error instanceof ViewerError;
        showError(container, known ? error : new ViewerError(`The scene cannot be fetched: ${String(error)}.`, 'Check the connection and reload the page.'));
    }
}
