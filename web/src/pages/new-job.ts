// The form for a new job from an uploaded dataset.

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

function makeForm(context: Context): { readonly element: HTMLElement; offer(datasets: readonly Dataset[], wanted: string): void } {
    const { session, signal } = context;
    /** The same for every press of the button, so that they create one job. */
    const requestId = freshUuid();
    const datasetSelect = h('select', { required: true });
    const dataset = new FormRow('Dataset', datasetSelect);
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
    const refused = (fault: Fault): void => {
        if (fault.reason === 'DATASET_NOT_FOUND' || fault.reason === 'DATASET_NOT_COMMITTED') {
            wrong('dataset', fault.message);
            return;
        }
        const fields = fault.reason === 'BAD_ARGUMENT' ? wrongFieldsOf(fault) : [];
        if (fields.length === 0) {
            say(fault.kind === 'lost' ? LOST : fault.reason === 'REQUEST_ID_REUSED' ? REUSED : fault.message);
        }
        for (const { field, message } of fields) {
            const shown = wrongField(field, message, advanced.value);
            wrong(shown.field, shown.message);
        }
    };
    const send = async (): Promise<void> => {
        say('');
        Object.values(rows).forEach((row) => row.say(''));
        create.disabled = true;
        try {
            const configJson = configOf({
                preset: preset.value,
                partitions: partitions.kind(),
                columns: partitions.columns(),
                rows: partitions.rows(),
                iterations: Number(iterations.value),
                maxGaussians: Number(maxGaussians.value),
                hasPreviews: previews.checked,
                advanced: advanced.value,
            });
            const job = await session.api.jobs.createJob({
                requestId,
                configJson,
                datasetId: dataset.value,
                name: name.value === '' ? dataset.value : name.value,
                priority: Number(priority.value),
            });
            if (!signal.aborted) {
                location.hash = jobLink(job.jobId);
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

    const element = h(
        'form',
        { class: 'card new-job', 'aria-label': 'New job' },
        dataset.element,
        name.element,
        h('div', { class: 'pairs' }, partitions.row.element, preset.element, iterations.element, maxGaussians.element, priority.element),
        h('div', { class: 'check' }, previews, h('label', { for: previews.id }, 'Small pictures of held-out views while it trains')),
        details,
        alert,
        h('div', { class: 'row end' }, h('a', { class: 'button', href: jobsLink() }, 'Back'), create),
    );
    element.addEventListener('submit', (event) => {
        event.preventDefault();
        void send();
    });
    let offered = '';
    return {
        element,
        offer: (datasets, wanted) => {
            const key = JSON.stringify(datasets.map(({ datasetId }) => datasetId));
            if (key === offered) {
                return;
            }
            offered = key;
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
    const form = makeForm(context);
    const content = h('div', {}, h('p', { class: 'card loading', role: 'status' }, 'Loading the datasets …'));
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
    let shown: HTMLElement | null = null;
    const place = (element: HTMLElement): void => {
        if (shown !== element) {
            shown = element;
            content.replaceChildren(element);
        }
    };
    const none = h('div', { class: 'card flush' }, howToUpload(context));
    poll(() => (hasDatasets ? SELDOM_MS : SOON_MS), signal, async () => {
        try {
            const datasets = (await listDatasets(context)).filter(isCommitted);
            // A form that somebody fills in stays.
            hasDatasets ||= datasets.length > 0;
            if (hasDatasets) {
                form.offer(datasets, wanted);
                place(form.element);
            } else {
                place(none);
            }
        } catch (error) {
            const problem = problemOf('The datasets cannot be listed', faultOf(error));
            if (problem !== null && !hasDatasets) {
                place(problem);
            }
        }
    });
}
