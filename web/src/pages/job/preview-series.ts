// The previews of a job by task and view, without anything of the page.

import type { TaskHistory } from '../../rpc/fathom/v1/job_pb.ts';
import type { TaskInfo } from '../parts/part.ts';

/** The pictures of a view after some iterations, by the digests of their blobs. */
export interface Frame {
    readonly iteration: number;
    readonly render: string;
    /** Without the water; null where there is none. */
    readonly clear: string | null;
    /** Of the render against its photograph, dB; null where it is not known. */
    readonly psnr: number | null;
}

/** The previews of a task after so many iterations. */
export interface PreviewRound {
    readonly iteration: number;
    /** The mean over its views, dB. */
    readonly psnr: number;
}

/** How a held-out view improves in the training of one task. */
export interface PreviewSeries {
    readonly key: string;
    readonly task: string;
    readonly view: string;
    /** By ascending iteration, at least one. */
    readonly frames: readonly Frame[];
    /** Iterations of the task in all; 0 if they are not known. */
    readonly iterations: number;
}

const measured = (psnr: number | undefined): number | null =>
    psnr !== undefined && Number.isFinite(psnr) ? psnr : null;

/** The rounds of previews of a task whose PSNR is known, by ascending iteration. */
export function roundsOf({ previews }: TaskHistory): readonly PreviewRound[] {
    const rounds = new Map<number, Map<string, number>>();
    for (const { view, iteration, psnrDb } of previews) {
        const psnr = measured(psnrDb);
        if (psnr !== null) {
            // Of an iteration that was trained again the later preview holds.
            rounds.set(iteration, (rounds.get(iteration) ?? new Map<string, number>()).set(view, psnr));
        }
    }
    return [...rounds]
        .toSorted(([a], [b]) => a - b)
        .map(([iteration, views]) => {
            const psnr = [...views.values()].reduce((sum, value) => sum + value, 0) / views.size;
            return { iteration, psnr };
        });
}

/** Tasks with the PSNR of their latest previews. */
export function withPreviews(tasks: readonly TaskInfo[], histories: readonly TaskHistory[]): readonly TaskInfo[] {
    const latest = new Map(histories.map((history) => [history.taskId, roundsOf(history).at(-1)?.psnr ?? null]));
    return tasks.map((task) => ({ ...task, previewPsnr: latest.get(task.task) ?? null }));
}

/** The latest PSNR of a series. */
export const latestPsnr = ({ frames }: PreviewSeries): number | null =>
    frames.findLast(({ psnr }) => psnr !== null)?.psnr ?? null;

/** The series of all tasks, in the order of the tasks and then of the names of the views. */
export function seriesOf(tasks: readonly TaskHistory[]): readonly PreviewSeries[] {
    return tasks.flatMap(({ taskId, points, previews }) => {
        const frames = new Map<string, Frame[]>();
        for (const { view, iteration, render, clear, psnrDb } of previews) {
            if (render !== undefined) {
                const known = frames.get(view) ?? [];
                const psnr = measured(psnrDb);
                known.push({ iteration, render: render.digest, clear: clear?.digest ?? null, psnr });
                frames.set(view, known);
            }
        }
        const iterations = points.at(-1)?.progress?.iterations ?? 0;
        return [...frames.entries()]
            .toSorted(([a], [b]) => a.localeCompare(b, 'en', { numeric: true }))
            .map(([view, ofView]) => ({
                key: `${taskId} ${view}`,
                task: taskId,
                view,
                frames: ofView.toSorted((a, b) => a.iteration - b.iteration),
                iterations,
            }));
    });
}

/** The digests of all pictures. */
export const digestsOf = (tasks: readonly TaskHistory[]): ReadonlySet<string> =>
    new Set(
        tasks
            .flatMap(({ previews }) => previews.flatMap(({ render, clear }) => [render?.digest ?? '', clear?.digest ?? '']))
            .filter((digest) => digest !== ''),
    );

/** The series that is shown until the reader chooses: of a task that runs, otherwise of the last task. */
export function firstSeries(series: readonly PreviewSeries[], running: ReadonlySet<string>): PreviewSeries | null {
    const last = series.at(-1)?.task;
    return series.find(({ task }) => running.has(task)) ?? series.find(({ task }) => task === last) ?? null;
}

/** The frame after this many iterations, or the one before it; null is the newest. */
export function frameAt({ frames }: PreviewSeries, iteration: number | null): Frame {
    const reached = iteration === null ? [] : frames.filter((frame) => frame.iteration <= iteration);
    return iteration === null ? frames.at(-1)! : (reached.at(-1) ?? frames[0]!);
}

/** The newest frame of a job, of the task that comes last. */
export function newestFrame(tasks: readonly TaskHistory[]): Frame | null {
    return seriesOf(tasks).at(-1)?.frames.at(-1) ?? null;
}
