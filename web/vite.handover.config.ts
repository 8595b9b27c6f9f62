// The build of the page that `fathom export --html` fills: everything in one file, which browsers open from a
// disk. Its policy allows exactly the script and the style that are in it.
import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { type Plugin, build, defineConfig } from 'vite';

const POLICY = (script: string, style: string): string =>
    `default-src 'none'; script-src ${script}; style-src ${style}; img-src blob:; worker-src blob:; ` +
    "base-uri 'none'; form-action 'none'";

const hashOf = (text: string): string => `'sha256-${createHash('sha256').update(text).digest('base64')}'`;

const WORKER = new URL('src/viewer/sort-worker.ts', import.meta.url).pathname;
const INLINE = new URL('src/viewer/start-sorting-inline.ts', import.meta.url).pathname;

/** The sorter's worker as a text in the script: `virtual:sort-worker`, built to one script without imports. */
const inlineWorker: Plugin = {
    name: 'inline-worker',
    enforce: 'pre',
    resolveId(id) {
        if (id === 'virtual:sort-worker') {
            return `\0${id}`;
        }
        return id === './start-sorting.ts' ? INLINE : null;
    },
    async load(id) {
        if (id !== '\0virtual:sort-worker') {
            return null;
        }
        const lib = { entry: WORKER, formats: ['iife' as const], name: 'sorting', fileName: 'sorting' };
        const built = await build({
            configFile: false,
            logLevel: 'warn',
            build: { target: 'es2022', write: false, lib },
        });
        const [first] = Array.isArray(built) ? built : [built];
        if (first === undefined || !('output' in first)) {
            throw new Error('the worker gives no script');
        }
        return `export default ${JSON.stringify(first.output[0].code)};`;
    },
};

/** Puts script and style into the page, with the policy before them and the engine's licence. */
const oneFile: Plugin = {
    name: 'one-file',
    enforce: 'post',
    generateBundle(_, bundle) {
        const outputs = Object.values(bundle);
        const page = outputs.find((output) => output.fileName === 'handover.html');
        const [script, ...more] = outputs.filter((output) => output.type === 'chunk');
        const [style, ...others] = outputs.filter((output) => output.fileName.endsWith('.css'));
        if (page?.type !== 'asset' || script === undefined || style?.type !== 'asset' || more.length + others.length > 0) {
            throw new Error(`expected a page, a script and a style: ${outputs.map(({ fileName }) => fileName).join(', ')}`);
        }
        // What would end the element is the same text in a string, a template or a regular expression.
        const code = `\n${script.code.replaceAll('</script', String.raw`<\/script`).replaceAll('<!--', String.raw`\x3C!--`)}`;
        const css = `\n${String(style.source)}`;
        const licence = readFileSync(new URL('node_modules/playcanvas/LICENSE', import.meta.url), 'utf8');
        const policy = POLICY(hashOf(code), hashOf(css));
        const head = String(page.source)
            .replace(/\s*<script type="module"[^>]*><\/script>/, '')
            .replace(/\s*<link rel="stylesheet"[^>]*>/, '');
        // Functions, because `$` has a meaning in replacements.
        const html = head
            .replace('<meta charset="utf-8">', (tag) => `${tag}\n        <meta http-equiv="content-security-policy" content="${policy}">`)
            .replace('</head>', () => `    <style>${css}</style>\n        <script type="module">${code}</script>\n    </head>`)
            .replace('<!doctype html>', (tag) => `${tag}\n<!-- The viewer contains PlayCanvas.\n\n${licence.replaceAll('--', '- -')}-->`);
        for (const { fileName } of outputs) {
            delete bundle[fileName];
        }
        this.emitFile({ type: 'asset', fileName: 'handover.html', source: html });
    },
};

export default defineConfig({
    base: './',
    plugins: [inlineWorker, oneFile],
    build: {
        target: 'es2022',
        modulePreload: { polyfill: false },
        chunkSizeWarningLimit: 3000,
        cssCodeSplit: false,
        rolldownOptions: { input: 'handover.html' },
    },
});
