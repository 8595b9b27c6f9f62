// The worker that sorts, from a text in the script: a page that is opened as a file cannot load another one.

import source from 'virtual:sort-worker';

export const startSorting = (): Worker =>
    // The address stays: a browser may fetch it later, and the text is short.
    new Worker(URL.createObjectURL(new Blob([source], { type: 'text/javascript' })));
