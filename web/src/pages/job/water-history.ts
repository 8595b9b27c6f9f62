// The water of each task while it trains, from the history of the job.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import type {
    Rgb,
    RgbErrors,
    Task,
    TaskHistory,
    WaterErrors as ReportedErrors,
} from '../../rpc/fathom/v1/job_pb.ts';
import type { WaterPoint, WaterSeries } from '../parts/water-points.ts';
import type { MaybeVec3, WaterErrors } from '../parts/water-values.ts';
import { stageWord, taskLabel } from '../words.ts';

type Three = readonly [number, number, number];

const three = (rgb: Rgb | undefined): Three | null => {
    const values: Three | null = rgb === undefined ? null : [rgb.red, rgb.green, rgb.blue];
    return values !== null && values.every(Number.isFinite) ? values : null;
};

const errorOf = (error: number | undefined): number | null =>
    error !== undefined && Number.isFinite(error) && error >= 0 ? error : null;
const threeErrors = (rgb: RgbErrors | undefined): MaybeVec3 | null =>
    rgb === undefined ? null : [errorOf(rgb.red), errorOf(rgb.green), errorOf(rgb.blue)];

const errorsOf = ({ betaD, betaB, bInf }: ReportedErrors): WaterErrors => ({
    beta_d: threeErrors(betaD),
    beta_b: threeErrors(betaB),
    b_inf: threeErrors(bInf),
});

function pointsOf({ points }: TaskHistory): readonly WaterPoint[] {
    return points.flatMap(({ progress, attempt, time }) => {
        const [beta_d, beta_b, b_inf] = [
            three(progress?.water?.betaD),
            three(progress?.water?.betaB),
            three(progress?.water?.bInf),
        ];
        if (
            progress === undefined ||
            time === undefined ||
            beta_d === null ||
            beta_b === null ||
            b_inf === null
        ) {
            return [];
        }
        const point = {
            timeMs: timestampMs(time),
            attempt,
            iteration: progress.iteration,
            beta_d,
            beta_b,
            b_inf,
        };
        const reported = progress.water?.standardError;
        return [reported === undefined ? point : { ...point, standard_error: errorsOf(reported) }];
    });
}

/** The tasks that report a water, in the order of the job. */
export function waterSeriesOf(
    tasks: readonly Task[],
    histories: readonly TaskHistory[],
): readonly WaterSeries[] {
    const known = new Map(histories.map((history) => [history.taskId, pointsOf(history)]));
    return tasks.flatMap(({ taskId: task, stage }) => {
        const points = known.get(task) ?? [];
        return points.length === 0 ? [] : [{ task, label: taskLabel(task), stage: stageWord(stage), points }];
    });
}

/** Whether the settings of a job say that there is no water. */
export function isInAir(configJson: string): boolean {
    try {
        const config = JSON.parse(configJson) as { readonly water?: { readonly medium?: unknown } } | null;
        return config?.water?.medium === 'none';
    } catch {
        return false;
    }
}
