// The settings of a new job, from what its form says to what the service takes.

import { sentence } from './format.ts';

export type Json = null | boolean | number | string | readonly Json[] | { readonly [key: string]: Json };
type Group = { readonly [key: string]: Json };

export interface JobForm {
    readonly preset: string;
    readonly partitions: 'auto' | 'grid';
    readonly columns: number;
    readonly rows: number;
    readonly iterations: number;
    readonly maxGaussians: number;
    readonly hasPreviews: boolean;
    /** Any other settings, JSON by section. */
    readonly advanced: string;
}

/** A field of the form. */
export type FormField = 'dataset' | 'name' | 'preset' | 'partitions' | 'iterations' | 'maxGaussians' | 'priority' | 'advanced';

/** Something is wrong in a field. */
export class WrongForm extends Error {
    readonly field: FormField;

    constructor(field: FormField, message: string) {
        super(message);
        this.field = field;
    }
}

/** Which field of the form a setting belongs to. */
const FIELDS: Readonly<Record<string, FormField>> = {
    preset: 'preset',
    'partition.auto': 'partitions',
    'partition.columns': 'partitions',
    'partition.rows': 'partitions',
    'train.iterations': 'iterations',
    'train.max_gaussians': 'maxGaussians',
};
/** Fields of the request under other names than those of the form. */
const OF_REQUEST: Readonly<Record<string, FormField>> = { name: 'name', priority: 'priority', dataset_id: 'dataset' };

const isGroup = (value: Json | undefined): value is Group => typeof value === 'object' && value !== null && !Array.isArray(value);

function parsed(text: string): Group {
    if (text.trim() === '') {
        return {};
    }
    let value: Json;
    try {
        value = JSON.parse(text) as Json;
    } catch (error) {
        throw new WrongForm('advanced', `This is not JSON. ${sentence((error as Error).message)}`);
    }
    if (!isGroup(value)) {
        throw new WrongForm('advanced', 'Write an object with sections, such as {"train": {"ssim_weight": 0.3}}.');
    }
    return value;
}

/** The dotted keys of all values. */
function keysOf(group: Group, before = ''): readonly string[] {
    return Object.entries(group).flatMap(([key, value]) =>
        [`${before}${key}`].concat(isGroup(value) ? keysOf(value, `${before}${key}.`) : []),
    );
}

function joined(base: Group, over: Group): Group {
    const all = Object.entries(over).map(([key, value]) => {
        const known = base[key];
        return [key, isGroup(known) && isGroup(value) ? joined(known, value) : value] as const;
    });
    return { ...base, ...Object.fromEntries(all) };
}

/** The settings as JSON. Throws `WrongForm`. */
export function configOf(form: JobForm): string {
    const advanced = parsed(form.advanced);
    const isAuto = form.partitions === 'auto';
    const ofForm: Group = {
        preset: form.preset,
        partition: isAuto ? { auto: true } : { auto: false, columns: form.columns, rows: form.rows },
        train: {
            iterations: form.iterations,
            max_gaussians: form.maxGaussians,
            ...(form.hasPreviews ? {} : { preview_seconds: 0 }),
        },
    };
    // A value in two places would hide one of them.
    const taken = new Set([...Object.keys(FIELDS), ...(form.hasPreviews ? [] : ['train.preview_seconds'])]);
    const twice = keysOf(advanced).find((key) => taken.has(key));
    if (twice !== undefined) {
        throw new WrongForm('advanced', `${twice} has a field above. Set it there, and leave it out here.`);
    }
    return JSON.stringify(joined(ofForm, advanced));
}

/** The field of the form that a refusal of the service is about, and what to say there. */
export function wrongField(field: string, message: string, advanced: string): { readonly field: FormField; readonly message: string } {
    const known = OF_REQUEST[field];
    if (known !== undefined) {
        return { field: known, message: sentence(`${known} ${message}`.replace(/^\w/, (letter) => letter.toUpperCase())) };
    }
    const text = message.replace(/^configuration: /, '');
    // "train.iterations must be at least 1"
    const setting = /^[a-z_]+(?:\.[a-z_]+)*/.exec(text)?.[0] ?? '';
    const ofForm = FIELDS[setting];
    if (ofForm !== undefined) {
        return { field: ofForm, message: sentence(text) };
    }
    // "unknown field `iterationz`, expected one of ...": where it is.
    const unknown = /^unknown (?:field|variant) `([^`]+)`/.exec(text)?.[1] ?? '';
    let place: string | undefined;
    try {
        place = keysOf(parsed(advanced)).find((key) => key === unknown || key.endsWith(`.${unknown}`));
    } catch {
        // It was read before.
    }
    return { field: 'advanced', message: place === undefined || place === unknown ? sentence(text) : `${place}: ${text}` };
}

/** A random UUID. `crypto.randomUUID` exists over HTTPS and on this machine only. */
export function freshUuid(): string {
    const bytes = crypto.getRandomValues(new Uint8Array(16));
    bytes[6] = (bytes[6]! & 0x0f) | 0x40;
    bytes[8] = (bytes[8]! & 0x3f) | 0x80;
    const hex = [...bytes].map((byte) => byte.toString(16).padStart(2, '0')).join('');
    return [hex.slice(0, 8), hex.slice(8, 12), hex.slice(12, 16), hex.slice(16, 20), hex.slice(20)].join('-');
}
