// Held-out views while a job trains: small pictures that its workers send from time to time.

import type { TaskHistory } from '../../rpc/fathom/v1/job_pb.ts';
import { TaskState } from '../../rpc/fathom/v1/job_pb.ts';
import { problemOf } from '../context.ts';
import { freshId, h, setAttribute, setText } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { countText } from '../format.ts';
import { compareViews } from '../parts/compare-views.ts';
import { decibels } from '../parts/format.ts';
import { type GetPicture, NoPicture } from '../parts/part.ts';
import type { ComparedView } from '../parts/view-difference.ts';
import { hasEnded, taskLabel } from '../words.ts';
import { Addresses } from './addresses.ts';
import { followHistory } from './history.ts';
import { Photographs } from './photographs.ts';
import { type Frame, type PreviewSeries, digestsOf, firstSeries, frameAt, latestPsnr, seriesOf } from './preview-series.ts';
import type { JobContext, Section } from './section.ts';

/** Previews have at most this many pixels along a side. Photographs are made as small, to be compared. */
/** A picture of a preview that is larger was not made by a worker of ours. */
const MOST_PICTURE_BYTES = 512 * 1024;
const MOST_PIXELS = 480;
/** A picture whose name has just arrived may not be readable yet, so it is asked for so many times. */
const ATTEMPTS = 3;
const GONE = 'This picture is gone: the service deletes previews after some time.';
const PLAY_MS = 700;

async function smaller(photograph: Blob): Promise<Blob> {
    const whole = await createImageBitmap(photograph);
    const scale = Math.min(1, MOST_PIXELS / Math.max(whole.width, whole.height));
    const [width, height] = [Math.round(whole.width * scale), Math.round(whole.height * scale)];
    const canvas = h('canvas', { width, height });
    const drawn = canvas.getContext('2d');
    if (drawn !== null) {
        drawn.imageSmoothingQuality = 'high';
        drawn.drawImage(whole, 0, 0, width, height);
    }
    whole.close();
    return new Promise((resolve, reject) => {
        canvas.toBlob((made) => (made === null ? reject(new Error('The photograph cannot be read.')) : resolve(made)));
    });
}

/** Reads pictures once, and again after a failure that may pass. */
class Blobs {
    readonly #context: JobContext;
    readonly #addresses: Addresses;
    readonly #known = new Map<string, GetPicture>();
    /** Addresses of the pictures that were read, by digest. */
    readonly #read = new Map<string, string>();
    readonly #missing = new Map<string, number>();
    /** Pictures that could not be read since the last round. */
    readonly #failed = new Set<string>();

    constructor(context: JobContext, addresses: Addresses) {
        this.#context = context;
        this.#addresses = addresses;
    }

    of(digest: string): GetPicture {
        const known = this.#known.get(digest) ?? this.#makeGet(digest);
        this.#known.set(digest, known);
        return known;
    }

    /** Asks for pictures again that may be there now: another function is another picture for the part. */
    again(): void {
        for (const digest of this.#failed) {
            if ((this.#missing.get(digest) ?? 0) < ATTEMPTS) {
                this.#known.delete(digest);
            }
        }
        this.#failed.clear();
    }

    /** Forgets all other pictures: the service keeps fewer and fewer of the earlier ones. */
    keep(digests: ReadonlySet<string>): void {
        for (const digest of this.#known.keys()) {
            if (!digests.has(digest)) {
                this.#known.delete(digest);
                this.#missing.delete(digest);
            }
        }
        for (const [digest, address] of this.#read) {
            if (!digests.has(digest)) {
                this.#read.delete(digest);
                this.#addresses.free(address);
            }
        }
    }

    #makeGet(digest: string): GetPicture {
        const { id, session, signal } = this.#context;
        let address: Promise<string> | null = null;
        const read = async (): Promise<string> => {
            try {
                const made = this.#addresses.of(await session.api.blob(digest, id, signal, 'image/jpeg', MOST_PICTURE_BYTES));
                this.#read.set(digest, made);
                return made;
            } catch (error) {
                address = null;
                this.#failed.add(digest);
                const fault = faultOf(error);
                if (fault.reason === 'BLOB_NOT_FOUND') {
                    this.#missing.set(digest, (this.#missing.get(digest) ?? 0) + 1);
                    throw new NoPicture(GONE, { cause: error });
                }
                throw fault;
            }
        };
        return () => (address ??= read());
    }
}

