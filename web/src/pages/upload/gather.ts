// The files of a folder that somebody drops or chooses.

export interface Found {
    /** Its path in the chosen folder, as the browser gives it. */
    readonly path: string;
    readonly file: File;
}

export interface Chosen {
    /** The name of the folder; empty if several things were dropped. */
    readonly name: string;
    readonly found: readonly Found[];
}

/** What of FileSystemEntry is used; tests have their own. */
export interface Entry {
    readonly name: string;
    readonly isDirectory: boolean;
    file?(done: (file: File) => void, failed: (error: unknown) => void): void;
    createReader?(): {
        readEntries(done: (entries: readonly Entry[]) => void, failed: (error: unknown) => void): void;
    };
}

/** The files of `<input webkitdirectory>`. */
export function filesOfInput(files: Iterable<File>): Chosen {
    const found = [...files].map((file) => ({ path: file.webkitRelativePath || file.name, file }));
    const name = found[0]?.path.split('/')[0] ?? '';
    return {
        name,
        found: found.map(({ path, file }) => ({ path: path.slice(path.indexOf('/') + 1), file })),
    };
}

/** The entries of what was dropped. The list is empty once the event is over, so this must not wait. */
export const entriesOf = (items: Iterable<DataTransferItem>): readonly Entry[] =>
    [...items].map((item) => item.webkitGetAsEntry() as Entry | null).filter((entry) => entry !== null);

/** All files below the dropped entries. `onFound` hears how many there are so far. */
export async function filesOfEntries(
    entries: readonly Entry[],
    onFound: (count: number) => void,
): Promise<Chosen> {
    const [only] = entries;
    const isFolder = entries.length === 1 && only!.isDirectory;
    const found: Found[] = [];
    // The path of each open folder, with a `/` at its end.
    const open: (readonly [folder: Entry, path: string])[] = [];
    const take = async (all: readonly Entry[], below: string): Promise<void> => {
        for (const entry of all) {
            if (entry.isDirectory) {
                open.push([entry, `${below}${entry.name}/`]);
            } else {
                const file = await new Promise<File>((done, failed) => entry.file!(done, failed));
                found.push({ path: `${below}${entry.name}`, file });
            }
        }
        onFound(found.length);
    };
    if (isFolder) {
        open.push([only!, '']);
    } else {
        await take(entries, '');
    }
    for (let next = open.pop(); next !== undefined; next = open.pop()) {
        const [folder, path] = next;
        const reader = folder.createReader!();
        // A call gives at most 100 entries, and none at the end.
        for (;;) {
            const some = await new Promise<readonly Entry[]>((done, failed) =>
                reader.readEntries(done, failed),
            );
            if (some.length === 0) {
                break;
            }
            await take(some, path);
        }
    }
    return { name: isFolder ? only!.name : '', found };
}
