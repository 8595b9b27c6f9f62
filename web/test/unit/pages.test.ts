// The logic of the pages: addresses, words, merging, following.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { create } from '@bufbuild/protobuf';
import { timestampFromMs } from '@bufbuild/protobuf/wkt';
import { Code, ConnectError } from '@connectrpc/connect';

import { Backoff, Connection } from '../../src/pages/connection.ts';
import { Fault, faultOf, faultOfResponse } from '../../src/pages/faults.ts';
import { agoText, bytesText, countText, durationText, percentText, sentence } from '../../src/pages/format.ts';
import { follow } from '../../src/pages/job/follow.ts';
import { digestsOf } from '../../src/pages/job/photographs.ts';
import { JobRecord, mergedPoints } from '../../src/pages/job/record.ts';
import { flattened, valueText } from '../../src/pages/job/settings.ts';
import type { CurvePoint } from '../../src/pages/parts/index.ts';
import { DATASETS_LINK, jobLink, jobsLink, newJobLink, readRoute, serviceLink, shareLink, takeToken } from '../../src/pages/route.ts';
import { rateText } from '../../src/pages/service/workers.ts';
import type { Visibility } from '../../src/pages/visibility.ts';
import { shownState, taskLabel } from '../../src/pages/words.ts';
import {
    type Job,
    type JobEvent,
    JobEventSchema,
    JobSchema,
    JobState,
    JobStateChangedSchema,
    Stage,
    TaskChangedSchema,
    TaskProgressSchema,
    TaskState,
} from '../../src/rpc/fathom/v1/job_pb.ts';
import { ErrorInfoSchema } from '../../src/rpc/google/rpc/error_details_pb.ts';

test('an address leads to a page and back', () => {
    assert.deepEqual(readRoute(''), { page: 'jobs', filter: { state: '', name: '' } });
    assert.deepEqual(readRoute('#/'), { page: 'jobs', filter: { state: '', name: '' } });
    for (const filter of [{ state: 'running', name: '' }, { state: '', name: 'a & b?#' }, { state: 'paused', name: 'reef' }]) {
        assert.deepEqual(readRoute(jobsLink(filter)), { page: 'jobs', filter });
    }
    assert.deepEqual(readRoute(jobLink('0198/x y')), { page: 'job', id: '0198/x y', section: 'overview' });
    assert.deepEqual(readRoute(jobLink('7', 'log')), { page: 'job', id: '7', section: 'log' });
    assert.deepEqual(readRoute(serviceLink()), { page: 'service', section: 'workers' });
    assert.deepEqual(readRoute(serviceLink('tokens')), { page: 'service', section: 'tokens' });
    assert.deepEqual(readRoute(newJobLink()), { page: 'new', dataset: '' });
    assert.deepEqual(readRoute(newJobLink('reef-7')), { page: 'new', dataset: 'reef-7' });
    assert.deepEqual(readRoute(DATASETS_LINK), { page: 'datasets' });
    for (const wrong of ['#/nothing', '#/new/x', '#/datasets/x', '#/jobs/7/nothing', '#/jobs/7/log/more', '#/service/nothing', '#/jobs/%E0%A4%A/x']) {
        assert.equal(readRoute(wrong).page, 'unknown', wrong);
    }
});

test('a token leaves the address, and the rest stays', () => {
    assert.equal(takeToken('#/jobs/7/log'), null);
    assert.equal(takeToken('#/jobs?name=token'), null);
    assert.deepEqual(takeToken('#/jobs/7/viewer?token=s3cret'), { token: 's3cret', isInvitation: false, rest: '#/jobs/7/viewer', isBare: false });
    assert.deepEqual(takeToken('#/jobs?state=failed&token=a%2Bb'), { token: 'a+b', isInvitation: false, rest: '#/jobs?state=failed', isBare: false });
    assert.deepEqual(takeToken('#token=abc&job=7'), { token: 'abc', isInvitation: false, rest: '#/jobs/7', isBare: false });
    assert.deepEqual(takeToken('#token=abc'), { token: 'abc', isInvitation: false, rest: '#/jobs', isBare: true });
    const link = shareLink('https://reef.example/', '7', 'a+/=b');
    assert.deepEqual(takeToken(new URL(link).hash), { token: 'a+/=b', isInvitation: false, rest: '#/jobs/7', isBare: false });
});