/** The slider over the iterations, and what plays them. `change` gets an iteration; null is the newest. */
function makeSlider(change: (iteration: number | null) => void): { readonly element: HTMLElement; show(series: PreviewSeries, shown: Frame): void; stop(): void } {
    const id = freshId();
    const input = h('input', { type: 'range', id, class: 'fp-fill', min: 0, step: 1, value: 0 });
    const output = h('output', { for: id, class: 'fp-number' });
    const play = h('button', { type: 'button', class: 'fp-button' }, 'Play');
    const row = h('div', { class: 'fp-bar' }, h('label', { for: id }, 'Training'), input, play, output);
    let frames: readonly Frame[] = [];
    let timer = 0;

    const choose = (place: number): void => {
        // At the end the reader follows what arrives.
        change(place >= frames.length - 1 ? null : frames[place]!.iteration);
    };
    const stop = (): void => {
        clearInterval(timer);
        timer = 0;
        setText(play, 'Play');
    };
    input.addEventListener('input', () => {
        stop();
        choose(Number(input.value));
    });
    play.addEventListener('click', () => {
        if (timer !== 0) {
            stop();
            return;
        }
        setText(play, 'Stop');
        const isAtEnd = Number(input.value) >= frames.length - 1;
        choose(isAtEnd ? 0 : Number(input.value));
        timer = window.setInterval(() => {
            const next = Number(input.value) + 1;
            if (next >= frames.length - 1) {
                stop();
            }
            choose(next);
        }, PLAY_MS);
    });
    return {
        element: row,
        stop,
        show: ({ frames: all, iterations }, shown) => {
            frames = all;
            const text = `Iteration ${countText(shown.iteration)}${iterations === 0 ? '' : ` of ${countText(iterations)}`}`;
            setAttribute(input, 'max', String(all.length - 1));
            input.value = String(all.indexOf(shown));
            setAttribute(input, 'aria-valuetext', text);
            setText(output, text);
            input.disabled = all.length < 2;
            play.disabled = all.length < 2;
        },
    };
}

export function openPreviews(container: HTMLElement, context: JobContext): Section {
    const { signal } = context;
    const addresses = new Addresses();
    const blobs = new Blobs(context, addresses);
    const photographs = new Photographs(context);
    const ofPhotographs = new Map<string, GetPicture>();
    const host = h('div', { class: 'card' });
    const empty = h('div', { class: 'empty' });
    const loading = h('p', { class: 'loading', role: 'status' }, 'Loading the views …');
    container.append(loading);
    let tasks: readonly TaskHistory[] = [];
    let chosen: string | null = null;
    let iteration: number | null = null;
    const slider = makeSlider((value) => {
        iteration = value;
        draw();
    });
    const part = compareViews(host, {
        controls: slider.element,
        onChoose: (key) => {
            slider.stop();
            chosen = key;
            draw();
        },
    });

    const photograph = (name: string): GetPicture => {
        let address: Promise<string> | null = null;
        const read = async (): Promise<string> => {
            try {
                const content = await photographs.fetch(name);
                if (content === null) {
                    throw new NoPicture('The photograph is not among the files of the job.');
                }
                return addresses.of(await smaller(content));
            } catch (error) {
                address = null;
                throw error;
            }
        };
        const known = ofPhotographs.get(name) ?? (() => (address ??= read()));
        ofPhotographs.set(name, known);
        return known;
    };

    /** A series as it is now, or at the iteration that the reader chose. */
    const viewOf = (series: PreviewSeries, isShown: boolean): ComparedView => {
        const newest = frameAt(series, null);
        const { render, clear, psnr } = isShown ? frameAt(series, iteration) : newest;
        const task = taskLabel(series.task);
        const latest = latestPsnr(series);
        return {
            key: series.key,
            name: series.view,
            label: latest === null ? task : `${decibels(latest)}, ${task}`,
            facts: psnr === null ? task : `${task}, PSNR ${decibels(psnr)}`,
            psnr: latest,
            ssim: null,
            photograph: photograph(series.view),
            render: blobs.of(render),
            clear: clear === null ? null : blobs.of(clear),
            thumbnail: blobs.of(newest.render),
        };
    };

    function draw(): void {
        if (signal.aborted) {
            return;
        }
        const series = seriesOf(tasks);
        const running = new Set(context.job.tasks.filter(({ state }) => state === TaskState.LEASED).map(({ taskId }) => taskId));
        const shown = series.find(({ key }) => key === chosen) ?? firstSeries(series, running);
        if (shown === null) {
            showEmpty();
            return;
        }
        if (!host.isConnected) {
            container.replaceChildren(host);
        }
        slider.show(shown, frameAt(shown, iteration));
        const views = series.map((one) => viewOf(one, one === shown));
        // Without any PSNR the order of the tasks says more than that of the names.
        const order = views.some(({ psnr }) => psnr !== null) ? 'worst' : 'given';
        part.update({ views, order, chosen: shown.key });
    }

    function showEmpty(): void {
        const isOpen = !hasEnded(context.job.state);
        const title = isOpen ? 'No previews yet' : 'No previews';
        const text = isOpen
            ? 'The first ones come a few seconds after training begins.'
            : 'No worker sent one, or the service has deleted them.';
        empty.replaceChildren(
            h('h2', {}, title),
            h('p', {}, text),
            h('p', { class: 'soft' }, 'They need held-out photographs (', h('code', {}, 'data.test_every'), '), and ', h('code', {}, 'train.preview_seconds = 0'), ' turns them off.'),
        );
        container.replaceChildren(empty);
    }

    const polling = followHistory(
        context,
        (history) => {
            ({ tasks } = history);
            blobs.keep(digestsOf(tasks));
            blobs.again();
            draw();
        },
        (fault) => {
            const shown = problemOf('The previews cannot be shown', fault);
            if (shown !== null && !signal.aborted && !host.isConnected) {
                container.replaceChildren(shown);
            }
        },
    );

    let state = context.job.state;
    return {
        update: () => {
            if (context.job.state !== state) {
                state = context.job.state;
                polling.now();
            }
        },
        destroy: () => {
            slider.stop();
            part.destroy();
            addresses.revoke();
        },
    };
}
