// Small pictures of the jobs of a list: the newest preview, or else a final render.
//
// A list of jobs names no pictures, so each costs a call or two. Only rows in sight ask, two at a time, and a
// picture that is known stays for as long as this page is open.

import type { Artifact, Job } from '../rpc/fathom/v1/job_pb.ts';
import { JobState } from '../rpc/fathom/v1/job_pb.ts';
import type { Context } from './context.ts';
import { h } from './dom.ts';
import { newestFrame } from './job/preview-series.ts';
import type { Session } from './session.ts';

const AT_A_TIME = 2;
/** The picture of a job that trains is looked for this often at most. */
const AGAIN_MS = 45_000;
/** The history of a job with more partitions is too long to fetch for a small picture. */
const MOST_PARTITIONS = 16;
/** A final render that is larger than this is left out. */
const MOST_BYTES = 2_500_000;
/** Pictures of jobs that are kept. */
const MOST_KEPT = 500;
/** Beside the render in its file: photograph, difference, and in water two more. */
const RENDER_PLACE = 1;
const [WIDTH, HEIGHT] = [112, 84];

interface Known {
    readonly askedMs: number;
    /** The state in which it was looked for: the end of a job brings a new picture. */
    readonly state: JobState;
    readonly digest: string;
    readonly picture: ImageBitmap | null;
    /** Whether the last look failed, so that another one may help. */
    readonly hasFailed: boolean;
}

/** The middle of a picture at the size of the place for it: hundreds of whole pictures would fill the memory. */
function fitted(picture: ImageBitmap, left: number, width: number): ImageBitmap {
    const canvas = new OffscreenCanvas(WIDTH, HEIGHT);
    const scale = Math.max(WIDTH / width, HEIGHT / picture.height);
    const [wide, high] = [WIDTH / scale, HEIGHT / scale];
    const drawn = canvas.getContext('2d');
    if (drawn !== null) {
        drawn.imageSmoothingQuality = 'high';
        drawn.drawImage(picture, left + (width - wide) / 2, (picture.height - high) / 2, wide, high, 0, 0, WIDTH, HEIGHT);
    }
    picture.close();
    return canvas.transferToImageBitmap();
}

/** A list that is opened again has its pictures at once. */
const kept = new WeakMap<Session, Map<string, Known>>();

export class Thumbnails {
    readonly #context: Context;
    readonly #known: Map<string, Known>;
    readonly #canvases = new Map<string, HTMLCanvasElement>();
    readonly #jobs = new Map<string, Job>();
    readonly #inSight = new Set<string>();
    readonly #observer: IntersectionObserver;
    #running = 0;

    constructor(context: Context) {
        this.#context = context;
        const { session, signal } = context;
        this.#known = kept.get(session) ?? new Map<string, Known>();
        kept.set(session, this.#known);
        this.#observer = new IntersectionObserver((seen) => {
            for (const { target, isIntersecting } of seen) {
                const id = (target as HTMLElement).dataset['job'] ?? '';
                if (isIntersecting) {
                    this.#inSight.add(id);
                } else {
                    this.#inSight.delete(id);
                }
            }
            this.#next();
        });
        signal.addEventListener('abort', () => this.#observer.disconnect(), { once: true });
    }

    /** The place for the picture of a job. */
    make(jobId: string): HTMLElement {
        const canvas = h('canvas', { class: 'job-thumb', width: WIDTH, height: HEIGHT, 'aria-hidden': 'true', 'data-job': jobId });
        this.#canvases.set(jobId, canvas);
        this.#observer.observe(canvas);
        this.#draw(jobId);
        return canvas;
    }

    /** The job as it is now. */
    update(job: Job): void {
        this.#jobs.set(job.jobId, job);
        this.#next();
    }

