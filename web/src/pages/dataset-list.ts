// The datasets of a tenant, for the list of them and for a new job.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import { type Dataset, DatasetState } from '../rpc/fathom/v1/upload_pb.ts';
import { commandField } from './commands.ts';
import type { Context } from './context.ts';
import { h } from './dom.ts';
import { bytesText, countText } from './format.ts';

const PAGE_SIZE = 1000;

/** All datasets, the newest first. */
export async function listDatasets({ session, signal }: Context): Promise<readonly Dataset[]> {
    const found: Dataset[] = [];
    let pageToken = '';
    do {
        const page = await session.api.uploads.listDatasets({ pageSize: PAGE_SIZE, pageToken }, { signal });
        found.push(...page.datasets);
        pageToken = page.nextPageToken;
    } while (pageToken !== '');
    return found.toSorted((a, b) => createdMs(b) - createdMs(a));
}

export const createdMs = ({ createTime }: Dataset): number => (createTime === undefined ? 0 : timestampMs(createTime));

export const isCommitted = ({ state }: Dataset): boolean => state === DatasetState.COMMITTED;

/** "26 files, 585 kB". */
export const contentText = ({ files, sizeBytes }: Dataset): string =>
    `${files === 1n ? '1 file' : `${countText(files)} files`}, ${bytesText(sizeBytes)}`;

/** How to upload a scene. `ways` comes before the command for a terminal. */
export function howToUpload({ session }: Context, ...ways: readonly (Node | string)[]): HTMLElement {
    return h(
        'div',
        { class: 'empty' },
        h('h2', {}, 'No datasets yet'),
        h('p', {}, 'A dataset is an uploaded scene. Any number of jobs can use it. ', ...ways),
        commandField(session, 'dataset upload DATA --id NAME'),
        h(
            'p',
            { class: 'soft' },
            'DATA is a folder with photographs, and with camera poses and sparse points of COLMAP or nerfstudio. NAME has ' +
                'lower-case letters, digits, "-", "_" and ".". The coordinator may have another port. The dataset appears ' +
                'here by itself.',
        ),
    );
}
