// Proves that generating src/rpc again gives the committed files.

import { execFileSync } from 'node:child_process';
import { mkdtempSync, readFileSync, readdirSync, rmSync, statSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, relative } from 'node:path';

const WEB = join(import.meta.dirname, '..');
const FOLDER = 'src/rpc';

function filesIn(folder: string): string[] {
    const paths = readdirSync(folder, { recursive: true }).map((path) => join(folder, String(path)));
    return paths.filter((path) => statSync(path).isFile()).map((path) => relative(folder, path)).toSorted();
}

const made = mkdtempSync(join(tmpdir(), 'fathom-rpc-'));
try {
    execFileSync('buf', ['generate', '--output', made], { cwd: WEB, stdio: 'inherit' });
    const [ours, theirs] = [join(WEB, FOLDER), join(made, FOLDER)];
    const [committed, generated] = [filesIn(ours), filesIn(theirs)];
    const all = new Set([...committed, ...generated]);
    const wrong = [...all].filter(
        (path) =>
            !committed.includes(path) ||
            !generated.includes(path) ||
            !readFileSync(join(ours, path)).equals(readFileSync(join(theirs, path))),
    );
    if (generated.length === 0 || wrong.length > 0) {
        console.error(`${FOLDER} is not what the protos give: ${wrong.join(', ')}. Run npm run generate and commit it.`);
        process.exitCode = 1;
    }
} finally {
    rmSync(made, { recursive: true });
}