    #isDue({ jobId, state, partitions }: Job): boolean {
        const known = this.#known.get(jobId);
        const isOpen = state === JobState.RUNNING || state === JobState.PAUSED;
        const mayChange = known === undefined || isOpen || known.hasFailed;
        return partitions > 0 && (known?.state !== state || (mayChange && Date.now() - known.askedMs > AGAIN_MS));
    }

    #next(): void {
        for (const id of this.#inSight) {
            const job = this.#jobs.get(id);
            if (this.#running >= AT_A_TIME || this.#context.signal.aborted) {
                return;
            }
            if (job !== undefined && this.#isDue(job)) {
                void this.#look(job);
            }
        }
    }

    async #look(job: Job): Promise<void> {
        const { jobId, state } = job;
        const before = this.#known.get(jobId);
        const noted = { askedMs: Date.now(), state };
        // Noted first, so that nobody else looks for it meanwhile.
        this.#known.delete(jobId);
        const noNews = { ...noted, digest: before?.digest ?? '', picture: before?.picture ?? null };
        this.#known.set(jobId, { ...noNews, hasFailed: false });
        this.#running += 1;
        try {
            const found = await this.#newest(job, before?.digest ?? '');
            if (found !== null) {
                before?.picture?.close();
                this.#known.set(jobId, { ...noted, ...found, hasFailed: false });
                this.#draw(jobId);
            }
        } catch {
            // The place stays as it is: the list itself says what is wrong with the service.
            this.#known.set(jobId, { ...noNews, askedMs: this.#context.signal.aborted ? 0 : noNews.askedMs, hasFailed: true });
        }
        this.#running -= 1;
        const [oldest] = this.#known.keys();
        if (this.#known.size > MOST_KEPT && oldest !== undefined) {
            this.#known.get(oldest)?.picture?.close();
            this.#known.delete(oldest);
        }
        this.#next();
    }

    /** The newest picture of a job; null if there is none, or none but the known one. */
    async #newest(job: Job, known: string): Promise<Pick<Known, 'digest' | 'picture'> | null> {
        const { session, signal } = this.#context;
        const { jobId } = job;
        if (job.partitions <= MOST_PARTITIONS) {
            const { tasks } = await session.api.jobs.getHistory({ jobId }, { signal });
            const digest = newestFrame(tasks)?.render ?? '';
            if (digest !== '' && digest === known) {
                return null;
            }
            // It may be deleted: then a final render.
            const content = digest === '' ? null : await session.api.blob(digest, jobId, signal, 'image/jpeg', MOST_BYTES).catch(() => null);
            if (content !== null) {
                const whole = await createImageBitmap(content);
                return { digest, picture: fitted(whole, 0, whole.width) };
            }
        }
        if (job.state !== JobState.SUCCEEDED) {
            return null;
        }
        const { artifacts } = await session.api.jobs.listArtifacts({ jobId }, { signal });
        const render = artifacts.find(isSmallRender);
        if (render?.blob === undefined || render.blob.digest === known) {
            return null;
        }
        const row = await createImageBitmap(await session.api.blob(render.blob.digest, jobId, signal, 'image/png'));
        const width = Math.floor(row.width / picturesIn(job.configJson));
        return { digest: render.blob.digest, picture: fitted(row, RENDER_PLACE * width, width) };
    }

    #draw(jobId: string): void {
        const picture = this.#known.get(jobId)?.picture ?? null;
        const canvas = this.#canvases.get(jobId);
        if (picture === null || canvas === undefined) {
            return;
        }
        canvas.getContext('2d')?.drawImage(picture, 0, 0);
    }
}

const isSmallRender = ({ path, blob }: Artifact): boolean => path.startsWith('renders/') && Number(blob?.sizeBytes ?? Infinity) <= MOST_BYTES;

/** A render lies beside the photograph and their difference; in water, beside two more pictures. */
export function picturesIn(configJson: string): number {
    try {
        const config = JSON.parse(configJson) as { readonly water?: { readonly medium?: string } };
        return config.water?.medium === 'none' ? 3 : 5;
    } catch {
        return 5;
    }
}
