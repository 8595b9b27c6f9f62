// Numbers and times for people.

const UNITS = ['bytes', 'kB', 'MB', 'GB', 'TB', 'PB'] as const;

/** A length, with three digits: "1.23 GB". */
export function bytesText(bytes: number | bigint): string {
    let [value, unit] = [Number(bytes), 0];
    while (value >= 999.5 && unit < UNITS.length - 1) {
        value /= 1000;
        unit += 1;
    }
    if (unit === 0) {
        return value === 1 ? '1 byte' : `${value} bytes`;
    }
    const digits = value < 9.995 ? 2 : value < 99.95 ? 1 : 0;
    return `${value.toFixed(digits)} ${UNITS[unit]}`;
}

/** A duration with its two largest units: "2 h 5 min". */
export function durationText(seconds: number): string {
    if (!Number.isFinite(seconds)) {
        return '';
    }
    const whole = Math.max(0, Math.round(seconds));
    const parts: readonly (readonly [number, string])[] = [
        [Math.floor(whole / 86_400), 'd'],
        [Math.floor(whole / 3600) % 24, 'h'],
        [Math.floor(whole / 60) % 60, 'min'],
        [whole % 60, 's'],
    ];
    const first = parts.findIndex(([count]) => count > 0);
    if (first < 0) {
        return '0 s';
    }
    // From ten minutes on, seconds say nothing.
    const shown = parts.slice(first, first + 2).filter(([count, unit]) => count > 0 && !(unit === 's' && whole >= 600));
    return shown.map(([count, unit]) => `${count} ${unit}`).join(' ');
}

/** How long ago something was. */
export function agoText(thenMs: number, nowMs: number): string {
    const seconds = (nowMs - thenMs) / 1000;
    return seconds < 1 ? 'now' : `${durationText(seconds)} ago`;
}

/** A share of 1 in whole per cent. It is 100 only at the end. */
export const percentText = (share: number): string =>
    `${share >= 1 ? 100 : Math.min(99, Math.max(0, Math.floor(share * 100 + 1e-9)))} %`;

/** A count with separators between thousands. */
export const countText = (count: number | bigint): string => count.toLocaleString('en');

const pad = (value: number): string => String(value).padStart(2, '0');

/** Date and time of day here: "2026-11-27 20:42". */
export function timeText(ms: number): string {
    const at = new Date(ms);
    return `${at.getFullYear()}-${pad(at.getMonth() + 1)}-${pad(at.getDate())} ${pad(at.getHours())}:${pad(at.getMinutes())}`;
}

/** Time of day here, to the second. */
export function clockText(ms: number): string {
    const at = new Date(ms);
    return `${pad(at.getHours())}:${pad(at.getMinutes())}:${pad(at.getSeconds())}`;
}

/** A message of the service as a sentence: it begins with a capital and ends with a full stop. */
export function sentence(text: string): string {
    const trimmed = text.trim();
    // Names in back quotes and paths keep their case.
    const begun = /^[a-z][a-z]*[ ,:]/.test(trimmed) ? trimmed[0]!.toUpperCase() + trimmed.slice(1) : trimmed;
    return begun === '' || /[.!?]$/.test(begun) ? begun : `${begun}.`;
}
