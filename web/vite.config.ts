// The build: two pages, relative addresses, no inline code, so that they work below any path and under a
// strict content security policy.
import { readFileSync } from 'node:fs';
import { type Plugin, defineConfig } from 'vite';

const read = (path: string): string => readFileSync(new URL(path, import.meta.url), 'utf8');

/** The comment at the top of a source. */
const heading = (path: string): string => /^(\/\/.*\n)+/.exec(read(path))?.[0].replace(/^\/\/ ?/gm, '') ?? '';

/** Packages whose code is in the pages. Their licences ask for their texts beside every copy. */
const licences: Plugin = {
    name: 'licences',
    generateBundle() {
        const texts = [
            `The pages contain PlayCanvas.\n\n${read('node_modules/playcanvas/LICENSE')}`,
            `The pages contain uPlot.\n\n${read('node_modules/uplot/LICENSE')}`,
            `The pages contain Connect for ECMAScript.\n\n${heading('node_modules/@connectrpc/connect/dist/esm/connect-error.js')}`,
            `The pages contain Protobuf-ES.\n\n${heading('node_modules/@bufbuild/protobuf/dist/esm/create.js')}`,
            `Parts of Protobuf-ES:\n\n${heading('node_modules/@bufbuild/protobuf/dist/esm/wire/varint.js')}`,
            read('../LICENSE-APACHE'),
        ];
        this.emitFile({ type: 'asset', fileName: 'licences.txt', source: texts.join('\n\n') });
    },
};

/** The service behind `npm run dev`. Host stays as it is: the service compares it with Origin. */
const service = process.env['FATHOM_WEB'] ?? 'http://127.0.0.1:7480';

export default defineConfig({
    base: './',
    plugins: [licences],
    build: {
        target: 'es2022',
        // Inlined files would be `data:` addresses, which the policy forbids for scripts.
        assetsInlineLimit: 0,
        modulePreload: { polyfill: false },
        chunkSizeWarningLimit: 3000,
        rolldownOptions: { input: ['index.html', 'view.html'] },
    },
    worker: { format: 'es' },
    server: { proxy: { '^/(api|fathom\\.)': { target: service, changeOrigin: false } } },
});
