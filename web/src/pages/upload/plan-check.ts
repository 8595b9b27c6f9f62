// What the service reads in a dataset, and how it would plan a job, before there is one.

import type { Inspection } from '../../rpc/fathom/v1/upload_pb.ts';
import { pause } from '../api.ts';
import { Backoff } from '../connection.ts';
import type { Context } from '../context.ts';
import { h } from '../dom.ts';
import { type Fault, faultOf } from '../faults.ts';
import { countText, sentence } from '../format.ts';
import { Addresses } from '../job/addresses.ts';
import { digestsOf } from '../job/photographs.ts';
import type { ManifestContent, PlanContent } from '../parts/plan-layout.ts';
import { planMap } from '../parts/plan-map.ts';

/** Reading thousands of photographs takes a while. */
const WITHIN = { timeoutMs: 900_000 } as const;
const TYPES: Readonly<Record<string, string>> = { png: 'image/png', jpg: 'image/jpeg', jpeg: 'image/jpeg' };
/** What to do about a refusal. */
const REMEDIES: Readonly<Record<string, string>> = {
    BAD_SCENE:
        'Correct the folder and choose it again: only what changed is sent. If it is not the folder of the ' +
        'scene, choose the one that holds the photographs and the model. What was uploaded stays until you ' +
        'delete it under "Datasets".',
    DATASET_NOT_FOUND: 'It was deleted meanwhile. Choose another one.',
    DATASET_NOT_COMMITTED: 'Its upload is not complete. Choose its folder again to go on.',
};

/** What was inspected: a dataset, with settings. */
export interface Subject {
    readonly datasetId: string;
    readonly configJson: string;
}

export interface CheckOptions {
    /** What the form says now; null if that cannot be checked. With `isLoud` the form shows why. */
    readonly subject: (isLoud: boolean) => Subject | null;
    /** Shows a refusal at the fields of the form, and says whether it belongs there. */
    readonly refused: (fault: Fault) => boolean;
}

const same = (a: Subject, b: Subject): boolean =>
    a.datasetId === b.datasetId && a.configJson === b.configJson;

const percentOf = (share: number): string => `${(100 * share).toFixed(share > 0 && share < 0.1 ? 1 : 0)} %`;

/** The facts of an inspection, by name. */
export function factsOf(found: Inspection): readonly (readonly [name: string, value: string])[] {
    const { views, masks, unseen } = found;
    return [
        ['Format', found.source],
        ['Views', `${countText(views)}, each with a photograph`],
        ['Held out', found.heldOut === 0 ? 'none' : countText(found.heldOut)],
        [
            'Masks',
            masks === 0
                ? 'none'
                : masks === views
                  ? 'for each photograph'
                  : `for ${countText(masks)} of ${countText(views)}`,
        ],
        ['Cameras', countText(found.cameras)],
        ['Sparse points', countText(found.points)],
        ['Partitions', countText(found.partitions)],
        ...(unseen === undefined
            ? []
            : [
                  [
                      'Seen by fewer than two views',
                      `${percentOf(unseen)} of what the held-out views show`,
                  ] as const,
              ]),
    ];
}

