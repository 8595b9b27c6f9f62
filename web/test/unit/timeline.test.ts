import assert from 'node:assert/strict';
import { test } from 'node:test';

import type { TaskInfo } from '../../src/pages/parts/part.ts';
import {
    type Bar,
    type TimelineData,
    type TimelineEvent,
    attemptsOf,
    barText,
    loadOf,
    taskLabel,
    timelineOf,
} from '../../src/pages/parts/timeline-bars.ts';

const event = (
    timeMs: number,
    task: string | null,
    state: string | null,
    change: Partial<TimelineEvent> = {},
): TimelineEvent => ({
    kind: 'task',
    task,
    state,
    attempt: 1,
    worker: 'w1',
    message: '',
    resumedFrom: 0,
    timeMs,
    ...change,
});
const info = (task: string, state: string, change: Partial<TaskInfo> = {}): TaskInfo => ({
    task,
    stage: task.replace(/-\d+$/, ''),
    partition: /-(\d+)$/.test(task) ? Number(task.slice(-4)) : null,
    state,
    worker: null,
    iteration: 0,
    iterations: 0,
    attempts: 1,
    psnr: null,
    ...change,
});
const job = (timeMs: number, state: string, message = ''): TimelineEvent =>
    event(timeMs, null, state, { kind: 'job_state', message, attempt: 0, worker: null });
const data = (events: TimelineEvent[], tasks: TaskInfo[] = [], nowMs = 1000): TimelineData => ({
    events,
    tasks,
    nowMs,
});
const brief = ({ attempt, startMs, endMs, outcome }: Bar): [number, number, number, string] => [
    attempt,
    startMs,
    endMs,
    outcome,
];

test('an attempt is a bar from its lease to its end', () => {
    const bars = attemptsOf(data([event(10, 'merge', 'running'), event(50, 'merge', 'done')]));
    assert.deepEqual(bars.get('merge')!.map(brief), [[1, 10, 50, 'done']]);
});

test('a running attempt grows to the present', () => {
    const bars = attemptsOf(data([event(10, 'merge', 'running')], [info('merge', 'running')], 777));
    assert.deepEqual(bars.get('merge')!.map(brief), [[1, 10, 777, 'running']]);
});

test('a lost worker, an error and a release are told apart by what the coordinator says', () => {
    const ways: [string, string][] = [
        ['lease expired: its worker stopped renewing', 'lost'],
        ['lease expired: its worker is alive but makes no progress', 'lost'],
        ['released: the worker is draining', 'released'],
        ['its coordinator is gone', 'released'],
        ['the GPU device was lost', 'error'],
    ];
    for (const [message, outcome] of ways) {
        const bars = attemptsOf(data([event(10, 't', 'running'), event(20, 't', 'ready', { message })]));
        assert.deepEqual(bars.get('t')!.map(brief), [[1, 10, 20, outcome]], message);
    }
});

test('of two attempts at a task the slower one ends with the first result', () => {
    const second = { attempt: 2, worker: 'w2', message: 'beside w1, which is slow' };
    const bars = attemptsOf(
        data([
            event(10, 't', 'running'),
            event(30, 't', 'running', second),
            event(60, 't', 'done', { attempt: 2, worker: 'w2' }),
        ]),
    );
    assert.deepEqual(bars.get('t')!.map(brief), [
        [1, 10, 60, 'superseded'],
        [2, 30, 60, 'done'],
    ]);
});

test('the end of a job ends its attempts', () => {
    const time = timelineOf(
        data([job(0, 'running'), event(10, 't', 'running'), job(5000, 'cancelled', 'by its user')], [], 9000),
    );
    assert.deepEqual(time.rows[0]!.bars.map(brief), [[1, 10, 5000, 'cancelled']]);
    assert.equal(time.endMs, 5000, 'the axis ends with the job');
    assert.equal(time.notes[0]!.text, 'The job was cancelled: by its user');
});

test('an attempt whose end is not among the events does not grow', () => {
    const bars = attemptsOf(
        data([event(10, 't', 'running'), event(40, 'u', 'running')], [info('t', 'done'), info('u', 'running')]),
    );
    assert.deepEqual(bars.get('t')!.map(brief), [[1, 10, 40, 'done']]);
    assert.equal(bars.get('u')![0]!.outcome, 'running');
});

