// Held-out views: the photograph, the render, and the scene without water. Until the job has succeeded, and
// afterwards for those who want to see how it went, its previews.
//
// Each file in renders/ holds these pictures side by side, so they have the same size and the same camera.

import { JobState } from '../../rpc/fathom/v1/job_pb.ts';
import { problemOf } from '../context.ts';
import { h } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { compareViews } from '../parts/compare-views.ts';
import { choice } from '../parts/elements.ts';
import type { GetPicture } from '../parts/part.ts';
import type { ComparedView } from '../parts/view-difference.ts';
import { Addresses } from './addresses.ts';
import { openPreviews } from './previews.ts';
import type { JobContext, OpenSection, Section } from './section.ts';

type Kind = 'final' | 'training';

/** Places in the row: photograph, render, difference, J, backscatter. */
const PHOTOGRAPH = 0;
const RENDER = 1;
const CLEAR = 3;
const PICTURES_IN_AIR = 3;
const PICTURES_IN_WATER = 5;

/** The keys of metrics.json that are read. */
interface Metrics {
    readonly medium?: string;
    readonly views?: readonly { readonly name: string; readonly psnr: number | null; readonly ssim: number | null }[];
}

/** The file of the held-out view with this number among `paths`. */
export const renderOf = (paths: readonly string[], index: number): string | null =>
    paths.find((path) => path.startsWith(`renders/${String(index).padStart(4, '0')}_`)) ?? null;

/** Part of a row of `count` pictures as a file of its own. */
async function cut(row: Blob, place: number, count: number): Promise<Blob> {
    const whole = await createImageBitmap(row);
    const width = Math.floor(whole.width / count);
    const canvas = h('canvas', { width, height: whole.height });
    canvas.getContext('2d')?.drawImage(whole, -place * width, 0);
    whole.close();
    return new Promise((resolve, reject) => {
        canvas.toBlob((part) => (part === null ? reject(new Error('The picture cannot be read.')) : resolve(part)));
    });
}

function viewsOf(context: JobContext, addresses: Addresses, metrics: Metrics, paths: readonly string[]): readonly ComparedView[] {
    const { id, session, signal } = context;
    const isInWater = metrics.medium !== undefined && metrics.medium !== 'none';
    const count = isInWater ? PICTURES_IN_WATER : PICTURES_IN_AIR;
    return (metrics.views ?? []).map(({ name, psnr, ssim }, index) => {
        const path = renderOf(paths, index);
        let row: Promise<Blob> | null = null;
        const part = (place: number): GetPicture | null =>
            path === null
                ? null
                : async () => {
                      row ??= session.api.file(id, path, signal).catch((error: unknown) => {
                          row = null;
                          throw error;
                      });
                      return addresses.of(await cut(await row, place, count));
                  };
        return { name, psnr, ssim, photograph: part(PHOTOGRAPH), render: part(RENDER), clear: isInWater ? part(CLEAR) : null };
    });
}

function openRenders(container: HTMLElement, context: JobContext): Section {
    const addresses = new Addresses();
    let stop: (() => void) | null = null;
    const show = async (): Promise<void> => {
        container.replaceChildren(h('p', { class: 'loading', role: 'status' }, 'Loading the views …'));
        try {
            const [metrics, files] = await Promise.all([context.json('metrics.json'), context.files()]);
            if (context.signal.aborted) {
                return;
            }
            const views = viewsOf(context, addresses, (metrics ?? {}) as Metrics, files.map(({ path }) => path));
            if (views.length === 0) {
                container.replaceChildren(
                    h('div', { class: 'empty' }, h('h2', {}, 'No held-out views'), h('p', {}, 'No photograph was held out of the training, so none can be compared.')),
                );
                return;
            }
            const host = h('div', { class: 'card' });
            container.replaceChildren(host);
            const part = compareViews(host);
            stop = () => part.destroy();
            part.update({ views });
        } catch (error) {
            const shown = problemOf('The views cannot be shown', faultOf(error));
            if (shown !== null) {
                container.replaceChildren(shown);
            }
        }
    };
    void show();
    return {
        update: () => {},
        destroy: () => {
            stop?.();
            addresses.revoke();
        },
    };
}

const OPEN: Readonly<Record<Kind, OpenSection>> = { final: openRenders, training: openPreviews };

export function open(container: HTMLElement, context: JobContext): Section {
    const host = h('div');
    let shown: Kind | null = null;
    let chosen: Kind | null = null;
    let section: Section | null = null;
    let stop = new AbortController();
    const kinds = choice<Kind>(
        'Which views',
        [
            ['final', 'Final comparison'],
            ['training', 'During training'],
        ],
        'final',
        (kind) => {
            chosen = kind;
            update();
        },
    );
    const bar = h('div', { class: 'fp' }, kinds.element);
    container.append(bar, host);

    function end(): void {
        stop.abort();
        section?.destroy?.();
        section = null;
    }

    function update(): void {
        const hasFinal = context.job.state === JobState.SUCCEEDED;
        const kind: Kind = hasFinal ? (chosen ?? 'final') : 'training';
        bar.hidden = !hasFinal;
        kinds.value = kind;
        if (kind !== shown) {
            end();
            shown = kind;
            stop = new AbortController();
            host.replaceChildren();
            const signal = AbortSignal.any([context.signal, stop.signal]);
            section = OPEN[kind](host, Object.create(context, { signal: { value: signal } }) as JobContext);
        }
        section?.update();
    }
    update();
    return { update, destroy: end };
}