export class PlanCheck {
    readonly element = h('section', { class: 'plan-check', 'aria-label': 'Check', hidden: true });
    readonly #context: Context;
    readonly #options: CheckOptions;
    readonly #status = h('p', { class: 'soft', role: 'status' });
    readonly #alert = h('p', { class: 'alert bad', role: 'alert', hidden: true });
    readonly #stale = h(
        'p',
        { class: 'alert warn', hidden: true },
        'The settings have changed since this check.',
    );
    readonly #again = h(
        'button',
        { type: 'button', hidden: true, onclick: () => void this.run() },
        'Check again',
    );
    readonly #result = h('div', { class: 'plan-check-result', hidden: true });
    #run: AbortController | null = null;
    #clean: () => void = () => {};
    #found: { readonly subject: Subject; readonly inspection: Inspection } | null = null;
    /** Of the check that failed. */
    #failed: Subject | null = null;

    constructor(context: Context, options: CheckOptions) {
        this.#context = context;
        this.#options = options;
        const buttons = h('div', { class: 'row' }, this.#again);
        this.element.append(this.#status, this.#alert, this.#result, this.#stale, buttons);
        context.signal.addEventListener('abort', () => this.clear(), { once: true });
    }

    /** What was found with exactly this dataset and these settings. */
    of(subject: Subject): Inspection | null {
        return this.#found !== null && same(this.#found.subject, subject) ? this.#found.inspection : null;
    }

    /** Forgets everything, as for another dataset. */
    clear(): void {
        this.#run?.abort();
        this.#run = null;
        this.#found = null;
        this.#failed = null;
        this.#clean();
        this.#clean = () => {};
        this.#result.hidden = true;
        this.#show('', '');
        this.element.hidden = true;
    }

    /** Compares what was checked with what the form says now. */
    compare(): void {
        const subject = this.#options.subject(false);
        const checked = this.#found?.subject ?? this.#failed;
        if (checked === null || this.#run !== null) {
            return;
        }
        const isStale = subject === null || !same(checked, subject);
        this.#stale.hidden = !isStale || this.#found === null;
        this.#again.hidden = !isStale && this.#found !== null;
    }

    async run(): Promise<void> {
        const subject = this.#options.subject(true);
        this.element.hidden = false;
        if (subject === null) {
            this.#show('', 'Correct the settings, then check again.');
            this.#again.hidden = false;
            return;
        }
        this.#run?.abort();
        const run = new AbortController();
        this.#run = run;
        const signal = AbortSignal.any([run.signal, this.#context.signal]);
        // The button that was pressed goes away.
        const hadFocus = this.#again === document.activeElement;
        this.#show('Reading the scene and planning its partitions …', '');
        if (hadFocus) {
            this.#status.tabIndex = -1;
            this.#status.focus();
        }
        try {
            const inspection = await this.#inspect(subject, signal);
            signal.throwIfAborted();
            this.#found = { subject, inspection };
            this.#failed = null;
            this.#fill(inspection, signal);
            this.#show(
                `This scene can be trained on${inspection.warnings.length === 0 ? '.' : ', with warnings.'}`,
                '',
            );
        } catch (error) {
            if (signal.aborted) {
                return;
            }
            this.#fail(subject, faultOf(error));
        } finally {
            if (this.#run === run) {
                this.#run = null;
            }
        }
        this.compare();
    }

    /** Repeats the call while the service does not answer. */
    async #inspect(subject: Subject, signal: AbortSignal): Promise<Inspection> {
        const backoff = new Backoff();
        for (;;) {
            try {
                return await this.#context.session.api.uploads.inspectDataset(subject, { signal, ...WITHIN });
            } catch (error) {
                if (faultOf(error).kind !== 'lost') {
                    throw error;
                }
                this.#status.textContent = 'The service does not answer; trying again …';
                await pause(backoff.next(), signal);
            }
        }
    }

    #fail(subject: Subject, fault: Fault): void {
        this.#found = null;
        this.#failed = subject;
        this.#result.hidden = true;
        const isShown = fault.reason === 'BAD_ARGUMENT' && this.#options.refused(fault);
        const remedy = REMEDIES[fault.reason];
        const text = isShown
            ? 'The service refuses these settings. Correct them, then check again.'
            : fault.message;
        this.#show('', remedy === undefined ? text : `${text}\n${remedy}`);
        this.#again.hidden = false;
    }

    #show(status: string, alert: string): void {
        this.#status.textContent = status;
        this.#status.hidden = status === '';
        this.#alert.textContent = alert;
        this.#alert.hidden = alert === '';
        this.#stale.hidden = true;
        this.#again.hidden = true;
    }

    #fill(found: Inspection, signal: AbortSignal): void {
        const facts = factsOf(found).flatMap(([name, value]) => [h('dt', {}, name), h('dd', {}, value)]);
        const warnings = h(
            'ul',
            { class: 'plan-check-warnings', 'aria-label': 'Warnings' },
            ...found.warnings.map((text) => h('li', {}, sentence(text))),
        );
        warnings.hidden = found.warnings.length === 0;
        const host = h('div', {}, h('p', { class: 'soft' }, 'Loading the plan …'));
        this.#clean();
        this.#clean = () => {};
        this.#result.replaceChildren(h('dl', { class: 'plan-check-facts' }, ...facts), warnings, host);
        this.#result.hidden = false;
        void this.#draw(found, host, signal);
    }

    async #draw({ plan, manifest }: Inspection, host: HTMLElement, signal: AbortSignal): Promise<void> {
        const { api } = this.#context.session;
        try {
            const [planned, described] = await Promise.all([
                api.json(plan?.digest ?? '', '', signal),
                // Without the cameras the map shows the partitions.
                api.json(manifest?.digest ?? '', '', signal).catch(() => null),
            ]);
            signal.throwIfAborted();
            const digests = digestsOf(described);
            const addresses = new Addresses();
            host.replaceChildren();
            const map = planMap(host, {
                onPhotograph: async (name) => {
                    const digest = digests.get(name);
                    if (digest === undefined) {
                        throw new Error(`${name} is not among the photographs of the dataset.`);
                    }
                    const type =
                        TYPES[name.split('.').at(-1)?.toLowerCase() ?? ''] ?? 'application/octet-stream';
                    return addresses.of(await api.blob(digest, '', this.#context.signal, type));
                },
            });
            this.#clean = () => {
                map.destroy();
                addresses.revoke();
            };
            map.update({
                plan: planned as PlanContent,
                cameras: described as ManifestContent | null,
                tasks: [],
            });
        } catch (error) {
            if (!signal.aborted) {
                host.replaceChildren(
                    h('p', { class: 'soft' }, `The plan cannot be shown. ${faultOf(error).message}`),
                );
            }
        }
    }
}
