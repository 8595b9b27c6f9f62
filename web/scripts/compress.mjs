// Compresses each file of a folder (dist/ if none is named) to NAME.gz and removes the raw one, so that the build can be committed and
// served as it is. gzip, because browsers accept brotli only over TLS. The header has no time stamp.

import { readFileSync, readdirSync, rmSync, statSync, writeFileSync } from 'node:fs';
import { join, relative } from 'node:path';
import { gzipSync } from 'node:zlib';

const DIST = process.argv[2] ?? new URL('../dist/', import.meta.url).pathname;
const MOST_BYTES = 1_500_000;

const files = readdirSync(DIST, { recursive: true })
    .map((name) => join(DIST, String(name)))
    .filter((path) => statSync(path).isFile() && !path.endsWith('.gz'));
if (files.length === 0) {
    throw new Error(`no files in ${DIST}: run vite build first`);
}
let total = 0;
for (const path of files) {
    const raw = readFileSync(path);
    const packed = gzipSync(raw, { level: 9 });
    writeFileSync(`${path}.gz`, packed);
    rmSync(path);
    total += packed.length;
    console.log(`${relative(DIST, path)}.gz  ${raw.length} -> ${packed.length} bytes`);
}
console.log(`${total} bytes in all`);
if (total > MOST_BYTES) {
    throw new Error(`dist has ${total} bytes; it may have ${MOST_BYTES}`);
}
