// The form for a new job: from an uploaded dataset, or from a folder that is uploaded here.

import type { Dataset } from '../rpc/fathom/v1/upload_pb.ts';
import { type Context, problemOf } from './context.ts';
import { contentText, createdMs, howToUpload, isCommitted, listDatasets } from './dataset-list.ts';
import { freshId, h } from './dom.ts';
import { type Fault, faultOf, wrongFieldsOf } from './faults.ts';
import { FormRow, numberInput, selectInput } from './form-field.ts';
import { timeText } from './format.ts';
import { type FormField, WrongForm, configOf, freshUuid, wrongField } from './job-settings.ts';
import { poll } from './poll.ts';
import { DATASETS_LINK, jobLink, jobsLink } from './route.ts';
import { FolderPanel } from './upload/folder-panel.ts';
import { PlanCheck, type Subject } from './upload/plan-check.ts';
import './upload/upload.css';

/** Until the first dataset is there, and afterwards. */
const SOON_MS = 2500;
const SELDOM_MS = 30_000;
const DEFAULTS = { iterations: 12_000, maxGaussians: 3_000_000 } as const;
const LARGEST = 4_294_967_295;
const MOST_CELLS = 1000;
const PRESETS = [
    ['fathom', 'fathom: the defaults, with water'],
    ['paper', 'paper: SMP-UWGS as printed'],
    ['3dgs', '3dgs: plain 3D Gaussian splatting, no water'],
    ['2dgs', '2dgs: disks on surfaces, no water'],
    ['wsgs', 'wsgs: seen through a water surface'],
] as const;
const LOST = 'The service does not answer. Press the button again: there will be one job only.';
const REUSED = 'This form has already created a job with other values. Look for it in the list of jobs. For a second job, open this form again.';

const optionText = (dataset: Dataset): string => `${dataset.datasetId}: ${contentText(dataset)}, ${timeText(createdMs(dataset))}`;

/** Columns and rows of a grid, or the choice of the service. */
function makePartitions(): { readonly row: FormRow; readonly kind: () => 'auto' | 'grid'; readonly columns: () => number; readonly rows: () => number } {
    const select = selectInput([['auto', 'Automatic'], ['grid', 'Columns × rows']], 'auto');
    const [columns, rows] = [numberInput(2, 1, MOST_CELLS), numberInput(2, 1, MOST_CELLS)];
    const [columnsId, rowsId] = [freshId(), freshId()];
    columns.id = columnsId;
    rows.id = rowsId;
    const grid = h(
        'div',
        { class: 'row grid-size', hidden: true },
        h('label', { for: columnsId }, 'Columns'),
        columns,
        h('label', { for: rowsId }, 'Rows'),
        rows,
    );
    select.addEventListener('change', () => {
        grid.hidden = select.value !== 'grid';
    });
    const row = new FormRow('Partitions', select, 'Workers train partitions in parallel. Automatic fits the GPU memory of the workers.', grid);
    return {
        row,
        kind: () => (select.value === 'grid' ? 'grid' : 'auto'),
        columns: () => Number(columns.value),
        rows: () => Number(rows.value),
    };
}

type Source = 'dataset' | 'folder';

interface Form {
    readonly element: HTMLElement;
    /** Whether somebody has chosen something that must stay. */
    readonly isUsed: () => boolean;
    offer(datasets: readonly Dataset[], wanted: string): void;
}

