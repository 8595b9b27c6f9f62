// The list of datasets.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import type { Dataset } from '../rpc/fathom/v1/upload_pb.ts';
import { type Context, problemOf } from './context.ts';
import { contentText, createdMs, howToUpload, isCommitted, listDatasets } from './dataset-list.ts';
import { ask } from './dialog.ts';
import { type Column, Table, chip, h, only, setAttribute, setText } from './dom.ts';
import { Fault, faultOf } from './faults.ts';
import { bytesText, countText, timeText } from './format.ts';
import { poll } from './poll.ts';
import { newJobLink } from './route.ts';

const EVERY_MS = 5000;

function showState(cell: HTMLElement, dataset: Dataset): void {
    const box = only(cell, () => h('div', {}, h('span'), h('div', { class: 'soft' })));
    const [word, label] = isCommitted(dataset) ? ['done', 'Complete'] : ['running', 'Uploading'];
    chip(box.firstElementChild as HTMLElement, word, label);
    const expires = dataset.expireTime === undefined ? '' : `Discarded on ${timeText(timestampMs(dataset.expireTime))} unless it goes on`;
    setText(box.lastElementChild as HTMLElement, isCommitted(dataset) ? '' : expires);
}

function showTime(cell: HTMLElement, dataset: Dataset): void {
    const element = only(cell, () => h('time'));
    setText(element, timeText(createdMs(dataset)));
    setAttribute(element, 'datetime', new Date(createdMs(dataset)).toISOString());
}

async function deleteDataset({ session, say }: Context, dataset: Dataset, done: () => void): Promise<void> {
    const { datasetId } = dataset;
    await ask({
        title: 'Delete the dataset?',
        text: `"${datasetId}" (${contentText(dataset)}) is deleted, with all files that nothing else uses. This cannot be undone.`,
        action: 'Delete the dataset',
        dismiss: 'Keep it',
        isDangerous: true,
        act: async () => {
            try {
                await session.api.uploads.deleteDataset({ datasetId });
            } catch (error) {
                const fault = faultOf(error);
                // Another page was faster.
                if (fault.reason !== 'DATASET_NOT_FOUND') {
                    const isUsed = fault.reason === 'DATASET_IN_USE';
                    throw isUsed ? new Fault('refused', fault.reason, `${fault.message} Delete the jobs that use it first.`, error) : fault;
                }
            }
            say('The dataset is deleted.');
            done();
            return null;
        },
    });
}

export function showDatasets(container: HTMLElement, context: Context): void {
    const { session, signal } = context;
    context.title('Datasets');
    const current = new Map<string, Dataset>();
    const columns: Column<Dataset>[] = [
        { title: 'Name', kind: 'name', isHeader: true, show: (cell, { datasetId }) => setText(cell, datasetId) },
        { title: 'State', kind: 'state', show: showState },
        { title: 'Files', kind: 'number', show: (cell, { files }) => setText(cell, countText(files)) },
        { title: 'Size', kind: 'size', show: (cell, { sizeBytes }) => setText(cell, bytesText(sizeBytes)) },
        { title: 'Created', kind: 'created', show: showTime },
    ];
    if (session.controls) {
        const makeActions = ({ datasetId }: Dataset): HTMLElement => {
            const remove = (): void => {
                const dataset = current.get(datasetId);
                if (dataset !== undefined) {
                    void deleteDataset(context, dataset, () => polling.now());
                }
            };
            return h(
                'div',
                { class: 'row' },
                h('a', { class: 'button', href: newJobLink(datasetId), 'aria-label': `New job from ${datasetId}` }, 'New job'),
                h('button', { type: 'button', class: 'danger', 'aria-label': `Delete ${datasetId}`, onclick: remove }, 'Delete'),
            );
        };
        columns.push({
            title: 'Actions',
            kind: 'act',
            show: (cell, dataset) => {
                const row = only(cell, () => makeActions(dataset));
                (row.firstElementChild as HTMLElement).hidden = !isCommitted(dataset);
            },
        });
    }
    const table = new Table<Dataset>('Datasets', 'datasets', columns, ({ datasetId }) => datasetId);
    const content = h('div', { class: 'card flush' }, h('p', { class: 'loading', role: 'status' }, 'Loading the datasets …'));
    const none = (): HTMLElement =>
        session.controls
            ? howToUpload(
                  context,
                  h('a', { href: newJobLink() }, 'Submit a folder'),
                  ' from this page, or upload one from a terminal:',
              )
            : howToUpload(context, 'Upload one from a terminal:');
    const more = h('p', { class: 'soft', hidden: true }, 'To upload another one: ', h('code', {}, 'fathom dataset upload DATA --id NAME'));
    const submit = h('a', { class: 'button', href: newJobLink() }, 'Submit a folder');
    submit.hidden = !session.controls;
    const head = h('div', { class: 'head' }, h('h1', { tabindex: -1 }, 'Datasets'), submit);
    container.append(head, content, more);

    const polling = poll(() => EVERY_MS, signal, async () => {
        try {
            const datasets = await listDatasets(context);
            current.clear();
            datasets.forEach((dataset) => current.set(dataset.datasetId, dataset));
            table.show(datasets);
            const shown = datasets.length > 0 ? 'table' : 'empty';
            if (content.dataset['shown'] !== shown) {
                content.replaceChildren(shown === 'table' ? table.element : none());
            }
            content.dataset['shown'] = shown;
            more.hidden = shown === 'empty';
        } catch (error) {
            const shown = problemOf('The datasets cannot be listed', faultOf(error));
            if (shown !== null) {
                content.replaceChildren(shown);
                content.dataset['shown'] = 'fault';
            }
        }
    });
}
