// What the service keeps of the training of each task: points of curves, and previews.

import type { History } from '../../rpc/fathom/v1/job_pb.ts';
import { type Fault, faultOf } from '../faults.ts';
import { type Polling, poll } from '../poll.ts';
import { hasEnded } from '../words.ts';
import type { JobContext } from './section.ts';

/** Workers report every few seconds. */
const EVERY_MS = 5000;
const SELDOM_MS = 60_000;
/** The history of a job with many tasks has megabytes: each point makes the pause so much longer. */
const MS_PER_POINT = 0.5;

/** How long to wait before the history of a job is asked for again, `leastMs` at least. */
export function pauseAfter({ tasks }: Pick<History, 'tasks'>, leastMs: number): number {
    const points = tasks.reduce((sum, task) => sum + task.points.length, 0);
    return Math.min(SELDOM_MS, leastMs + MS_PER_POINT * points);
}

/** Asks for the history of a job again and again, every `leastMs` at most, until the section is left. */
export function followHistory(
    context: JobContext,
    onHistory: (history: History) => void,
    onFault: (fault: Fault) => void,
    leastMs = EVERY_MS,
): Polling {
    const { id, session, signal } = context;
    let pauseMs = leastMs;
    const every = (): number => (hasEnded(context.job.state) ? SELDOM_MS : pauseMs);
    return poll(every, signal, async () => {
        try {
            const history = await session.api.jobs.getHistory({ jobId: id }, { signal });
            pauseMs = pauseAfter(history, leastMs);
            onHistory(history);
        } catch (error) {
            onFault(faultOf(error));
        }
    });
}