test('an invitation leaves the address as a token does, and no token stays with it', () => {
    const isInvitation = true;
    assert.deepEqual(takeToken('#invitation=fathom_a_b'), { token: 'fathom_a_b', isInvitation, rest: '#/jobs', isBare: true });
    assert.deepEqual(takeToken('#invitation=i&job=7'), { token: 'i', isInvitation, rest: '#/jobs/7', isBare: false });
    const both = takeToken('#/jobs/7?invitation=i&token=t&state=failed');
    assert.deepEqual(both, { token: 'i', isInvitation, rest: '#/jobs/7?state=failed', isBare: false });
    assert.equal(takeToken('#invitation='), null);
});

test('numbers and times are short and exact enough', () => {
    assert.deepEqual([0, 1, 999, 1000, 1234, 99_950, 999_499, 999_500, 12_345_678_901n].map(bytesText), [
        '0 bytes', '1 byte', '999 bytes', '1.00 kB', '1.23 kB', '100 kB', '999 kB', '1.00 MB', '12.3 GB',
    ]);
    assert.deepEqual([0, 0.4, 59, 61, 599, 3599, 3600, 90_061, Number.NaN].map(durationText), [
        '0 s', '0 s', '59 s', '1 min 1 s', '9 min 59 s', '59 min', '1 h', '1 d 1 h', '',
    ]);
    assert.deepEqual([0, 0.005, 0.29, 0.999, 1, 1.2].map(percentText), ['0 %', '0 %', '29 %', '99 %', '100 %', '100 %']);
    assert.equal(agoText(1000, 61_000), '1 min ago');
    assert.equal(agoText(2000, 1000), 'now');
    assert.equal(countText(1_234_567), '1,234,567');
    assert.equal(sentence('there is no job 7'), 'There is no job 7.');
    assert.equal(sentence('name: is too long.'), 'Name: is too long.');
    assert.equal(sentence('model.ply is missing'), 'model.ply is missing.');
});

test('the rate of a worker is empty where nothing is trained', () => {
    assert.deepEqual([0, -1, Number.NaN, 0.0519, 12.345, 1234.5].map(rateText), [
        '', '', '', '0.0519 /s', '12.3 /s', '1,235 /s',
    ]);
});

test('states have words', () => {
    assert.equal(shownState({ state: JobState.RUNNING, waitingReason: 'no worker' }), 'waiting');
    assert.equal(shownState({ state: JobState.PAUSED, waitingReason: 'no worker' }), 'paused');
    assert.equal(taskLabel('partition-0003'), 'Partition 3');
    assert.equal(taskLabel('first_part-0000'), 'First part of partition 0');
    assert.equal(taskLabel('evaluate'), 'Evaluation');
});

const withReason = (code: Code, reason: string): ConnectError =>
    new ConnectError('the reason', code, undefined, [{ desc: ErrorInfoSchema, value: { reason, domain: 'fathom' } }]);

test('an error is from the connection unless the service gives a reason', async () => {
    const kinds: readonly (readonly [unknown, string, string])[] = [
        [new ConnectError('', Code.Unavailable), 'lost', ''],
        [new ConnectError('missing trailer', Code.Unknown), 'lost', ''],
        [new TypeError('Failed to fetch'), 'lost', ''],
        [withReason(Code.Unavailable, 'STORE_FAILED'), 'lost', 'STORE_FAILED'],
        [withReason(Code.Internal, 'BLOB_CORRUPT'), 'refused', 'BLOB_CORRUPT'],
        [withReason(Code.NotFound, 'JOB_NOT_FOUND'), 'refused', 'JOB_NOT_FOUND'],
        [withReason(Code.Unauthenticated, 'TOKEN_REFUSED'), 'token', 'TOKEN_REFUSED'],
        [new ConnectError('', Code.Canceled), 'ended', ''],
        [new DOMException('', 'AbortError'), 'ended', ''],
        [new ConnectError('', Code.Unimplemented), 'unknown call', ''],
        [new Error('else'), 'refused', ''],
    ];
    for (const [error, kind, reason] of kinds) {
        const fault = faultOf(error);
        assert.deepEqual([fault.kind, fault.reason], [kind, reason], String(error));
    }
    const answer = JSON.stringify({ error: { reason: 'JOB_NOT_FOUND', message: 'there is no job 7' } });
    const fault = await faultOfResponse(new Response(answer, { status: 404 }));
    assert.deepEqual([fault.kind, fault.reason, fault.message], ['refused', 'JOB_NOT_FOUND', 'There is no job 7.']);
    assert.equal((await faultOfResponse(new Response('<html>', { status: 502 }))).kind, 'lost');
    assert.equal((await faultOfResponse(new Response('{}', { status: 401 }))).kind, 'token');
});

test('the connection says each change once', () => {
    const said: boolean[] = [];
    const connection = new Connection();
    const stop = connection.listen((isLost) => said.push(isLost));
    connection.answered();
    connection.lost();
    connection.lost();
    connection.answered();
    stop();
    connection.lost();
    assert.deepEqual(said, [true, false]);
});

