// The files of a job that has succeeded.

import type { Artifact } from '../../rpc/fathom/v1/job_pb.ts';
import { problemOf } from '../context.ts';
import { Table, h, only, progressBar, setText } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { bytesText, percentText } from '../format.ts';
import { type JobContext, type Section, whenSucceeded } from './section.ts';

/** What each file is for. */
const MEANINGS: Readonly<Record<string, string>> = {
    'model.ply': 'The model, for viewers of 3D Gaussians',
    'model.compressed.ply': 'A smaller copy of the model, for viewing',
    'model.json': 'The parts of the model',
    'water.json': 'The water parameters with standard errors',
    'metrics.json': 'Quality on held-out photographs',
    'plan.json': 'How the scene was cut',
    'plan.png': 'The cut, as a picture from above',
    'cameras.json': 'All cameras, in the form of 3DGS',
    'run.json': 'Inputs, settings, versions and tasks',
};
/** An address of a file that is being saved must stay valid until the browser has begun. */
const SAVE_MS = 60_000;

/** Has the browser save a file. */
export function save(content: Blob, name: string): void {
    const address = URL.createObjectURL(content);
    const link = h('a', { href: address, download: name, hidden: true });
    document.body.append(link);
    link.click();
    link.remove();
    setTimeout(() => URL.revokeObjectURL(address), SAVE_MS);
}

/** The name under which a file is saved: that of the file, without its folders. */
export const baseName = (path: string): string => path.split('/').at(-1) ?? path;

/** A button that downloads a file, shows how far it is, and can stop it. */
function makeDownload(context: JobContext, file: Artifact): HTMLElement {
    const { id, session, signal } = context;
    const bar = progressBar(`Download of ${file.path}`);
    const text = h('span', { class: 'number soft' });
    const error = h('span', { class: 'bad-text', role: 'alert' });
    const button = h('button', { type: 'button', 'aria-label': `Download ${file.path}` }, 'Download');
    const stop = h('button', { type: 'button', 'aria-label': `Stop the download of ${file.path}` }, 'Stop');
    const running = h('div', { class: 'download', hidden: true }, bar.element, text, stop);
    const show = (done: number, total: number): void => {
        const share = total > 0 ? done / total : 0;
        bar.set(share, percentText(share));
        text.textContent = `${bytesText(done)} of ${bytesText(total)}`;
    };
    const run = async (): Promise<void> => {
        const ended = new AbortController();
        stop.addEventListener('click', () => ended.abort(), { once: true });
        error.textContent = '';
        button.hidden = true;
        running.hidden = false;
        show(0, Number(file.blob?.sizeBytes ?? 0));
        try {
            const content = await session.api.file(id, file.path, AbortSignal.any([signal, ended.signal]), show);
            save(content, baseName(file.path));
        } catch (thrown) {
            const fault = faultOf(thrown);
            error.textContent = fault.kind === 'ended' ? '' : fault.message;
        }
        running.hidden = true;
        button.hidden = false;
        if (ended.signal.aborted) {
            button.focus();
        }
    };
    button.addEventListener('click', () => void run());
    return h('div', { class: 'download-cell' }, button, running, error);
}

function makeTable(context: JobContext, label: string, files: readonly Artifact[]): HTMLElement {
    const table = new Table<Artifact>(
        label,
        'files',
        [
            {
                title: 'File',
                kind: 'name',
                isHeader: true,
                show: (cell, { path }) => {
                    const meaning = MEANINGS[path];
                    only(cell, () => h('div', {}, h('span', { class: 'mono' }, path), meaning === undefined ? null : h('div', { class: 'soft' }, meaning)));
                },
            },
            { title: 'Size', kind: 'size number', show: (cell, { blob }) => setText(cell, bytesText(blob?.sizeBytes ?? 0n)) },
            { title: 'Download', kind: 'act', show: (cell, file) => void only(cell, () => makeDownload(context, file)) },
        ],
        ({ path }) => path,
    );
    table.show(files);
    return h('div', { class: 'card flush' }, table.element);
}

export function open(container: HTMLElement, context: JobContext): Section {
    const show = async (): Promise<void> => {
        container.replaceChildren(h('p', { class: 'loading', role: 'status' }, 'Loading the list of files …'));
        try {
            const files = await context.files();
            const whole = files.reduce((sum, { blob }) => sum + Number(blob?.sizeBytes ?? 0), 0);
            const plain = files.filter(({ path }) => !path.includes('/'));
            const renders = files.filter(({ path }) => path.includes('/'));
            container.replaceChildren(
                h('p', { class: 'soft' }, `${files.length} files, ${bytesText(whole)} in all. For all of them at once: `, h('code', {}, `fathom download ${context.id} -o OUT`)),
                makeTable(context, 'Files', plain),
            );
            if (renders.length > 0) {
                const details = h('details', { class: 'more' }, h('summary', {}, `Pictures of held-out views (${renders.length})`));
                // There may be thousands; they are made when somebody wants to see them.
                details.addEventListener('toggle', () => details.append(makeTable(context, 'Pictures', renders)), { once: true });
                container.append(details);
            }
        } catch (error) {
            const shown = problemOf('The files cannot be listed', faultOf(error));
            if (shown !== null) {
                container.replaceChildren(shown);
            }
        }
    };
    return whenSucceeded(container, context, 'Its files', () => void show());
}
