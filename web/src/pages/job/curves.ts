// The curves of a job: what the service kept of each task, and what has arrived since.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import { h } from '../dom.ts';
import type { CurvePoint, CurveSeries } from '../parts/curve-points.ts';
import { curves } from '../parts/curves.ts';
import { taskLabel } from '../words.ts';
import { followHistory } from './history.ts';
import { type PreviewRound, roundsOf } from './preview-series.ts';
import { mergedPoints, pointOf } from './record.ts';
import type { JobContext, Section } from './section.ts';

const DRAW_EVERY_MS = 1000;

export function open(container: HTMLElement, context: JobContext): Section {
    const { record, signal } = context;
    const note = h('p', { class: 'alert', role: 'status', hidden: true });
    const host = h('div', { class: 'card' });
    container.append(note, host);
    const view = curves(host);
    let kept = new Map<string, readonly CurvePoint[]>();
    let previews = new Map<string, readonly PreviewRound[]>();
    let timer = 0;

    function draw(): void {
        timer = 0;
        if (signal.aborted) {
            return;
        }
        const series: CurveSeries[] = [];
        for (const { taskId } of context.job.tasks) {
            const points = mergedPoints(kept.get(taskId) ?? [], record.points.get(taskId) ?? []);
            if (points.length > 0) {
                series.push({ task: taskId, label: taskLabel(taskId), points, previews: previews.get(taskId) ?? [] });
            }
        }
        view.update({ series });
    }

    const polling = followHistory(
        context,
        ({ tasks }) => {
            kept = new Map(
                tasks.map(({ taskId, points }) => [
                    taskId,
                    points.flatMap(({ progress, attempt, time }) =>
                        progress === undefined || time === undefined ? [] : [pointOf(progress, attempt, timestampMs(time))],
                    ),
                ]),
            );
            previews = new Map(tasks.map((task) => [task.taskId, roundsOf(task)]));
            note.hidden = true;
            draw();
        },
        (fault) => {
            if (fault.kind === 'refused' || fault.kind === 'unknown call') {
                note.textContent = `Earlier points are missing. ${fault.message}`;
                note.hidden = false;
            }
        },
    );
    let { state } = context.job;
    return {
        update: () => {
            if (context.job.state !== state) {
                ({ state } = context.job);
                polling.now();
            }
            timer ||= window.setTimeout(draw, DRAW_EVERY_MS);
        },
        destroy: () => {
            clearTimeout(timer);
            view.destroy();
        },
    };
}