/** `onUse` hears when a folder is chosen, or has become a dataset. */
function makeForm(context: Context, onUse: () => void): Form {
    const { session, signal } = context;
    /** The same for every press of the button, so that they create one job. */
    const requestId = freshUuid();
    const datasetSelect = h('select', { required: true });
    const checkDataset = h('button', { type: 'button', onclick: () => void check.run() }, 'Check');
    const dataset = new FormRow('Dataset', datasetSelect, '', h('div', { class: 'row' }, checkDataset));
    const name = new FormRow('Name', h('input', { type: 'text', maxlength: 200, autocomplete: 'off' }), 'Empty: the name of the dataset.');
    const preset = new FormRow('Preset', selectInput(PRESETS, 'fathom'), 'The starting point of all settings.');
    const partitions = makePartitions();
    const iterations = new FormRow('Iterations', numberInput(DEFAULTS.iterations, 1, LARGEST), 'Of the whole job, counted as for one partition.');
    const maxGaussians = new FormRow('Most Gaussians', numberInput(DEFAULTS.maxGaussians, 1, LARGEST), 'In all partitions together.');
    const priority = new FormRow('Priority', numberInput(0, -1000, 1000), 'Jobs with a higher priority come first.');
    const previews = h('input', { type: 'checkbox', checked: true, id: freshId() });
    const advanced = new FormRow(
        'Advanced settings, JSON by section',
        h('textarea', { rows: 6, class: 'mono', spellcheck: 'false', autocomplete: 'off', placeholder: '{"train": {"ssim_weight": 0.3}, "borders": {"enabled": true}}' }),
        'Settings without a field above. The book of Fathom lists all of them under "Settings".',
    );
    const rows: Readonly<Record<FormField, FormRow>> = {
        dataset,
        name,
        preset,
        partitions: partitions.row,
        iterations,
        maxGaussians,
        priority,
        advanced,
    };
    const details = h('details', { class: 'more' }, h('summary', {}, 'Advanced settings'), advanced.element);
    const alert = h('p', { class: 'alert bad', role: 'alert', hidden: true });
    const create = h('button', { type: 'submit', class: 'primary' }, 'Create the job');

    const wrong = (field: FormField, message: string): void => {
        if (field === 'advanced') {
            details.open = true;
        }
        const isFirst = !Object.values(rows).some(({ control }) => control.getAttribute('aria-invalid') === 'true');
        rows[field].say(message);
        if (isFirst) {
            rows[field].control.focus();
        }
    };
    const say = (text: string): void => {
        alert.textContent = text;
        alert.hidden = text === '';
    };
    const clear = (): void => {
        say('');
        Object.values(rows).forEach((row) => row.say(''));
    };
    const configNow = (): string =>
        configOf({
            preset: preset.value,
            partitions: partitions.kind(),
            columns: partitions.columns(),
            rows: partitions.rows(),
            iterations: Number(iterations.value),
            maxGaussians: Number(maxGaussians.value),
            hasPreviews: previews.checked,
            advanced: advanced.value,
        });

    // Where the scene comes from

    let source: Source = 'folder';
    const datasetId = (): string =>
        source === 'dataset' ? datasetSelect.value : (folder.dataset?.datasetId ?? '');
    const subject = (isLoud: boolean): Subject | null => {
        if (isLoud) {
            clear();
        }
        try {
            return { datasetId: datasetId(), configJson: configNow() };
        } catch (error) {
            if (isLoud && error instanceof WrongForm) {
                wrong(error.field, error.message);
            }
            return null;
        }
    };
    const atFields = (fault: Fault): boolean => {
        const fields = fault.reason === 'BAD_ARGUMENT' ? wrongFieldsOf(fault) : [];
        for (const { field, message } of fields) {
            const shown = wrongField(field, message, advanced.value);
            wrong(shown.field, shown.message);
        }
        return fields.length > 0;
    };
    const check = new PlanCheck(context, { subject, refused: atFields });
    const folder = new FolderPanel(context, {
        onChosen: () => {
            choose('folder');
            check.clear();
            settings.hidden = false;
            onUse();
        },
        onCommitted: () => {
            onUse();
            if (source === 'folder') {
                void check.run();
            }
        },
    });
    const kinds = h('div', { class: 'scene-kinds', hidden: true });
    const radios = (['dataset', 'folder'] as const).map((kind) => {
        const radio = h('input', { type: 'radio', name: 'source', value: kind, id: freshId() });
        radio.addEventListener('change', () => {
            choose(kind);
            check.clear();
        });
        const label = { dataset: 'Already uploaded', folder: 'A folder on this computer' }[kind];
        kinds.append(h('div', { class: 'check' }, radio, h('label', { for: radio.id }, label)));
        return radio;
    });
    function choose(kind: Source): void {
        source = kind;
        radios.forEach((radio) => (radio.checked = radio.value === kind));
        dataset.element.hidden = kind !== 'dataset';
        // A hidden field that is required would keep the form from being sent.
        datasetSelect.disabled = kind !== 'dataset';
        folder.element.hidden = kind !== 'folder';
        say('');
    }
    choose(source);
    datasetSelect.addEventListener('change', () => check.clear());

    const refused = (fault: Fault): void => {
        const isOfDataset = fault.reason === 'DATASET_NOT_FOUND' || fault.reason === 'DATASET_NOT_COMMITTED';
        if (isOfDataset && source === 'dataset') {
            wrong('dataset', fault.message);
        } else if (!atFields(fault)) {
            say(fault.kind === 'lost' ? LOST : fault.reason === 'REQUEST_ID_REUSED' ? REUSED : fault.message);
        }
    };
    const createJob = async (configJson: string): Promise<string> => {
        const id = datasetId();
        const manifest = check.of({ datasetId: id, configJson })?.manifest;
        const request = {
            requestId,
            configJson,
            datasetId: id,
            name: name.value === '' ? id : name.value,
            priority: Number(priority.value),
            ingestSeconds: source === 'folder' ? folder.seconds : 0,
        };
        if (manifest !== undefined) {
            try {
                return (await session.api.jobs.createJob({ ...request, manifest })).jobId;
            } catch (error) {
                // Nothing kept the manifest of an inspection for long. Without it, the scene is read again.
                if (faultOf(error).reason !== 'BLOB_NOT_FOUND') {
                    throw error;
                }
            }
        }
        return (await session.api.jobs.createJob(request)).jobId;
    };
    const send = async (): Promise<void> => {
        clear();
        if (datasetId() === '') {
            say(folder.isBusy ? 'The upload is not complete yet.' : 'First upload the folder.');
            folder.focus();
            return;
        }
        create.disabled = true;
        try {
            const id = await createJob(configNow());
            if (!signal.aborted) {
                location.hash = jobLink(id);
            }
        } catch (error) {
            if (error instanceof WrongForm) {
                wrong(error.field, error.message);
            } else {
                refused(faultOf(error));
            }
        }
        create.disabled = false;
    };

    const settings = h(
        'div',
        { class: 'new-job-settings', hidden: true },
        name.element,
        h('div', { class: 'pairs' }, partitions.row.element, preset.element, iterations.element, maxGaussians.element, priority.element),
        h('div', { class: 'check' }, previews, h('label', { for: previews.id }, 'Small pictures of held-out views while it trains')),
        details,
        alert,
        h('div', { class: 'row end' }, h('a', { class: 'button', href: jobsLink() }, 'Back'), create),
    );
    const scene = h(
        'fieldset',
        { class: 'scene-source' },
        h('legend', {}, 'Scene'),
        kinds,
        dataset.element,
        folder.element,
        check.element,
    );
    const element = h('form', { class: 'card new-job', 'aria-label': 'New job' }, scene, settings);
    element.addEventListener('submit', (event) => {
        event.preventDefault();
        void send();
    });
    for (const kind of ['input', 'change']) {
        settings.addEventListener(kind, () => check.compare());
    }
    let offered = '';
    return {
        element,
        isUsed: () => folder.hasFolder,
        offer: (datasets, wanted) => {
            const key = JSON.stringify(datasets.map(({ datasetId: id }) => id));
            if (key === offered || datasets.length === 0) {
                return;
            }
            if (offered === '' && !folder.hasFolder) {
                choose('dataset');
            }
            offered = key;
            kinds.hidden = false;
            settings.hidden = false;
            const chosen = datasetSelect.value === '' ? wanted : datasetSelect.value;
            datasetSelect.replaceChildren(
                ...datasets.map((one) => h('option', { value: one.datasetId, selected: one.datasetId === chosen }, optionText(one))),
            );
        },
    };
}