test('what went wrong is listed, the latest first, with the iteration of the resumption', () => {
    const { notes } = timelineOf(
        data([
            event(1, null, null, { kind: 'warning', message: 'few points' }),
            event(10, 'partition-0001', 'running'),
            event(20, 'partition-0001', 'ready', { message: 'lease expired: its worker stopped renewing' }),
            event(30, 'partition-0001', 'running', { attempt: 2, worker: 'w2', resumedFrom: 400 }),
            event(40, 'partition-0001', 'failed', { attempt: 2, worker: 'w2', message: 'out of memory' }),
        ]),
    );
    assert.deepEqual(
        notes.map(({ text }) => text),
        [
            'Attempt 2 on w2 failed, and no other will follow: out of memory',
            'Attempt 2 on w2 resumed from iteration 400',
            'Attempt 1 on w1 lost its worker: its worker stopped renewing',
            'Warning: few points',
        ],
    );
});

test('a result that was lost later keeps its bar and is noted', () => {
    const time = timelineOf(
        data([
            event(10, 'partition-0000', 'running'),
            event(20, 'partition-0000', 'done'),
            event(30, 'partition-0000', 'ready', { message: 'the disk has lost its result' }),
        ]),
    );
    assert.deepEqual(time.rows[0]!.bars.map(brief), [[1, 10, 20, 'done']]);
    assert.equal(time.notes[0]!.text, 'It has to run again: the disk has lost its result');
});

test('stages follow their order, and a few partitions have a row each', () => {
    const tasks = ['artifacts', 'partition-0001', 'plan', 'partition-0000', 'global'].map((task) =>
        info(task, 'done'),
    );
    assert.deepEqual(
        timelineOf(data([], tasks)).rows.map(({ label }) => label),
        ['Plan', 'Coarse model', 'Partition 1', 'Partition 0', 'Artifacts'],
    );
});

test('a thousand partitions fold into those that matter and a count', () => {
    const tasks = Array.from({ length: 1000 }, (_, i) => {
        const task = `partition-${String(i).padStart(4, '0')}`;
        const state = i < 600 ? 'done' : i < 603 ? 'running' : i === 603 ? 'failed' : 'ready';
        return info(task, state, { attempts: i === 5 ? 2 : state === 'ready' ? 0 : 1 });
    });
    const { rows, hidden } = timelineOf(data([], tasks));
    assert.deepEqual(
        rows.map(({ label }) => label),
        ['Partition 5', 'Partition 600', 'Partition 601', 'Partition 602', 'Partition 603', 'Partition: 995 others'],
    );
    assert.equal(rows.at(-1)!.folded!.words, '599 done, 396 waiting');
    assert.equal(hidden, 0);
});

test('where there is no room for all, failed and repeated tasks stay', () => {
    const tasks = Array.from({ length: 50 }, (_, i) =>
        info(`partition-${String(i).padStart(4, '0')}`, i === 49 ? 'failed' : 'running', {
            attempts: i === 48 ? 3 : 1,
        }),
    );
    const { rows, hidden } = timelineOf(data([], tasks), 3);
    assert.deepEqual(
        rows.map(({ label }) => label),
        ['Partition 0', 'Partition 48', 'Partition 49', 'Partition: 47 others'],
    );
    assert.equal(hidden, 47);
});

test('the row of many counts how many run at a time', () => {
    const bar = (startMs: number, endMs: number): Bar => ({
        task: 't',
        attempt: 1,
        worker: '',
        startMs,
        endMs,
        outcome: 'done',
        message: '',
        resumedFrom: 0,
    });
    assert.deepEqual(loadOf([bar(0, 10), bar(5, 20), bar(10, 12)]), [
        { timeMs: 0, count: 1 },
        { timeMs: 5, count: 2 },
        { timeMs: 10, count: 2 },
        { timeMs: 12, count: 1 },
        { timeMs: 20, count: 0 },
    ]);
});

test('pauses last until the job runs again, or until now', () => {
    const events = [job(0, 'running'), job(10, 'paused'), job(20, 'running', 'resumed'), job(30, 'paused')];
    assert.deepEqual(timelineOf(data(events, [], 99)).pauses, [
        { startMs: 10, endMs: 20 },
        { startMs: 30, endMs: 99 },
    ]);
});

test('a bar reads as a sentence', () => {
    const [bar] = attemptsOf(
        data([
            event(0, 'partition-0003', 'running', { attempt: 2, resumedFrom: 400 }),
            event(65_000, 'partition-0003', 'ready', { attempt: 2, message: 'released: maintenance' }),
        ]),
    ).get('partition-0003')!;
    assert.equal(
        barText(bar!),
        'partition-0003, attempt 2 on w1, resumed from iteration 400, 1 min 5 s, released: maintenance',
    );
    assert.equal(taskLabel(info('evaluate-0002', 'done', { partition: null })), 'Evaluate 2');
});
