// What the headless tests rely on: pages in the dark differ from those in light in their colours alone.

import assert from 'node:assert/strict';
import { globSync, readFileSync } from 'node:fs';
import { join } from 'node:path';
import { test } from 'node:test';

const SOURCES = join(import.meta.dirname, '../../src');

test('style sheets change nothing but variables in the dark', () => {
    let blocks = 0;
    for (const name of globSync('**/*.css', { cwd: SOURCES })) {
        const sheet = readFileSync(join(SOURCES, name), 'utf8').replaceAll(/\/\*[^]*?\*\//g, '');
        for (const [, rules = ''] of sheet.matchAll(/prefers-color-scheme[^{]*\{((?:[^{}]*\{[^{}]*\})*)/g)) {
            blocks += 1;
            for (const [, declarations = ''] of rules.matchAll(/\{([^{}]*)\}/g)) {
                const names = declarations.split(';').map((line) => line.split(':')[0]!.trim());
                const others = names.filter((property) => property !== '' && !property.startsWith('--'));
                assert.deepEqual(others, [], name);
            }
        }
    }
    assert.ok(blocks >= 2, `${blocks} blocks`);
});
