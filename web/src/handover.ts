// The page that `fathom export --html` fills: one file that holds the viewer, the scene and the model, and
// fetches nothing.

import './page.css';
import { fileOf, sceneOf } from './embedded.ts';
import { ViewerError, openViewer, showError } from './viewer/index.ts';

const container = document.querySelector<HTMLElement>('#viewer')!;
const fetchFile = (path: string): Promise<Response> => Promise.resolve(fileOf(document, path));

try {
    const scene = sceneOf(document);
    const views = typeof scene.views === 'string' ? scene.views : '';
    await openViewer(container, scene, fetchFile, { useFragment: true, views, suggestsViews: true });
} catch (error) {
    if (!container.querySelector('[role=alert]')) {
        const known = error instanceof ViewerError;
        showError(container, known ? error : new ViewerError(String(error), 'Ask for this page again.', error));
    }
}
