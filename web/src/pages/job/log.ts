// The log of a job: lines of all attempts, also while they arrive. Only the lines in sight are elements.

import { timestampMs } from '@bufbuild/protobuf/wkt';

import { type LogEntry, LogSeverity } from '../../rpc/fathom/v1/log_pb.ts';
import { NO_LIMIT } from '../api.ts';
import { problemOf } from '../context.ts';
import { freshId, h, setText } from '../dom.ts';
import { faultOf } from '../faults.ts';
import { clockText, countText, timeText } from '../format.ts';
import { VISIBILITY } from '../visibility.ts';
import { hasEnded, severityWord } from '../words.ts';
import { save } from './files.ts';
import { follow } from './follow.ts';
import type { JobContext, Section } from './section.ts';

/** The height of a line, pixels; that of `.log-line` in pages.css. */
const LINE_HEIGHT = 22;
/** Lines above and below those in sight that are elements too. */
const MARGIN = 20;
/** As far from the end, in pixels, counts as being at the end. */
const NEAR_END = 2 * LINE_HEIGHT;
/** Lines are shown this often while they arrive, milliseconds. */
const SHOW_EVERY_MS = 150;

const LEVELS: readonly (readonly [LogSeverity, string])[] = [
    [LogSeverity.UNSPECIFIED, 'All'],
    [LogSeverity.INFO, 'Info and above'],
    [LogSeverity.WARN, 'Warnings and errors'],
    [LogSeverity.ERROR, 'Errors'],
];

export interface Line {
    readonly timeMs: number;
    readonly level: LogSeverity;
    readonly task: string;
    readonly attempt: number;
    readonly worker: string;
    readonly message: string;
}

export const lineOf = (entry: LogEntry): Line => ({
    timeMs: entry.time === undefined ? 0 : timestampMs(entry.time),
    level: entry.severity,
    task: entry.taskId,
    attempt: entry.attempt,
    worker: entry.worker,
    message: entry.message,
});

/** Which lines are shown. */
export interface LineFilter {
    readonly task: string;
    readonly level: number;
    /** In lower case. */
    readonly text: string;
}

/** Whether a filter shows a line. */
export const admits = (filter: LineFilter, line: Line): boolean =>
    line.level >= filter.level &&
    (filter.task === '' || line.task === filter.task) &&
    (filter.text === '' || line.message.toLowerCase().includes(filter.text));

/** The indices of the lines that a filter shows, in their order. */
export const admitted = (filter: LineFilter, lines: readonly Line[]): number[] => {
    const indices: number[] = [];
    lines.forEach((line, index) => {
        if (admits(filter, line)) {
            indices.push(index);
        }
    });
    return indices;
};

/** The filter of what is entered in the fields. */
export const filterOf = (task: string, level: string, text: string): LineFilter => ({
    task,
    level: Number(level),
    text: text.trim().toLowerCase(),
});

const asText = (line: Line): string =>
    `${new Date(line.timeMs).toISOString()} ${severityWord(line.level).toUpperCase()} ${line.task}#${line.attempt} ${line.worker} ${line.message}`;

