// What bounds a job, with made-up histories.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { create } from '@bufbuild/protobuf';

import { type BoundsData, type Verdict, partText, spentBy, verdictOf } from '../../src/pages/job/bounds.ts';
import type { TaskInfo, TimelineEvent } from '../../src/pages/parts/index.ts';
import { type TaskHistory, TaskHistorySchema } from '../../src/rpc/fathom/v1/job_pb.ts';

interface Parts {
    readonly fetching?: number;
    readonly training?: number;
    /** With the part of the disk. */
    readonly photographs?: number;
    readonly disk?: number;
    readonly watching?: number;
    readonly sending?: number;
}

const spent = (seconds: number, parts: Parts) => ({
    seconds,
    fetchingSeconds: parts.fetching ?? 0,
    trainingSeconds: parts.training ?? 0,
    photographsSeconds: parts.photographs ?? 0,
    diskSeconds: parts.disk ?? 0,
    watchingSeconds: parts.watching ?? 0,
    sendingSeconds: parts.sending ?? 0,
});

/** The history of a task of one attempt. */
const history = (taskId: string, seconds: number, parts: Parts): TaskHistory =>
    create(TaskHistorySchema, {
        taskId,
        points: [
            { attempt: 1, progress: { iteration: 1, timeSpent: spent(1, { fetching: 1 }) } },
            { attempt: 1, progress: { iteration: 2, timeSpent: spent(seconds, parts) } },
        ],
    });

/** An event of a task: seconds since the beginning of the job, its new state, and its number of attempts. */
const event = (at: number, task: string, state: string, attempt = 1): TimelineEvent => ({
    kind: 'task',
    task,
    state,
    attempt,
    worker: 'w',
    message: '',
    resumedFrom: 0,
    timeMs: 1000 * at,
});
/** The job entered a stage. */
const stage = (at: number, name: string): TimelineEvent => ({
    ...event(at, '', name, 0),
    kind: 'job_stage',
    task: null,
});
const ofJob = (at: number, state: string): TimelineEvent => ({
    ...event(at, '', state),
    kind: 'job_state',
    task: null,
});

/** A task whose stage began, and that was held and done, at these seconds. */
const held = (task: string, ready: number, from: number, to: number): readonly TimelineEvent[] => [
    stage(ready, task.replace(/-\d+$/, '')),
    event(from, task, 'running'),
    event(to, task, 'done'),
];

const info = (task: string): TaskInfo => ({
    task,
    stage: task.replace(/-\d+$/, ''),
    partition: null,
    state: 'done',
    worker: 'w',
    iteration: 0,
    iterations: 0,
    attempts: 1,
    psnr: null,
});

function data(
    seconds: number,
    events: readonly (readonly TimelineEvent[])[],
    histories: readonly TaskHistory[] = [],
    maxParallel = 0,
    more: readonly string[] = [],
): BoundsData {
    const all = events.flat().toSorted((a, b) => a.timeMs - b.timeMs);
    const named = all.flatMap(({ task }) => (task === null ? [] : [task]));
    const tasks = [...new Set([...named, ...more])].map(info);
    return { tasks, histories, events: all, startMs: 0, nowMs: 1000 * seconds, maxParallel };
}

const shares = (verdict: Verdict | null): Record<string, number> =>
    Object.fromEntries((verdict?.parts ?? []).map(({ part, share }) => [part, Math.round(100 * share)]));

test('a job whose workers train is bound by the GPU', () => {
    const verdict = verdictOf(
        data(
            110,
            [held('plan', 0, 0, 10), held('partition-0000', 10, 10, 110)],
            [history('partition-0000', 100, { fetching: 4, training: 93, photographs: 2, watching: 1 })],
        ),
    );
    assert.equal(verdict?.bound, 'training');
    assert.equal(verdict.text, 'The GPU bounds this job: workers spent 93 % of their time training.');
    assert.match(verdict.advice, /More partitions/);
    assert.deepEqual(shares(verdict), {
        training: 85,
        photographs: 2,
        network: 4,
        watching: 1,
        coordinator: 9,
    });
    assert.equal(partText(verdict.parts[0]!), 'Training: 85 %, 1 min 33 s');
});

test('more workers are advised where tasks wait, unless the job limits them', () => {
    const tasks = ['partition-0000', 'partition-0001', 'partition-0002'];
    const events = tasks.map((task, i) => held(task, 0, 40 * i, 40 * i + 40));
    const histories = tasks.map((task) => history(task, 40, { training: 40 }));
    // Two wait, then one, then none.
    assert.equal(
        verdictOf(data(120, events, histories))?.advice,
        'More workers would finish it sooner: on average 1.0 tasks waited for one.',
    );
    assert.match(verdictOf(data(120, events, histories, 1))?.advice ?? '', /^At most 1 of its tasks may run/);
    const together = tasks.map((task) => held(task, 0, 0, 40));
    assert.match(verdictOf(data(40, together, histories))?.advice ?? '', /^Hardly a task waited/);
});