test('pauses double up to a limit, and begin again', () => {
    const backoff = new Backoff(() => 1);
    assert.deepEqual([1, 2, 3, 4, 5, 6].map(() => backoff.next()), [500, 1000, 2000, 4000, 5000, 5000]);
    backoff.reset();
    assert.equal(backoff.next(), 500);
    assert.equal(new Backoff(() => 0).next(), 375);
});

const job = (lastSeq: bigint, more: Partial<Pick<Job, 'progress' | 'state'>> = {}): Job =>
    create(JobSchema, {
        jobId: '7',
        lastSeq,
        state: JobState.RUNNING,
        tasks: [{ taskId: 'plan', stage: Stage.PLAN, state: TaskState.DONE }, { taskId: 'partition-0000', stage: Stage.PARTITION, state: TaskState.READY }],
        ...more,
    });
const event = (seq: bigint, of: JobEvent['event'], ms = 1000): JobEvent => {
    const made = create(JobEventSchema, { jobId: '7', seq, time: timestampFromMs(ms) });
    made.event = of;
    return made;
};
const changed = (seq: bigint, state: TaskState, attempt = 1): JobEvent =>
    event(seq, {
        case: 'taskChanged',
        value: create(TaskChangedSchema, { taskId: 'partition-0000', state, attempt, worker: 'w' }),
    });

test('events of the past are listed and change nothing', () => {
    const record = new JobRecord();
    record.snapshot(job(5n));
    record.apply(changed(4n, TaskState.LEASED));
    assert.equal(record.job?.tasks[1]?.state, TaskState.READY);
    assert.equal(record.events.length, 1);
    record.apply(changed(6n, TaskState.LEASED, 2));
    assert.deepEqual([record.job?.tasks[1]?.state, record.job?.tasks[1]?.attempts], [TaskState.LEASED, 2]);
    assert.deepEqual(record.events[1], { kind: 'task', task: 'partition-0000', state: 'running', attempt: 2, worker: 'w', message: '', resumedFrom: 0, timeMs: 1000 });
});

test('an event that comes twice counts once', () => {
    const record = new JobRecord();
    record.snapshot(job(0n));
    assert.equal(record.apply(changed(1n, TaskState.LEASED)), true);
    assert.equal(record.apply(changed(1n, TaskState.LEASED)), false);
    assert.equal(record.events.length, 1);
    assert.equal(record.lastSeq, 1n);
});

test('a snapshot older than the events is refused', () => {
    const record = new JobRecord();
    record.snapshot(job(1n));
    record.apply(changed(2n, TaskState.LEASED));
    assert.equal(record.snapshot(job(1n)), false);
    assert.equal(record.job?.tasks[1]?.state, TaskState.LEASED);
    assert.equal(record.snapshot(job(2n, { progress: 0.5 })), true);
    assert.equal(record.job?.progress, 0.5);
});

test('progress moves the job and adds a point', () => {
    const record = new JobRecord();
    record.snapshot(job(3n));
    const value = create(TaskProgressSchema, { taskId: 'partition-0000', progress: { iteration: 10, iterations: 20, loss: 0.5 }, jobProgress: 0.4 });
    assert.equal(record.apply(event(3n, { case: 'progress', value }, 2000)), true);
    assert.equal(record.job?.progress, 0.4);
    const expected = { timeMs: 2000, attempt: 1, iteration: 10, loss: 0.5, psnr: null, gaussians: 0, rate: 0, memoryBytes: 0 };
    assert.deepEqual(record.points.get('partition-0000'), [expected]);
});

test('the end of a job is taken from its event', () => {
    const record = new JobRecord();
    record.snapshot(job(3n));
    record.apply(event(4n, { case: 'jobState', value: create(JobStateChangedSchema, { state: JobState.FAILED, message: 'no memory' }) }));
    assert.deepEqual([record.job?.state, record.job?.error], [JobState.FAILED, 'no memory']);
});

test('points that are kept and those that arrived are joined once', () => {
    const at = (timeMs: number): CurvePoint => ({ timeMs, attempt: 1, iteration: timeMs, loss: 0, psnr: null, gaussians: 0, rate: 0, memoryBytes: 0 });
    assert.deepEqual(mergedPoints([at(1), at(2)], [at(2), at(3)]).map(({ timeMs }) => timeMs), [1, 2, 3]);
    // The same iteration, dated when it was measured and when it was sent.
    assert.deepEqual(mergedPoints([at(1), { ...at(2), timeMs: 1.7 }], [at(2), at(3)]).map(({ iteration }) => iteration), [1, 2, 3]);
    assert.deepEqual(mergedPoints([], [at(2)]).map(({ timeMs }) => timeMs), [2]);
});

