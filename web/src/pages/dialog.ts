// Questions: a dialog with fields, a button that acts and one that does not.

import { freshId, h } from './dom.ts';
import { faultOf } from './faults.ts';

interface TextField {
    readonly kind: 'text';
    readonly label: string;
    readonly value?: string;
    readonly hint?: string;
    readonly maximum?: number;
    readonly isRequired?: boolean;
}

interface NumberField {
    readonly kind: 'number';
    readonly label: string;
    readonly value: number;
    readonly hint?: string;
    readonly minimum: number;
    readonly maximum: number;
}

interface ChoiceField {
    readonly kind: 'choice';
    readonly label: string;
    readonly value?: string;
    readonly hint?: string;
    readonly options: readonly (readonly [value: string, label: string])[];
}

export type Field = TextField | NumberField | ChoiceField;
type Control = HTMLInputElement | HTMLSelectElement;

export interface Question<K extends string> {
    readonly title: string;
    readonly text?: string;
    readonly fields?: Readonly<Record<K, Field>>;
    /** Shown below the text. */
    readonly content?: Node;
    /** What the button says. Absent: there is nothing to do but to read. */
    readonly action?: string;
    /** What the other button says. */
    readonly dismiss?: string;
    /** Whether the action destroys something. */
    readonly isDangerous?: boolean;
    /**
     * Acts with the values of the fields. Its error is shown, and the dialog stays. A node that it returns is
     * shown in place of the fields.
     */
    readonly act?: (values: Readonly<Record<K, string>>) => Promise<Node | null>;
}

function controlOf(field: Field, id: string, hintId: string): Control {
    const described = field.hint === undefined ? {} : { 'aria-describedby': hintId };
    if (field.kind === 'choice') {
        const options = field.options.map(([value, label]) =>
            h('option', { value, selected: value === field.value }, label),
        );
        return h('select', { id, ...described }, ...options);
    }
    if (field.kind === 'number') {
        const { minimum: min, maximum: max, value } = field;
        return h('input', { id, type: 'number', step: 1, min, max, value, required: true, ...described });
    }
    return h('input', {
        id,
        type: 'text',
        value: field.value ?? '',
        maxlength: field.maximum ?? 1000,
        required: field.isRequired === true,
        autocomplete: 'off',
        ...described,
    });
}

/** Asks. Resolves when the dialog is closed, to whether it acted. */
export function ask<K extends string = never>(question: Question<K>): Promise<boolean> {
    const titleId = freshId();
    const fields = Object.entries(question.fields ?? {}) as [K, Field][];
    const controls = new Map<K, Control>();
    const rows = fields.map(([key, field]) => {
        const [id, hintId] = [freshId(), freshId()];
        const control = controlOf(field, id, hintId);
        controls.set(key, control);
        return h(
            'div',
            { class: 'field' },
            h('label', { for: id }, field.label),
            control,
            field.hint === undefined ? null : h('p', { class: 'soft', id: hintId }, field.hint),
        );
    });
    const alert = h('p', { class: 'alert bad', role: 'alert', hidden: true });
    const dismiss = h('button', { type: 'button' }, question.dismiss ?? 'Close');
    const act = h('button', { type: 'submit', class: question.isDangerous === true ? 'danger' : 'primary' }, question.action ?? '');
    act.hidden = question.action === undefined;
    const text = question.text === undefined ? null : h('p', {}, question.text);
    const buttons = h('div', { class: 'row end' }, dismiss, act);
    const form = h('form', {}, h('h2', { id: titleId }, question.title), text, ...rows, question.content ?? null, alert, buttons);
    const dialog = h('dialog', { class: 'dialog', 'aria-labelledby': titleId }, form);
    let hasActed = false;

    const run = async (): Promise<void> => {
        alert.hidden = true;
        act.disabled = true;
        try {
            const values = Object.fromEntries(fields.map(([key]) => [key, controls.get(key)!.value.trim()]));
            const result = (await question.act?.(values as Record<K, string>)) ?? null;
            hasActed = true;
            if (result === null) {
                dialog.close();
                return;
            }
            text?.remove();
            rows.forEach((row) => row.remove());
            act.remove();
            alert.before(result);
            dismiss.textContent = 'Done';
            dismiss.focus();
        } catch (error) {
            alert.textContent = faultOf(error).message;
            alert.hidden = false;
        }
        act.disabled = false;
    };
    form.addEventListener('submit', (event) => {
        event.preventDefault();
        if (question.act === undefined) {
            dialog.close();
        } else {
            void run();
        }
    });
    dismiss.addEventListener('click', () => dialog.close());
    const before = document.activeElement;
    return new Promise((resolve) => {
        dialog.addEventListener('close', () => {
            dialog.remove();
            if (before instanceof HTMLElement && before.isConnected) {
                before.focus();
            }
            resolve(hasActed);
        });
        document.body.append(dialog);
        dialog.showModal();
        const first = [...controls.values()][0];
        (first ?? dismiss).focus();
    });
}
