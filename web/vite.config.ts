// The build: one page, relative addresses, no inline code, so that it works below any path and under a strict
// content security policy.
import { readFileSync } from 'node:fs';
import { type Plugin, defineConfig } from 'vite';

/** The engine's licence asks for its text beside every copy. */
const licences: Plugin = {
    name: 'licences',
    generateBundle() {
        const text = readFileSync(new URL('node_modules/playcanvas/LICENSE', import.meta.url), 'utf8');
        this.emitFile({ type: 'asset', fileName: 'licences.txt', source: `The viewer contains PlayCanvas.\n\n${text}` });
    },
};

export default defineConfig({
    base: './',
    plugins: [licences],
    build: {
        target: 'es2022',
        // Inlined files would be `data:` addresses, which the policy forbids for scripts.
        assetsInlineLimit: 0,
        modulePreload: { polyfill: false },
        chunkSizeWarningLimit: 3000,
        rolldownOptions: { input: 'view.html' },
    },
    worker: { format: 'es' },
});
