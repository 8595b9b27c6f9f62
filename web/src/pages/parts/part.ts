// What all parts of the pages have in common.

/** A part of a page. It draws into the container that it was made with. */
export interface Part<Data> {
    /** Shows other data. What the reader chose (zoom, selection, checkboxes) stays. */
    update(data: Data): void;
    /** Removes its elements and listeners. */
    destroy(): void;
}

/** Gives the address of a picture, such as an object URL. The caller revokes it, after `destroy`. */
export type GetPicture = () => Promise<string>;

/** Why there is no picture, for the reader. */
export class NoPicture extends Error {}

/** A task of a job, in the words of `fathom show --json`. */
export interface TaskInfo {
    /** Its id: "plan", "global", "partition-0003", ... */
    readonly task: string;
    /** "plan", "global", "first_part", "exchange", "partition", "merge", "borders", "evaluate", "artifacts". */
    readonly stage: string;
    /** The partition that it trains; null for stages that are not per partition. */
    readonly partition: number | null;
    /** "blocked", "ready", "running", "done", "failed", "cancelled" or "unknown". */
    readonly state: string;
    /** The worker that holds it or held it last. */
    readonly worker: string | null;
    readonly iteration: number;
    /** 0 where nothing is trained. */
    readonly iterations: number;
    /** Attempts begun. */
    readonly attempts: number;
    /** Latest PSNR on held-out views, dB. */
    readonly psnr: number | null;
    /** Mean PSNR of its latest previews, dB; absent or null where it is not known. */
    readonly previewPsnr?: number | null;
}

/** A PSNR, and whether it is that of previews, which show few of the held-out views. */
export interface ShownPsnr {
    readonly value: number;
    readonly isOfPreviews: boolean;
}

/** The latest PSNR of a task: as it was measured, otherwise that of its previews. */
export function shownPsnr(task: Pick<TaskInfo, 'psnr' | 'previewPsnr'> | null): ShownPsnr | null {
    const [measured, ofPreviews] = [task?.psnr ?? null, task?.previewPsnr ?? null];
    if (measured !== null && Number.isFinite(measured)) {
        return { value: measured, isOfPreviews: false };
    }
    return ofPreviews === null || !Number.isFinite(ofPreviews) ? null : { value: ofPreviews, isOfPreviews: true };
}

/** What a reader needs to know of a state; blocked and ready tasks both wait. */
export type ShownState = 'waiting' | 'running' | 'done' | 'failed' | 'cancelled';
export const SHOWN_STATES: readonly ShownState[] = ['failed', 'running', 'waiting', 'cancelled', 'done'];

export function shownState(state: string): ShownState {
    return state === 'running' || state === 'done' || state === 'failed' || state === 'cancelled' ? state : 'waiting';
}
