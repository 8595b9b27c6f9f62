// Numbers and times as text.

const GROUPED = new Intl.NumberFormat('en-GB', { maximumFractionDigits: 0 });
/** Lengths of time between marks of an axis, seconds. */
const STEPS_S = [
    1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10_800, 21_600, 43_200, 86_400, 172_800, 604_800,
];

/** 12345 as "12,345". */
export const grouped = (value: number): string => GROUPED.format(value);

/** "1 camera", "2 cameras". */
export const counted = (count: number, one: string, many = `${one}s`): string =>
    `${grouped(count)} ${count === 1 ? one : many}`;

/** About `digits` digits, without an exponent unless the number is tiny or huge. */
export function brief(value: number, digits = 3): string {
    if (!Number.isFinite(value)) {
        return 'not known';
    }
    const size = Math.abs(value);
    if (size === 0) {
        return '0';
    }
    if (size >= 1e9 || size < 1e-4) {
        return value.toExponential(digits - 1).replace('e+', 'e');
    }
    if (size >= 10 ** digits) {
        return grouped(value);
    }
    return value.toPrecision(digits);
}

/** "850 ms", "42 s", "3 min 20 s", "2 h 5 min", "3 d 4 h". */
export function duration(ms: number): string {
    const seconds = Math.max(0, Math.round(ms / 1000));
    if (ms > 0 && ms < 1000) {
        return `${Math.round(ms)} ms`;
    }
    const units: [string, number][] = [
        ['d', 86_400],
        ['h', 3600],
        ['min', 60],
        ['s', 1],
    ];
    const first = units.findIndex(([, size]) => seconds >= size);
    if (first < 0) {
        return '0 s';
    }
    const [name, size] = units[first]!;
    const next = units[first + 1];
    const rest = next === undefined ? 0 : Math.floor((seconds % size) / next[1]);
    return `${Math.floor(seconds / size)} ${name}${rest > 0 && next ? ` ${rest} ${next[0]}` : ''}`;
}

/** Local date and time; the date only where it differs from that of `besideMs`. */
export function clock(ms: number, besideMs?: number): string {
    const date = new Date(ms);
    const time = date.toLocaleTimeString('en-GB');
    const isSameDay = besideMs !== undefined && new Date(besideMs).toDateString() === date.toDateString();
    return isSameDay
        ? time
        : `${date.toLocaleDateString('en-GB', { day: 'numeric', month: 'short', year: 'numeric' })}, ${time}`;
}

/** "512 MiB", "3.4 GiB". */
export function memory(bytes: number): string {
    const units = ['B', 'KiB', 'MiB', 'GiB', 'TiB'];
    let [value, unit] = [bytes, 0];
    while (value >= 1024 && unit < units.length - 1) {
        value /= 1024;
        unit += 1;
    }
    return `${value >= 100 || unit === 0 ? Math.round(value) : value.toPrecision(3)} ${units[unit]}`;
}

/** A share, 0 to 1, in percent; tiny shares as "below 0.1 %". */
export function percent(share: number): string {
    if (share > 0 && share < 0.001) {
        return 'below 0.1 %';
    }
    return `${share < 0.0995 && share > 0 ? (100 * share).toFixed(1) : Math.round(100 * share)} %`;
}

/** "24.31 dB". */
export const decibels = (value: number | null): string =>
    value === null || !Number.isFinite(value) ? 'not measured' : `${value.toFixed(2)} dB`;

/** The step between marks, so that at most `most` of them lie in a length of time; milliseconds. */
export function timeStep(lengthMs: number, most: number): number {
    const least = lengthMs / 1000 / Math.max(1, most);
    return 1000 * (STEPS_S.find((step) => step >= least) ?? Math.ceil(least / 604_800) * 604_800);
}

/** The largest of 1, 2 and 5 times a power of ten that is at most `longest`. */
export function roundLength(longest: number): number {
    const power = 10 ** Math.floor(Math.log10(Math.max(longest, 1e-12)));
    return [5 * power, 2 * power, power].find((length) => length <= longest) ?? power;
}
