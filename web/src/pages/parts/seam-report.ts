// Whether the borders of partitions show in a model: the keys of metrics.json, and what they say in words.

import { decibels, percent } from './format.ts';

/** The bands along some lines. */
export interface SeamBand {
    /** Views that count. */
    readonly views: number;
    readonly psnr: number | null;
    readonly ssim: number | null;
    readonly flank_psnr: number | null;
    readonly flank_ssim: number | null;
    /** PSNR beside the lines minus that on them; above 0 is a loss. */
    readonly loss_db: number | null;
    readonly loss_db_error: number | null;
    readonly interior_psnr: number | null;
    readonly pixels: number;
}

/** Steps of the surface across some lines, as shares of the depth. */
export interface SeamSteps {
    readonly pairs: number;
    readonly median: number | null;
    readonly beside_median: number | null;
    readonly ratio: number | null;
}

export interface SeamContent {
    /** Scene units, to each side. */
    readonly band: number;
    readonly border: SeamBand;
    readonly control: SeamBand;
    readonly range_step: { readonly border: SeamSteps; readonly control: SeamSteps };
}

/** The keys of metrics.json that are read. */
export interface SeamMetrics {
    /** null for one partition. */
    readonly seams?: SeamContent | null;
    readonly views?: readonly SeamView[];
}

export interface SeamView {
    readonly name: string;
    readonly border_pixels?: number | null;
    readonly border_psnr?: number | null;
    readonly interior_psnr?: number | null;
    readonly control_psnr?: number | null;
}

export interface SeamVerdict {
    /** Whether borders show; null where that cannot be told. */
    readonly shows: boolean | null;
    readonly text: string;
}

/** A difference counts from so many standard errors on. */
const ERRORS = 2;

const lossText = (loss: number): string =>
    `${decibels(Math.abs(loss))} ${loss >= 0 ? 'worse' : 'better'} than right beside them`;

/** Whether borders are worse than the surfaces beside them, by more than the content explains. */
export function seamVerdict({ border, control }: SeamContent): SeamVerdict {
    const loss = border.loss_db;
    if (loss === null) {
        return {
            shows: null,
            text: 'No held-out view shows enough of a border to measure it (seams.least_share).',
        };
    }
    const words = `Along borders the model is ${lossText(loss)}`;
    const other = control.loss_db;
    if (other === null || border.loss_db_error === null || control.loss_db_error === null) {
        const why =
            other === null ? 'nothing to compare that with' : 'too few views to tell that from chance';
        return { shows: null, text: `${words}. There is ${why}.` };
    }
    const error = Math.hypot(border.loss_db_error, control.loss_db_error);
    const shows = loss - other > ERRORS * error;
    const compared = `along lines where nothing was cut it is ${lossText(other)}`;
    return {
        shows,
        text: shows ? `Borders show. ${words}; ${compared}.` : `Borders do not show. ${words}; ${compared}.`,
    };
}

/** The step of the surface across borders, in a sentence; empty where it was not measured. */
export function stepText({ border, control }: SeamContent['range_step']): string {
    if (border.median === null || border.ratio === null) {
        return '';
    }
    const other =
        control.ratio === null ? '' : ` Where nothing was cut it is ${control.ratio.toFixed(2)} times.`;
    const times = `${border.ratio.toFixed(2)} times as much as beside them`;
    return `The surface steps by ${percent(border.median)} of its depth across borders, ${times}.${other}`;
}

const number = (value: number | null, digits: number): string =>
    value === null ? '–' : value.toFixed(digits);
const loss = ({ loss_db, loss_db_error }: SeamBand): string =>
    loss_db === null
        ? '–'
        : `${loss_db.toFixed(2)}${loss_db_error === null ? '' : ` ± ${loss_db_error.toFixed(2)}`}`;
const share = (value: number | null): string => (value === null ? '–' : percent(value));

/** A measure of borders, and the same where nothing was cut. */
export interface SeamRow {
    readonly title: string;
    readonly meaning: string;
    readonly border: string;
    readonly control: string;
}

/** The measures as rows of a table. */
export function seamRows({ border, control, range_step: step }: SeamContent): readonly SeamRow[] {
    const row = (title: string, meaning: string, of: (band: SeamBand) => string): SeamRow => ({
        title,
        meaning,
        border: of(border),
        control: of(control),
    });
    const stepRow = (title: string, meaning: string, of: (steps: SeamSteps) => string): SeamRow => ({
        title,
        meaning,
        border: of(step.border),
        control: of(step.control),
    });
    return [
        row('PSNR on the line, dB', 'Surfaces within the band of a line.', (band) => number(band.psnr, 2)),
        row('PSNR beside it, dB', 'The same content, within three bands.', (band) =>
            number(band.flank_psnr, 2),
        ),
        row(
            'Loss, dB',
            'Beside minus on the line, with its standard error. Above 0 the line is worse.',
            loss,
        ),
        row('SSIM on the line', '', (band) => number(band.ssim, 4)),
        row('SSIM beside it', '', (band) => number(band.flank_ssim, 4)),
        stepRow('Step of the surface', 'Median across the line, as a share of the depth.', ({ median }) =>
            share(median),
        ),
        stepRow('Step beside it', 'The same, two bands from the line.', (steps) =>
            share(steps.beside_median),
        ),
        stepRow('Ratio of the steps', '1: the line makes no step of its own.', ({ ratio }) =>
            number(ratio, 2),
        ),
        row('Views that count', '', ({ views }) => String(views)),
    ];
}