/** A stream of `count` items that then ends or breaks. */
async function* stream(first: number, count: number, error: Error | null): AsyncGenerator<number> {
    for (let item = first; item < first + count; item += 1) {
        yield item;
    }
    if (error !== null) {
        throw error;
    }
}

const SEEN: Visibility = { isHidden: false, listen: () => () => {} };
const noPause = new Backoff(() => 0);
noPause.next = () => 0;

test('a broken stream is opened again after what has arrived', async () => {
    const items: number[] = [];
    let opened = 0;
    await follow(
        {
            open: () => {
                opened += 1;
                return stream(items.length, 3, opened < 3 ? new ConnectError('broken', Code.Unavailable) : null);
            },
            onItem: (item) => items.push(item),
            faultOf,
            isComplete: () => items.length >= 9,
            backoff: noPause,
            visibility: SEEN,
        },
        new AbortController().signal,
    );
    assert.deepEqual(items, [0, 1, 2, 3, 4, 5, 6, 7, 8]);
    assert.equal(opened, 3);
});

test('a stream that the service refuses is not opened again', async () => {
    let opened = 0;
    const following = follow(
        {
            open: () => {
                opened += 1;
                return stream(0, 0, withReason(Code.NotFound, 'JOB_NOT_FOUND'));
            },
            onItem: () => {},
            faultOf,
            isComplete: () => false,
            backoff: noPause,
            visibility: SEEN,
        },
        new AbortController().signal,
    );
    await assert.rejects(following, (error: unknown) => error instanceof Fault && error.reason === 'JOB_NOT_FOUND');
    assert.equal(opened, 1);
});

test('a stream that falls silent is opened again', async () => {
    let opened = 0;
    await follow(
        {
            async *open(signal) {
                opened += 1;
                yield opened;
                if (opened === 1) {
                    await new Promise((_, reject) => {
                        signal.addEventListener('abort', () => reject(new DOMException('', 'AbortError')), { once: true });
                    });
                }
            },
            onItem: () => {},
            faultOf,
            isComplete: () => opened === 2,
            backoff: noPause,
            visibility: SEEN,
            silenceMs: 20,
        },
        new AbortController().signal,
    );
    assert.equal(opened, 2);
});

test('a hidden page closes its stream, and opens it when it is seen again', async () => {
    const listeners = new Set<() => void>();
    let isHidden = false;
    const set = (now: boolean): void => {
        isHidden = now;
        listeners.forEach((listener) => listener());
    };
    const visibility: Visibility = {
        get isHidden() {
            return isHidden;
        },
        listen: (listener) => {
            listeners.add(listener);
            return () => listeners.delete(listener);
        },
    };
    const log: string[] = [];
    await follow(
        {
            async *open(signal) {
                log.push('open');
                yield 0;
                if (log.length === 1) {
                    set(true);
                    await new Promise((_, reject) => {
                        signal.addEventListener('abort', () => reject(new DOMException('', 'AbortError')), { once: true });
                    }).catch((error: unknown) => {
                        log.push('closed');
                        setTimeout(() => {
                            log.push('seen');
                            set(false);
                        }, 10);
                        throw error;
                    });
                }
            },
            onItem: () => {},
            faultOf,
            isComplete: () => log.length > 1,
            backoff: noPause,
            visibility,
            hiddenMs: 5,
        },
        new AbortController().signal,
    );
    assert.deepEqual(log, ['open', 'closed', 'seen', 'open']);
    assert.equal(listeners.size, 0);
});

test('following ends when the page is left', async () => {
    const stop = new AbortController();
    await follow(
        {
            open: () => stream(0, 1, new ConnectError('broken', Code.Unavailable)),
            onItem: () => stop.abort(),
            faultOf,
            isComplete: () => false,
            visibility: SEEN,
        },
        stop.signal,
    );
});

test('settings are flat and in words', () => {
    assert.deepEqual(flattened({ train: { mip_filter: true, steps: [1, 2], water: { beta: null } }, seed: 7 }), [
        ['train.mip_filter', 'yes'],
        ['train.steps', '[1,2]'],
        ['train.water.beta', 'not set'],
        ['seed', '7'],
    ]);
    assert.equal(valueText(0.5), '0.5');
});

test('photographs are those that the manifest names', () => {
    const manifest = { views: [{ name: 'a.jpg', image: { digest: 'd1', bytes: 3 } }, { name: 'b.jpg' }, null] };
    assert.deepEqual([...digestsOf(manifest)], [['a.jpg', 'd1']]);
    assert.equal(digestsOf('no manifest').size, 0);
});
