// What bounds the jobs of the queue: which are asked about, when, and what is said of them.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { create } from '@bufbuild/protobuf';
import { timestampFromMs } from '@bufbuild/protobuf/wkt';

import { verdictOfJob } from '../../src/pages/job/bounds.ts';
import { JobRecord } from '../../src/pages/job/record.ts';
import { BoundsOfJobs, EVERY_MS, MOST_JOBS, type Source } from '../../src/pages/service/bounds-of-jobs.ts';
import {
    type Job,
    type JobEvent,
    JobEventSchema,
    JobSchema,
    JobState,
    Stage,
    TaskHistorySchema,
    TaskState,
} from '../../src/rpc/fathom/v1/job_pb.ts';

const BEGUN_MS = Date.now() - 100_000;
const TASK = { taskId: 'global', stage: Stage.GLOBAL, state: TaskState.LEASED, attempts: 1 };

const jobOf = (jobId: string, lastSeq = 2n): Job =>
    create(JobSchema, {
        jobId,
        state: JobState.RUNNING,
        lastSeq,
        createTime: timestampFromMs(BEGUN_MS),
        tasks: [TASK],
    });
const eventOf = (seq: number): JobEvent =>
    create(JobEventSchema, {
        seq: BigInt(seq),
        time: timestampFromMs(BEGUN_MS + 1000 * seq),
        event:
            seq === 1
                ? { case: 'jobStage', value: { stage: Stage.GLOBAL, tasks: 1 } }
                : {
                      case: 'taskChanged',
                      value: { taskId: 'global', stage: Stage.GLOBAL, state: TaskState.LEASED, attempt: 1 },
                  },
    });
const HISTORY = create(TaskHistorySchema, {
    taskId: 'global',
    points: [{ attempt: 1, progress: { timeSpent: { seconds: 90, trainingSeconds: 80, fetchingSeconds: 5 } } }],
});

/** A service whose answers a test changes, and what it was asked. */
class MadeUp implements Source {
    readonly asked: string[] = [];
    /** Calls in progress, and the most at a time. */
    now = 0;
    most = 0;
    lastSeq = 2n;
    /** The stream breaks off after so many events. */
    breaksAfter = Infinity;
    isDown = false;
    closed = 0;

    async #call<T>(what: string, answer: T): Promise<T> {
        this.asked.push(what);
        this.now += 1;
        this.most = Math.max(this.most, this.now);
        await new Promise((done) => setTimeout(done, 0));
        this.now -= 1;
        if (this.isDown) {
            throw new Error('nobody answers');
        }
        return answer;
    }

    job(id: string): Promise<Job> {
        return this.#call(`job ${id}`, jobOf(id, this.lastSeq));
    }

    async *events(id: string, afterSeq: bigint, signal: AbortSignal): AsyncIterable<JobEvent> {
        await this.#call(`events ${id} after ${afterSeq}`, null);
        signal.addEventListener('abort', () => (this.closed += 1), { once: true });
        for (let seq = Number(afterSeq) + 1; seq <= Number(this.lastSeq); seq += 1) {
            if (seq > this.breaksAfter) {
                throw new Error('broken off');
            }
            yield eventOf(seq);
        }
        // The stream of a running job stays open.
        await new Promise(() => {});
    }

    history(id: string): Promise<{ tasks: (typeof HISTORY)[] }> {
        return this.#call(`history ${id}`, { tasks: [HISTORY] });
    }

    get jobsAsked(): readonly string[] {
        return this.asked.filter((what) => what.startsWith('job ')).map((what) => what.slice(4));
    }
}

function setUp() {
    const source = new MadeUp();
    const page = { isHidden: false };
    const clock = { ms: 0 };
    const leave = new AbortController();
    let changes = 0;
    const bounds = new BoundsOfJobs(
        source,
        page,
        leave.signal,
        () => (changes += 1),
        () => clock.ms,
    );
    return { source, page, clock, leave, bounds, changes: () => changes };
}

const running = (...ids: readonly string[]) => ids.map((jobId) => ({ jobId, state: JobState.RUNNING }));
const NAMES = Array.from({ length: MOST_JOBS + 2 }, (_, at) => `j${at}`);

test('the queue gives the verdict of the Overview', async () => {
    const { bounds } = setUp();
    assert.equal(bounds.of('j0'), null);
    await bounds.take(running('j0'));
    const record = new JobRecord();
    record.snapshot(jobOf('j0'));
    [1, 2].forEach((seq) => record.apply(eventOf(seq)));
    const shown = bounds.of('j0');
    const expected = verdictOfJob(record, [HISTORY]);
    assert.ok(shown !== null && typeof shown !== 'string');
    assert.equal(shown.bound, 'training');
    assert.deepEqual([shown.text, shown.advice], [expected?.text, expected?.advice]);
});

