// What vite.handover.config.ts brings: the script of the sorter's worker.
declare module 'virtual:sort-worker' {
    const source: string;
    export default source;
}