export function showNewJob(container: HTMLElement, context: Context, wanted: string): void {
    const { signal } = context;
    context.title('New job');
    const form = makeForm(context, () => {
        none.hidden = true;
        polling.now();
    });
    const loading = h('p', { class: 'card loading', role: 'status' }, 'Loading the datasets …');
    const ways = howToUpload(context, 'Drop a folder above, or upload one from a terminal:');
    const none = h('div', { class: 'card flush', hidden: true }, ways);
    const problem = h('div', { class: 'card flush', hidden: true });
    const content = h('div', { class: 'new-job-page' }, loading);
    container.append(
        h(
            'div',
            { class: 'head' },
            h('h1', { tabindex: -1 }, 'New job'),
            h('a', { href: DATASETS_LINK }, 'All datasets'),
        ),
        content,
    );
    let hasDatasets = false;
    const polling = poll(() => (hasDatasets ? SELDOM_MS : SOON_MS), signal, async () => {
        try {
            const datasets = (await listDatasets(context)).filter(isCommitted);
            // A form that somebody fills in stays.
            hasDatasets ||= datasets.length > 0;
            if (!form.element.isConnected) {
                content.replaceChildren(form.element, problem, none);
            }
            none.hidden = hasDatasets || form.isUsed();
            problem.hidden = true;
            form.offer(datasets, wanted);
        } catch (error) {
            const shown = problemOf('The datasets cannot be listed', faultOf(error));
            if (shown !== null && !hasDatasets) {
                problem.replaceChildren(shown);
                problem.hidden = false;
                if (!form.element.isConnected) {
                    content.replaceChildren(problem);
                }
            }
        }
    });
}
