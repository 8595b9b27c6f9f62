// A folder of this computer that becomes a dataset: choose, hash, upload.

import type { Dataset } from '../../rpc/fathom/v1/upload_pb.ts';
import type { Context } from '../context.ts';
import { listDatasets } from '../dataset-list.ts';
import { freshId, h, progressBar, setText } from '../dom.ts';
import { type Fault, faultOf, wrongFieldsOf } from '../faults.ts';
import { FormRow } from '../form-field.ts';
import { bytesText, countText, durationText } from '../format.ts';
import { freshUuid } from '../job-settings.ts';
import { digestOfBytes } from './digest.ts';
import {
    type Derived,
    type Folder,
    type FolderFile,
    bytesOf,
    faultsOf,
    freeId,
    idOfName,
    isId,
    readFolder,
} from './folder.ts';
import { type Chosen, entriesOf, filesOfEntries, filesOfInput } from './gather.ts';
import { hashFiles } from './hash.ts';
import { type HashedFile, type SendProgress, Speed, listText, sendDataset } from './send.ts';

const DRAW_EVERY_MS = 200;
/** Faults of single files that are shown. */
const MOST_FAULTS = 10;
const REFUSALS: Readonly<Record<string, string>> = {
    DATASET_EXISTS: 'There is a dataset of this name with other files. Choose another name.',
    LOW_DISK_SPACE: 'Ask an operator of the service for room. Upload again to go on.',
    QUOTA_SPENT: 'Delete datasets or jobs that are not needed any more. Upload again to go on.',
};
const LOST = 'The service does not answer. What has arrived stays: upload again to go on.';
const WAITING: Readonly<Record<SendProgress['waiting'], string>> = {
    '': '',
    lost: 'The service does not answer; trying again. What has arrived stays.',
    offline: 'This computer is offline. The upload goes on by itself when it is back.',
};

export interface FolderPanelOptions {
    /** Another folder was chosen. */
    readonly onChosen: () => void;
    /** The folder is a dataset now. */
    readonly onCommitted: () => void;
}

const filesText = (files: readonly FolderFile[]): string =>
    `${files.length === 1 ? '1 file' : `${countText(files.length)} files`}, ${bytesText(bytesOf(files))}`;

const hasFiles = ({ dataTransfer }: DragEvent): boolean => dataTransfer?.types.includes('Files') === true;

/** How far something is, how fast it goes, and how long it takes. */
export function progressText(doing: string, bytes: number, total: number, bytesPerSecond: number): string {
    const parts = [`${doing}: ${bytesText(bytes)} of ${bytesText(total)}`];
    if (bytesPerSecond > 0) {
        parts.push(
            `${bytesText(Math.round(bytesPerSecond))} a second`,
            `${durationText((total - bytes) / bytesPerSecond) || '0 s'} left`,
        );
    }
    return parts.join(', ');
}

