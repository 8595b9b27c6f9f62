// Which lines of a log are shown.

import assert from 'node:assert/strict';
import { test } from 'node:test';

import { create } from '@bufbuild/protobuf';
import { timestampFromMs } from '@bufbuild/protobuf/wkt';

import { admits, admitted, filterOf, lineOf } from '../../src/pages/job/log.ts';
import { LogEntrySchema, LogSeverity } from '../../src/rpc/fathom/v1/log_pb.ts';

const { DEBUG, INFO, WARN, ERROR } = LogSeverity;
const LINES = (
    [
        ['', INFO, 'planned 2 partitions'],
        ['partition-0000', INFO, 'Iteration 100'],
        ['partition-0001', WARN, 'slow disk'],
        ['partition-0001', DEBUG, 'iteration 100'],
        ['partition-0001', ERROR, 'Out of memory at ITERATION 200'],
        ['partition-00010', INFO, 'another task'],
    ] as const
).map(([taskId, severity, message]) => lineOf(create(LogEntrySchema, { taskId, severity, message, attempt: 1 })));
const shown = (task: string, level: LogSeverity, text: string): number[] =>
    admitted(filterOf(task, String(level), text), LINES);

test('without a filter all lines are shown, in their order', () => {
    assert.deepEqual(shown('', LogSeverity.UNSPECIFIED, ''), [0, 1, 2, 3, 4, 5]);
    assert.deepEqual(shown('', LogSeverity.UNSPECIFIED, '  '), [0, 1, 2, 3, 4, 5]);
});

test('a task shows its own lines, and not those of a longer name', () => {
    assert.deepEqual(shown('partition-0001', LogSeverity.UNSPECIFIED, ''), [2, 3, 4]);
    assert.deepEqual(shown('partition-0002', LogSeverity.UNSPECIFIED, ''), []);
});

test('a level shows its lines and those above', () => {
    assert.deepEqual(shown('', INFO, ''), [0, 1, 2, 4, 5]);
    assert.deepEqual(shown('', WARN, ''), [2, 4]);
    assert.deepEqual(shown('', ERROR, ''), [4]);
});

test('text is found anywhere in a message, in any case, and only as it is written', () => {
    assert.deepEqual(shown('', LogSeverity.UNSPECIFIED, ' iteration '), [1, 3, 4]);
    assert.deepEqual(shown('', LogSeverity.UNSPECIFIED, 'SLOW DISK'), [2]);
    assert.deepEqual(shown('', LogSeverity.UNSPECIFIED, '.*'), [], 'it is no pattern');
    assert.deepEqual(shown('', LogSeverity.UNSPECIFIED, 'partition-0001'), [], 'the task is not the message');
});

test('task, level and text must all hold', () => {
    assert.deepEqual(shown('partition-0001', INFO, 'iteration'), [4]);
    assert.deepEqual(shown('partition-0000', WARN, 'iteration'), []);
    const filter = filterOf('partition-0001', String(ERROR), 'memory');
    assert.deepEqual(LINES.filter((line) => admits(filter, line)).map(({ level }) => level), [ERROR]);
});

test('a line has the time, the attempt and the worker of its entry', () => {
    const entry = { taskId: 'merge', severity: WARN, message: 'm', attempt: 2, worker: 'w', time: timestampFromMs(7000) };
    assert.deepEqual(lineOf(create(LogEntrySchema, entry)), {
        timeMs: 7000,
        level: WARN,
        task: 'merge',
        attempt: 2,
        worker: 'w',
        message: 'm',
    });
});