test('a job whose workers wait for photographs is bound by the disk or by decoding', () => {
    const of = (parts: Parts) =>
        verdictOf(data(100, [held('global', 0, 0, 100)], [history('global', 100, parts)]));
    const decoding = of({ training: 30, photographs: 65, disk: 3, fetching: 5 });
    assert.equal(decoding?.bound, 'photographs');
    assert.equal(
        decoding.text,
        'Decoding photographs bounds this job: workers spent 62 % of their time waiting for it.',
    );
    assert.match(decoding.advice, /train\.prefetch_threads/);
    assert.deepEqual(shares(decoding), { training: 30, disk: 3, photographs: 62, network: 5 });
    const reading = of({ training: 30, photographs: 65, disk: 50, fetching: 5 });
    assert.equal(reading?.bound, 'disk');
    assert.equal(
        reading.text,
        'Reading photographs from disk bounds this job: workers spent 50 % of their time waiting for the disk, ' +
            'and 15 % waiting for decoding.',
    );
    assert.match(reading.advice, /--cache-dir/);
    assert.deepEqual(shares(reading), { training: 30, disk: 50, photographs: 15, network: 5 });
    assert.equal(partText(reading.parts[1]!), 'Reading photographs from disk: 50 %, 50 s');
    assert.equal(of({ training: 30, photographs: 65 })?.bound, 'photographs', 'a worker that tells no disk');
});

test('disk and decoding bound a job together, and the larger one is named', () => {
    const of = (disk: number) =>
        verdictOf(
            data(
                100,
                [held('global', 0, 0, 100)],
                [history('global', 100, { training: 38, photographs: 60, disk, watching: 2 })],
            ),
        );
    assert.equal(of(32)?.bound, 'disk');
    assert.equal(of(28)?.bound, 'photographs');
    assert.equal(of(30)?.bound, 'photographs');
    // More than all photographs took: clocks disagree.
    assert.deepEqual(shares(of(90)), { training: 38, disk: 60, watching: 2 });
});

test('a job whose workers fetch or send is bound by the network', () => {
    const of = (parts: Parts) =>
        verdictOf(data(100, [held('global', 0, 0, 100)], [history('global', 100, parts)]));
    const fetching = of({ training: 40, fetching: 55, sending: 5 });
    assert.equal(fetching?.bound, 'network');
    assert.match(fetching.text, /^The network bounds this job: workers spent 60 % of their time/);
    assert.match(fetching.advice, /--cache-dir/);
    assert.match(of({ training: 40, fetching: 5, sending: 55 })?.advice ?? '', /stored their results/);
});

test('a job that is measured too often is bound by watching', () => {
    const verdict = verdictOf(
        data(100, [held('global', 0, 0, 100)], [history('global', 100, { training: 40, watching: 60 })]),
    );
    assert.equal(verdict?.bound, 'watching');
    assert.match(verdict.advice, /train\.eval_every/);
});

test('a job that merges for long is bound by the coordinator', () => {
    const events = [held('plan', 0, 0, 10), held('partition-0000', 10, 10, 40), held('merge', 40, 40, 100)];
    const verdict = verdictOf(data(100, events, [history('partition-0000', 30, { training: 30 })]));
    assert.equal(verdict?.bound, 'coordinator');
    assert.match(verdict.text, /its own work, mostly merging, took 70 % of the time/);
    assert.deepEqual(shares(verdict), { training: 30, coordinator: 70 });
});

test('a job whose tasks nobody takes is bound by lack of workers', () => {
    const events = [held('plan', 0, 0, 5), [stage(5, 'global')]];
    const verdict = verdictOf(data(100, events, [], 0, ['global']));
    assert.equal(verdict?.bound, 'waiting');
    assert.match(verdict.text, /for 95 % of the time no worker took its tasks/);
});

test('where nothing takes much, nothing bounds the job', () => {
    const verdict = verdictOf(
        data(
            100,
            [held('global', 0, 0, 100)],
            [history('global', 100, { training: 35, photographs: 33, fetching: 30, watching: 2 })],
        ),
    );
    assert.equal(verdict?.bound, 'nothing');
    assert.match(verdict.text, /training \(35 %\) and decoding photographs \(33 %\)/);
});

test('there is no verdict of a short time, or where workers report no times', () => {
    const short = [history('global', 15, { training: 15 })];
    assert.equal(verdictOf(data(15, [held('global', 0, 0, 15)], short)), null);
    assert.equal(verdictOf(data(100, [held('global', 0, 0, 100)])), null);
    assert.equal(verdictOf(data(100, [])), null);
});

test('a task that was given back waits again', () => {
    const events = [
        [stage(0, 'global'), event(0, 'global', 'running'), event(20, 'global', 'ready')],
        [event(80, 'global', 'running', 2), event(100, 'global', 'done', 2)],
    ];
    const verdict = verdictOf(data(100, events, [history('global', 40, { training: 40 })]));
    assert.equal(verdict?.bound, 'waiting');
    assert.deepEqual(shares(verdict), { training: 40, waiting: 60 });
});

test('pauses do not count', () => {
    const events = [held('global', 0, 0, 50), [ofJob(50, 'paused'), ofJob(1000, 'running')]];
    const verdict = verdictOf(data(1000, events, [history('global', 50, { training: 50 })]));
    assert.deepEqual(shares(verdict), { training: 100 });
    assert.equal(verdict?.parts[0]?.seconds, 50);
});

test('every attempt counts with its last report', () => {
    const points = [
        { attempt: 1, progress: { timeSpent: spent(10, { training: 5 }) } },
        { attempt: 1, progress: { timeSpent: spent(20, { training: 15 }) } },
        { attempt: 2, progress: { timeSpent: spent(7, { training: 6, sending: 1 }) } },
        { attempt: 2, progress: { iteration: 9 } },
    ];
    const { all, training, sending } = spentBy(create(TaskHistorySchema, { points }).points);
    assert.deepEqual([all, training, sending], [27, 21, 1]);
});