export class FolderPanel {
    readonly element: HTMLElement;
    /** The dataset that the folder has become. */
    dataset: Dataset | null = null;
    /** How long that took. */
    seconds = 0;
    readonly #context: Context;
    readonly #options: FolderPanelOptions;
    readonly #zone: HTMLElement;
    readonly #input = h('input', {
        type: 'file',
        webkitdirectory: true,
        multiple: true,
        hidden: true,
        'aria-label': 'Folder',
    });
    readonly #choose = h('button', { type: 'button', onclick: () => this.#input.click() }, 'Choose a folder');
    readonly #listing = h('p', { class: 'soft', role: 'status' });
    readonly #alert = h('div', { class: 'alert bad', role: 'alert', hidden: true });
    readonly #chosen: HTMLElement;
    readonly #title = h('p', { class: 'folder-title' });
    readonly #junk = h('p', { class: 'soft' });
    readonly #derived = h('fieldset', { class: 'folder-derived', hidden: true });
    readonly #id: FormRow;
    readonly #start = h(
        'button',
        { type: 'button', class: 'primary', onclick: () => void this.#upload() },
        'Upload and check',
    );
    readonly #cancel = h('button', { type: 'button', onclick: () => this.#run?.abort() }, 'Cancel');
    readonly #bar = progressBar('Upload');
    readonly #said = h('p', { class: 'soft' });
    /** For screen readers: only what is new, and not every number. */
    readonly #spoken = h('p', { class: 'unseen', role: 'status' });
    readonly #progress: HTMLElement;
    #name = '';
    #folder: Folder = { files: [], derived: [], junk: 0 };
    #wanted = new Set<Derived>();
    #isIdEdited = false;
    #known = new Map<Blob, string>();
    /** The same content under the same id is the same attempt. */
    #attempt = { key: '', requestId: '' };
    #run: AbortController | null = null;
    #timer = 0;
    #newest: (() => void) | null = null;

    constructor(context: Context, options: FolderPanelOptions) {
        this.#context = context;
        this.#options = options;
        const { signal } = context;
        const id = h('input', { type: 'text', maxlength: 64, autocomplete: 'off', spellcheck: 'false' });
        this.#id = new FormRow(
            'Upload as',
            id,
            'The name of the dataset: lower-case letters, digits, "-", "_", "."; first a letter or a digit.',
        );
        id.addEventListener('input', () => (this.#isIdEdited = true));
        id.addEventListener('keydown', (event) => {
            // The form around this creates the job.
            if (event.key === 'Enter') {
                event.preventDefault();
                void this.#upload();
            }
        });
        this.#zone = h(
            'div',
            { class: 'drop-zone' },
            h('p', {}, 'Drop the folder of a scene here, or'),
            this.#choose,
            h(
                'p',
                { class: 'soft' },
                'Photographs, with camera poses and sparse points of COLMAP or nerfstudio.',
            ),
            this.#input,
        );
        this.#progress = h(
            'div',
            { class: 'folder-progress', hidden: true },
            h('div', { class: 'row nowrap' }, this.#bar.element, this.#cancel),
            this.#said,
        );
        this.#chosen = h(
            'div',
            { class: 'folder-chosen', hidden: true },
            h('div', {}, this.#title, this.#junk),
            this.#derived,
            this.#id.element,
            this.#progress,
        );
        const buttons = h('div', { class: 'row' }, this.#start);
        this.#start.hidden = true;
        this.element = h(
            'div',
            { class: 'folder' },
            this.#zone,
            this.#listing,
            this.#chosen,
            this.#alert,
            buttons,
            this.#spoken,
        );
        this.#input.addEventListener('change', () => {
            const chosen = filesOfInput(this.#input.files ?? []);
            // The same folder can be chosen again.
            this.#input.value = '';
            if (chosen.found.length > 0) {
                void this.#take(Promise.resolve(chosen));
            }
        });
        this.#watchDrops(signal);
        window.addEventListener('beforeunload', (event) => this.isBusy && event.preventDefault(), { signal });
        signal.addEventListener('abort', () => {
            if (this.isBusy) {
                this.#run?.abort();
                context.say('The upload has stopped. Choose the same folder again to go on.');
            }
        });
    }

    get isBusy(): boolean {
        return this.#run !== null;
    }

    get hasFolder(): boolean {
        return !this.#chosen.hidden;
    }

    /** Leads to what is to do next. */
    focus(): void {
        const next = this.isBusy ? this.#cancel : this.hasFolder ? this.#start : this.#choose;
        next.focus();
    }

    /** The whole page takes drops: beside the zone, a browser would open the file instead. */
    #watchDrops(signal: AbortSignal): void {
        const over = (event: DragEvent): void => {
            if (hasFiles(event)) {
                event.preventDefault();
                event.dataTransfer!.dropEffect = this.isBusy ? 'none' : 'copy';
                this.#zone.classList.toggle('over', !this.isBusy);
            }
        };
        document.addEventListener('dragenter', over, { signal });
        document.addEventListener('dragover', over, { signal });
        document.addEventListener(
            'dragleave',
            (event) => event.relatedTarget === null && this.#zone.classList.remove('over'),
            { signal },
        );
        document.addEventListener(
            'drop',
            (event) => {
                if (!hasFiles(event)) {
                    return;
                }
                event.preventDefault();
                this.#zone.classList.remove('over');
                const entries = entriesOf(event.dataTransfer!.items);
                if (this.isBusy) {
                    this.#context.say('An upload is under way. Cancel it to choose another folder.');
                } else if (entries.every(({ isDirectory }) => !isDirectory)) {
                    this.#refuse(
                        'These are files. Drop the folder that holds the scene; unpack an archive first.',
                    );
                } else {
                    void this.#take(
                        filesOfEntries(entries, (count) =>
                            setText(this.#listing, `${countText(count)} files …`),
                        ),
                    );
                }
            },
            { signal },
        );
    }

    async #take(choosing: Promise<Chosen>): Promise<void> {
        this.dataset = null;
        this.#refuse('');
        this.#chosen.hidden = true;
        this.#start.hidden = true;
        this.#listing.textContent = 'Looking at the folder …';
        this.#options.onChosen();
        try {
            const { name, found } = await choosing;
            this.#folder = await readFolder(found);
            this.#name = name;
            this.#known = new Map();
            this.#wanted = new Set();
            this.#isIdEdited = false;
            this.#show();
        } catch (error) {
            this.#refuse(`The folder cannot be read. ${faultOf(error).message}`);
        }
        this.#listing.textContent = '';
    }

    get #files(): readonly FolderFile[] {
        return [...this.#folder.files, ...[...this.#wanted].flatMap(({ files }) => files)];
    }

    #show(): void {
        const { derived, junk, files } = this.#folder;
        if (files.length === 0) {
            this.#refuse('This folder has no files that could be a scene. Choose another one.');
            return;
        }
        this.#chosen.hidden = false;
        this.#start.hidden = false;
        this.#progress.hidden = true;
        this.#junk.textContent =
            junk === 0
                ? ''
                : junk === 1
                  ? '1 hidden or system file is left out.'
                  : `${countText(junk)} hidden and system files are left out.`;
        this.#junk.hidden = junk === 0;
        const checks = derived.map((one) => {
            const box = h('input', { type: 'checkbox', id: freshId() });
            box.addEventListener('change', () => {
                this.#wanted[box.checked ? 'add' : 'delete'](one);
                this.#showSize();
            });
            return h(
                'div',
                { class: 'check' },
                box,
                h('label', { for: box.id }, `${one.label} (${filesText(one.files)})`),
            );
        });
        this.#derived.replaceChildren(
            h('legend', {}, 'Left out: Fathom does not read these. Tick what should be sent all the same.'),
            ...checks,
        );
        this.#derived.hidden = derived.length === 0;
        this.#id.control.value = idOfName(this.#name);
        this.#id.say('');
        this.#setBusy(false);
        this.#showSize();
        this.#tell(`${this.#title.textContent}. ${this.#junk.textContent}`);
    }

    #showSize(): void {
        setText(
            this.#title,
            `${this.#name === '' ? 'What you dropped' : this.#name}: ${filesText(this.#files)}`,
        );
        const faults = faultsOf(this.#files);
        const more =
            faults.length > MOST_FAULTS ? [`And ${countText(faults.length - MOST_FAULTS)} more.`] : [];
        this.#refuse([...faults.slice(0, MOST_FAULTS), ...more].join('\n'));
        this.#start.disabled = faults.length > 0;
    }

    #refuse(text: string): void {
        this.#alert.textContent = text;
        this.#alert.hidden = text === '';
    }

    #setBusy(isBusy: boolean): void {
        const isDone = this.dataset !== null;
        for (const control of [this.#choose, this.#id.control, ...this.#derived.querySelectorAll('input')]) {
            control.disabled = isBusy || (isDone && control !== this.#choose);
        }
        this.#start.disabled = isBusy;
        this.#start.hidden = isDone;
        this.#cancel.hidden = !isBusy;
        this.#progress.hidden = !isBusy && !isDone;
        this.#progress.classList.toggle('moving', isBusy);
        setText(this.#choose, this.hasFolder ? 'Choose another folder' : 'Choose a folder');
    }

    async #upload(): Promise<void> {
        if (this.isBusy || this.#start.disabled) {
            return;
        }
        if (!isId(this.#id.value)) {
            this.#id.say(
                'A name has 1 to 64 lower-case letters, digits, "-", "_" and ".", a letter or a digit first.',
            );
            this.#id.control.focus();
            return;
        }
        const run = new AbortController();
        this.#run = run;
        const signal = AbortSignal.any([run.signal, this.#context.signal]);
        this.#refuse('');
        this.#id.say('');
        const hadFocus = this.element.contains(document.activeElement);
        this.#setBusy(true);
        if (hadFocus) {
            this.#cancel.focus();
        }
        const begunMs = performance.now();
        let fault: Fault | null = null;
        try {
            const files = await this.#hash(signal);
            const datasetId = await this.#chooseId(files, signal);
            this.dataset = await this.#send(datasetId, files, signal);
            this.seconds = (performance.now() - begunMs) / 1000;
        } catch (error) {
            fault = faultOf(error);
        }
        const { activeElement } = document;
        const isFocusLost = activeElement === this.#cancel || activeElement === document.body;
        clearTimeout(this.#timer);
        [this.#timer, this.#newest, this.#run] = [0, null, null];
        if (this.#context.signal.aborted) {
            return;
        }
        this.#setBusy(false);
        if (this.dataset !== null) {
            this.#bar.set(1, 'complete');
            this.#said.textContent = `Uploaded as "${this.dataset.datasetId}".`;
            this.#tell('The upload is complete.');
            this.#options.onCommitted();
        } else if (run.signal.aborted) {
            this.#refuse('Cancelled. What has arrived stays: upload again to go on.');
        } else if (fault !== null) {
            this.#fail(fault);
        }
        if (isFocusLost) {
            (this.dataset === null ? this.#start : this.#choose).focus();
        }
    }

    #fail(fault: Fault): void {
        const fields = fault.reason === 'BAD_ARGUMENT' ? wrongFieldsOf(fault) : [];
        const ofId = fields.find(({ field }) => field === 'dataset_id');
        const remedy = REFUSALS[fault.reason];
        if (fault.reason === 'DATASET_EXISTS' || ofId !== undefined) {
            this.#id.say(ofId === undefined ? remedy! : `The name ${ofId.message}`);
            this.#id.control.focus();
        } else if (fault.kind === 'lost') {
            this.#refuse(LOST);
        } else {
            const more = fields.slice(0, MOST_FAULTS).map(({ field, message }) => `${field}: ${message}`);
            this.#refuse([fault.message, ...more, ...(remedy === undefined ? [] : [remedy])].join('\n'));
        }
    }

    async #hash(signal: AbortSignal): Promise<readonly HashedFile[]> {
        const files = this.#files;
        const total = bytesOf(files);
        const speed = new Speed();
        let bytes = bytesOf(files.filter(({ file }) => this.#known.has(file)));
        this.#tell('Reading the files.');
        const draw = (): void => {
            speed.add(performance.now(), bytes);
            this.#draw(bytes / total, progressText('Reading', bytes, total, speed.bytesPerSecond));
        };
        draw();
        await hashFiles(files, this.#known, {
            signal,
            onBytes: (more) => {
                bytes += more;
                this.#soon(draw);
            },
        });
        return files.map(({ path, file }) => ({ path, file, digest: this.#known.get(file)! }));
    }

    /** The name of the field; unless somebody wrote it, that of the same files, or one that is not taken. */
    async #chooseId(files: readonly HashedFile[], signal: AbortSignal): Promise<string> {
        const root = digestOfBytes(new TextEncoder().encode(listText(files)));
        if (!this.#isIdEdited) {
            const datasets = await listDatasets({ ...this.#context, signal }).catch(() => {
                signal.throwIfAborted();
                return [];
            });
            const same = datasets.find((dataset) => dataset.root?.digest === root);
            this.#id.control.value =
                same?.datasetId ??
                freeId(this.#id.value, (id) => datasets.some(({ datasetId }) => datasetId === id));
        }
        const key = `${this.#id.value} ${root}`;
        if (this.#attempt.key !== key) {
            this.#attempt = { key, requestId: freshUuid() };
        }
        return this.#id.value;
    }

    async #send(datasetId: string, files: readonly HashedFile[], signal: AbortSignal): Promise<Dataset> {
        let speed = new Speed();
        let newest: SendProgress = { step: 'begin', bytes: 0, totalBytes: 0, missing: 0, waiting: '' };
        const draw = (): void => {
            const { step, bytes, totalBytes, waiting } = newest;
            speed.add(performance.now(), bytes);
            const text = {
                begin: 'Asking what the service has already …',
                send: progressText('Uploading', bytes, totalBytes, waiting === '' ? speed.bytesPerSecond : 0),
                commit: 'Completing the dataset …',
            }[step];
            this.#draw(
                totalBytes === 0 ? 1 : bytes / totalBytes,
                [text, WAITING[waiting]].filter((part) => part !== '').join('\n'),
            );
        };
        return sendDataset(
            { datasetId, requestId: this.#attempt.requestId, files },
            {
                calls: this.#context.session.api.uploads,
                signal,
                onProgress: (progress) => {
                    if (progress.step !== newest.step && progress.step === 'send') {
                        speed = new Speed();
                        this.#tell(`Uploading ${bytesText(progress.totalBytes)}.`);
                    }
                    if (progress.waiting !== newest.waiting) {
                        this.#tell(
                            progress.waiting === '' ? 'The upload goes on.' : WAITING[progress.waiting],
                        );
                    }
                    newest = progress;
                    this.#soon(draw);
                },
            },
        );
    }

    #soon(draw: () => void): void {
        this.#newest = draw;
        this.#timer ||= window.setTimeout(() => {
            this.#timer = 0;
            this.#newest?.();
        }, DRAW_EVERY_MS);
    }

    #draw(share: number, text: string): void {
        this.#bar.set(share, text);
        setText(this.#said, text);
    }

    #tell(text: string): void {
        setText(this.#spoken, text);
    }
}