test('the first running jobs are asked about, one at a time', async () => {
    const { bounds, source, changes } = setUp();
    const paused = { jobId: 'p', state: JobState.PAUSED };
    await bounds.take([paused, ...running(...NAMES)]);
    assert.deepEqual(source.jobsAsked, NAMES.slice(0, MOST_JOBS));
    assert.equal(source.most, 1);
    assert.equal(changes(), MOST_JOBS);
    assert.deepEqual(
        ['p', ...NAMES.slice(MOST_JOBS)].map((id) => bounds.of(id)),
        [null, 'in its Overview', 'in its Overview'],
    );
});

test('a job is asked about again after 30 seconds', async () => {
    const { bounds, source, clock } = setUp();
    await bounds.take(running('j0'));
    clock.ms = EVERY_MS - 1;
    await bounds.take(running('j0'));
    assert.deepEqual(source.jobsAsked, ['j0']);
    // Moving down and back up is no way around it.
    await bounds.take(running(...NAMES.slice(1), 'j0'));
    await bounds.take(running('j0'));
    assert.equal(source.jobsAsked.filter((id) => id === 'j0').length, 1);
    // The points of the history make the pause a little longer.
    clock.ms = EVERY_MS + 1;
    await bounds.take(running('j0'));
    assert.equal(source.jobsAsked.filter((id) => id === 'j0').length, 2);
});

test('slow answers leave no job out', async () => {
    const { bounds, source, clock } = setUp();
    const call = source.job.bind(source);
    source.job = (id) => {
        clock.ms += EVERY_MS;
        // Enough for now.
        if (source.jobsAsked.length > 2 * MOST_JOBS) {
            source.isDown = true;
            clock.ms = -1;
        }
        return call(id);
    };
    await bounds.take(running(...NAMES));
    assert.deepEqual(new Set(source.jobsAsked.slice(0, MOST_JOBS)).size, MOST_JOBS);
});

test('a second round waits for the first', async () => {
    const { bounds, source } = setUp();
    const first = bounds.take(running('j0'));
    await bounds.take(running('j0', 'j1'));
    assert.deepEqual(source.jobsAsked, ['j0']);
    await first;
    assert.deepEqual(source.jobsAsked, ['j0', 'j1']);
    assert.equal(source.most, 1);
});

test('nothing is asked while the page is hidden or left', async () => {
    const { bounds, source, page, leave } = setUp();
    page.isHidden = true;
    await bounds.take(running('j0'));
    assert.deepEqual(source.asked, []);
    page.isHidden = false;
    leave.abort();
    await bounds.take(running('j0'));
    assert.deepEqual(source.asked, []);
});

test('the stream is closed after the past, and only news is read', async () => {
    const { bounds, source, clock } = setUp();
    await bounds.take(running('j0'));
    assert.equal(source.closed, 1);
    assert.deepEqual(source.asked, ['job j0', 'events j0 after 0', 'history j0']);
    clock.ms = 2 * EVERY_MS;
    await bounds.take(running('j0'));
    assert.deepEqual(source.asked.slice(3), ['job j0', 'history j0'], 'no event is new');
    source.lastSeq = 3n;
    clock.ms = 4 * EVERY_MS;
    await bounds.take(running('j0'));
    assert.deepEqual(source.asked.slice(5), ['job j0', 'events j0 after 2', 'history j0']);
    assert.equal(source.closed, 2);
});

test('without the whole past there is no verdict', async () => {
    const { bounds, source, clock } = setUp();
    source.breaksAfter = 1;
    await bounds.take(running('j0'));
    assert.equal(bounds.of('j0'), null);
    source.breaksAfter = Infinity;
    clock.ms = 2 * EVERY_MS;
    await bounds.take(running('j0'));
    assert.equal(source.asked.at(-2), 'events j0 after 1', 'what has come is kept');
    assert.notEqual(bounds.of('j0'), null);
});

test('a verdict stays when the service does not answer', async () => {
    const { bounds, source, clock } = setUp();
    await bounds.take(running('j0'));
    const before = bounds.of('j0');
    source.isDown = true;
    clock.ms = 2 * EVERY_MS;
    await bounds.take(running('j0'));
    assert.equal(source.jobsAsked.length, 2);
    assert.notEqual(before, null);
    assert.equal(bounds.of('j0'), before);
});

test('a job that has left the queue is forgotten', async () => {
    const { bounds, source } = setUp();
    await bounds.take(running('j0'));
    await bounds.take([]);
    assert.equal(bounds.of('j0'), null);
    await bounds.take(running('j0'));
    assert.equal(source.asked.filter((what) => what === 'events j0 after 0').length, 2);
});