export function open(container: HTMLElement, context: JobContext): Section {
    const { id, session, signal } = context;
    const lines: Line[] = [];
    const tasks = new Set<string>();
    /** Indices of the lines that the filter admits. */
    let shown: number[] = [];
    let filter: LineFilter = { task: '', level: 0, text: '' };
    let last = 0n;
    let isFollowing = true;
    let isComplete = false;
    let selected: number | null = null;

    const [taskId, levelId, textId, followId] = [freshId(), freshId(), freshId(), freshId()];
    const task = h('select', { id: taskId }, h('option', { value: '' }, 'All tasks'));
    const level = h('select', { id: levelId }, ...LEVELS.map(([value, label]) => h('option', { value }, label)));
    const text = h('input', { id: textId, type: 'search', maxlength: 200, autocomplete: 'off' });
    const followBox = h('input', { id: followId, type: 'checkbox', checked: true });
    const download = h('button', { type: 'button' }, 'Save as text');
    const count = h('p', { class: 'soft', role: 'status' }, 'Loading the log …');
    const space = h('div', { class: 'log-space' });
    const view = h('div', { class: 'log', tabindex: 0, role: 'region', 'aria-label': 'Log lines' }, space);
    const detail = h('div', { class: 'log-detail', hidden: true });
    container.append(
        h(
            'form',
            { class: 'filters', 'aria-label': 'Select log lines', onsubmit: (event) => event.preventDefault() },
            h('div', { class: 'field' }, h('label', { for: taskId }, 'Task'), task),
            h('div', { class: 'field' }, h('label', { for: levelId }, 'Level'), level),
            h('div', { class: 'field grow' }, h('label', { for: textId }, 'Message contains'), text),
            h('div', { class: 'check' }, followBox, h('label', { for: followId }, 'Follow')),
            download,
        ),
        h('div', { class: 'card flush' }, view, detail),
        count,
    );

    let frame = 0;
    const drawn = new Map<number, HTMLElement>();

    function makeLine(index: number): HTMLElement {
        const line = lines[shown[index]!]!;
        const word = severityWord(line.level);
        const row = h(
            'div',
            { class: 'log-line', 'data-level': word },
            h('span', { class: 'log-time' }, clockText(line.timeMs)),
            h('span', { class: 'log-level' }, word),
            h('span', { class: 'log-task' }, line.task === '' ? '–' : line.task),
            h('span', { class: 'log-message' }, line.message),
        );
        row.style.transform = `translateY(${index * LINE_HEIGHT}px)`;
        row.addEventListener('click', () => select(index));
        return row;
    }

    function draw(): void {
        frame = 0;
        space.style.height = `${shown.length * LINE_HEIGHT}px`;
        if (isFollowing) {
            view.scrollTop = view.scrollHeight;
        }
        const first = Math.max(0, Math.floor(view.scrollTop / LINE_HEIGHT) - MARGIN);
        const end = Math.min(shown.length, Math.ceil((view.scrollTop + view.clientHeight) / LINE_HEIGHT) + MARGIN);
        for (const [index, element] of drawn) {
            if (index < first || index >= end) {
                element.remove();
                drawn.delete(index);
            }
        }
        for (let index = first; index < end; index += 1) {
            let element = drawn.get(index);
            if (element === undefined) {
                element = makeLine(index);
                drawn.set(index, element);
                space.append(element);
            }
            element.classList.toggle('selected', selected === index);
        }
    }
    const request = (): void => {
        frame ||= requestAnimationFrame(draw);
    };

    function say(): void {
        const of = shown.length === lines.length ? '' : ` of ${countText(lines.length)}`;
        const more = isComplete ? '' : hasEnded(context.job.state) ? '; loading more …' : '; further lines appear here';
        setText(count, lines.length === 0 && isComplete ? 'The log is empty.' : `${countText(shown.length)}${of} lines${more}`);
    }

    function select(index: number | null): void {
        selected = index;
        const line = index === null ? undefined : lines[shown[index] ?? -1];
        detail.hidden = line === undefined;
        if (line !== undefined) {
            detail.replaceChildren(
                h('p', { class: 'soft' }, `${timeText(line.timeMs)} · ${severityWord(line.level)} · ${line.task} · attempt ${line.attempt} · ${line.worker}`),
                h('p', { class: 'mono' }, line.message),
            );
        }
        request();
    }

    function filterAgain(): void {
        filter = filterOf(task.value, level.value, text.value);
        shown = admitted(filter, lines);
        drawn.forEach((element) => element.remove());
        drawn.clear();
        select(null);
        say();
    }

    let timer = 0;
    function arrived(): void {
        timer = 0;
        for (const name of [...tasks].slice(task.options.length - 1)) {
            task.append(h('option', { value: name }, name));
        }
        say();
        request();
    }

    const setFollowing = (on: boolean): void => {
        isFollowing = on;
        followBox.checked = on;
        request();
    };
    view.addEventListener('scroll', () => {
        const isAtEnd = view.scrollHeight - view.scrollTop - view.clientHeight < NEAR_END;
        // Scrolling up stops following, scrolling to the end starts it again.
        if (isAtEnd !== isFollowing) {
            isFollowing = isAtEnd;
            followBox.checked = isAtEnd;
        }
        request();
    });
    view.addEventListener('keydown', (event) => {
        if (event.key !== 'Enter' && event.key !== 'Escape') {
            return;
        }
        // Without a mouse, Enter shows the first line in sight in full, and goes on from there.
        const first = Math.ceil(view.scrollTop / LINE_HEIGHT);
        select(event.key === 'Escape' ? null : Math.min(shown.length - 1, selected !== null && selected >= first ? selected + 1 : first));
    });
    followBox.addEventListener('change', () => setFollowing(followBox.checked));
    task.addEventListener('change', filterAgain);
    level.addEventListener('change', filterAgain);
    text.addEventListener('input', filterAgain);
    download.addEventListener('click', () => {
        const all = shown.map((index) => asText(lines[index]!)).join('\n');
        save(new Blob([all, '\n'], { type: 'text/plain' }), `${context.job.name || id}.log`);
    });
    const resized = new ResizeObserver(request);
    resized.observe(view);

    const read = async (): Promise<void> => {
        try {
            await follow(
                {
                    open: (ended) =>
                        session.api.jobs.streamLogs({ jobId: id, afterNumber: last, follow: true }, { signal: ended, ...NO_LIMIT }),
                    onItem: (entry) => {
                        last = entry.number;
                        const line = lineOf(entry);
                        lines.push(line);
                        if (admits(filter, line)) {
                            shown.push(lines.length - 1);
                        }
                        if (line.task !== '') {
                            tasks.add(line.task);
                        }
                        timer ||= window.setTimeout(arrived, SHOW_EVERY_MS);
                    },
                    faultOf: (error) => session.api.noted(error),
                    isComplete: () => hasEnded(context.job.state),
                    visibility: VISIBILITY,
                    // Nothing is sent while nothing is logged.
                    silenceMs: 10 * 60_000,
                },
                signal,
            );
            isComplete = true;
        } catch (error) {
            const shownProblem = problemOf('The log cannot be read', faultOf(error));
            if (shownProblem !== null && !signal.aborted) {
                container.replaceChildren(shownProblem);
            }
        }
        if (!signal.aborted) {
            arrived();
        }
    };
    void read();
    return {
        update: () => {},
        destroy: () => {
            resized.disconnect();
            cancelAnimationFrame(frame);
            clearTimeout(timer);
        },
    };
}
