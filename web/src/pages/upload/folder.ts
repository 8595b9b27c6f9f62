// Which files of a chosen folder are sent as a dataset, and under which paths.
//
// Junk of operating systems is never sent. What Fathom does not read is left out unless somebody asks for it:
// videos, and what other programs derive from a scene are often larger than the scene. A file that a scene
// names is no such file, so the lists of photographs are searched for its name before.

import type { Found } from './gather.ts';

export interface FolderFile {
    /** Its path in the dataset: relative, in Unicode's form NFC. */
    readonly path: string;
    readonly file: File;
}

/** Files that belong together and can be left out. */
export interface Derived {
    readonly label: string;
    readonly files: readonly FolderFile[];
}

export interface Folder {
    /** What is sent in any case, by path. */
    readonly files: readonly FolderFile[];
    /** What is sent on request. */
    readonly derived: readonly Derived[];
    /** Number of hidden files and of those that systems leave behind. */
    readonly junk: number;
}

/** Larger ones cannot be sent in pieces: the service reads what it has at each (`upload.proto`). */
export const MOST_FILE_BYTES = 256 * 1024 * 1024;
const MOST_PATH_BYTES = 1024;
/** Lists of photographs that are larger are not searched. */
const MOST_SEARCHED_BYTES = 1024 * 1024 * 1024;
const MOST_ID = 64;

const JUNK: ReadonlySet<string> = new Set([
    'thumbs.db',
    'ehthumbs.db',
    'desktop.ini',
    '__macosx',
    '@eadir',
    '$recycle.bin',
]);

/** Whether an operating system left this behind, or hides it. */
export const isJunk = (path: string): boolean =>
    path.split('/').some((part) => part.startsWith('.') || JUNK.has(part.toLowerCase()) || part === 'Icon\r');

/** Folders that mean something where a scene begins, so that they are not taken for its outer folder. */
const PARTS_OF_SCENE = /^(?:images(?:_\d+)?|masks(?:_\d+)?|sparse|colmap|dense|\d+)$/i;

/** Without outer folders that hold nothing but the next one, as archives often have them. */
function withoutOuter(files: readonly FolderFile[]): readonly FolderFile[] {
    let inner = files;
    for (;;) {
        const top = inner[0]?.path.split('/', 1)[0] ?? '';
        const begin = `${top}/`;
        if (top === '' || PARTS_OF_SCENE.test(top) || !inner.every(({ path }) => path.startsWith(begin))) {
            return inner;
        }
        inner = inner.map(({ path, file }) => ({ path: path.slice(begin.length), file }));
    }
}

const surrogatesLast = (unit: number): number => (unit >= 0xd800 && unit < 0xe000 ? unit + 0x10000 : unit);

/** Order of the UTF-8 bytes of two texts. JavaScript compares UTF-16, where surrogates come before U+E000. */
export function byUtf8(a: string, b: string): number {
    const length = Math.min(a.length, b.length);
    for (let at = 0; at < length; at += 1) {
        const [left, right] = [a.charCodeAt(at), b.charCodeAt(at)];
        if (left !== right) {
            return surrogatesLast(left) - surrogatesLast(right);
        }
    }
    return a.length - b.length;
}

/** Why a dataset cannot have a file at this path; null if it can. */
export function faultOfPath(path: string): string | null {
    const bytes = new TextEncoder().encode(path).length;
    const parts = path.split('/');
    if (!path.isWellFormed()) {
        return 'its name is not Unicode; rename it';
    }
    if (bytes > MOST_PATH_BYTES) {
        return `its path has ${bytes} bytes, and at most ${MOST_PATH_BYTES} are allowed; shorten the names`;
    }
    if (/\p{Cc}/u.test(path)) {
        return 'its name has a control character; rename it';
    }
    if (path.includes('\\')) {
        return 'its name has a backslash; rename it';
    }
    if (parts.some((part) => /^[a-z]:/i.test(part))) {
        return 'its name begins like a drive ("C:"); rename it';
    }
    return parts.some((part) => part === '' || part === '.' || part === '..')
        ? 'its path has an empty part, "." or ".."'
        : null;
}

/** What forbids to send these files, one sentence each. */
export function faultsOf(files: readonly FolderFile[]): readonly string[] {
    const faults: string[] = [];
    const paths = new Set<string>();
    for (const { path, file } of files) {
        const fault = faultOfPath(path);
        if (fault !== null) {
            faults.push(`${JSON.stringify(path.slice(0, 200))}: ${fault}.`);
        } else if (paths.has(path)) {
            faults.push(
                `"${path}" is there twice, in two spellings of the same letters. Rename one of them.`,
            );
        } else if (file.size > MOST_FILE_BYTES) {
            faults.push(
                `"${path}" is larger than 256 MiB, the most that a page can send. ` +
                    'Send this folder with "fathom dataset upload" instead.',
            );
        }
        paths.add(path);
    }
    for (const { path } of files) {
        for (let at = path.indexOf('/'); at >= 0; at = path.indexOf('/', at + 1)) {
            if (paths.has(path.slice(0, at))) {
                faults.push(
                    `"${path.slice(0, at)}" is a file and a folder, in two spellings of the same letters. ` +
                        'Rename one of them.',
                );
            }
        }
    }
    return [...new Set(faults)];
}

interface Kind {
    /** What to call it, for a path that belongs to it; null for others. */
    of(path: string, all: ReadonlySet<string>): { readonly label: string; readonly mention: string } | null;
}

/** The folders of a path, each with `/` at its end, the outermost first. */
const foldersOf = (path: string): readonly string[] =>
    [...path.matchAll(/\//g)].map(({ index }) => path.slice(0, index + 1));

const ofFile = (pattern: RegExp, label: string): Kind => ({
    of: (path) => (pattern.test(path) ? { label, mention: path.split('/').at(-1)! } : null),
});

/**
 * What a scene is made of, and what COLMAP, nerfstudio and 3DGS derive. `mention` is how a scene would name
 * it.
 */
const KINDS: readonly Kind[] = [
    ofFile(/(?:^|\/)database\.db(?:-shm|-wal)?$/i, 'COLMAP database'),
    {
        // Copies of images/ at a half, a quarter and so on.
        of: (path, all) => {
            const [, folder = '', base = '', name = ''] =
                /^((?:.*\/)?)(images|masks)(_\d+)\//.exec(path) ?? [];
            const isCopy = name !== '' && all.has(`${folder}${base}/`);
            return isCopy
                ? { label: `Smaller copies: ${folder}${base}${name}`, mention: `${base}${name}/` }
                : null;
        },
    },
    {
        // Beside a sparse model, the dense workspace is never read.
        of: (path, all) => {
            const hasModel = all.has('sparse/') || all.has('colmap/sparse/');
            return hasModel && path.startsWith('dense/')
                ? { label: 'Dense reconstruction: dense', mention: 'dense/' }
                : null;
        },
    },
    {
        of: (path, all) => {
            const folder = foldersOf(path).find((one) => /(?:^|\/)stereo\/$/.test(one));
            const isStereo =
                folder !== undefined &&
                ['depth_maps/', 'normal_maps/', 'consistency_graphs/'].some((name) =>
                    all.has(`${folder}${name}`),
                );
            return isStereo
                ? { label: `Dense reconstruction: ${folder.slice(0, -1)}`, mention: 'stereo/' }
                : null;
        },
    },
    ofFile(
        /(?:^|\/)(?:fused\.ply(?:\.vis)?|meshed-(?:poisson|delaunay)\.ply)$/i,
        'Dense reconstruction: points and meshes',
    ),
    ofFile(/\.(?:avi|insv|lrv|m4v|mkv|mov|mp4|mpe?g|mts|webm)$/i, 'Videos'),
    ofFile(/\.(?:arw|cr[23]|dng|nef|orf|raf|raw|rw2)$/i, 'Raw photographs'),
    ofFile(/\.(?:7z|bz2|gz|rar|tar|tgz|xz|zip)$/i, 'Archives'),
    ofFile(/(?:^|\/)point_cloud\/iteration_\d+\/point_cloud\.ply$/i, 'Trained models'),
];

/** Files in which a scene names its photographs, masks and points. */
const isListOfNames = (path: string): boolean =>
    /(?:^|\/)(?:images\.(?:txt|bin)|(?:transforms[^/]*|cameras|manifest)\.json)$/i.test(path);

/** Which of these texts a file contains. It is read in pieces. */
async function mentionsIn(file: File, wanted: ReadonlySet<string>): Promise<readonly string[]> {
    const decoder = new TextDecoder('latin1');
    const overlap = Math.max(...[...wanted].map(({ length }) => length));
    const found = new Set<string>();
    let before = '';
    const reader = file.stream().getReader();
    for (let read = await reader.read(); !read.done && found.size < wanted.size; read = await reader.read()) {
        // JSON may write a slash with a backslash, and Windows the backslash alone.
        const text = `${before}${decoder.decode(read.value)}`.replaceAll(/\\+\/?/g, '/');
        wanted.forEach((one) => text.includes(one) && found.add(one));
        before = text.slice(-overlap);
    }
    await reader.cancel();
    return [...found];
}

/** Sorts out the files of a folder. */
export async function readFolder(found: readonly Found[]): Promise<Folder> {
    const kept = found
        .filter(({ path }) => !isJunk(path))
        .map(({ path, file }) => ({ path: path.normalize('NFC'), file }));
    const files = withoutOuter(kept).toSorted((a, b) => byUtf8(a.path, b.path));
    const all = new Set(files.flatMap(({ path }) => foldersOf(path)));
    const groups = new Map<string, { readonly mentions: Set<string>; readonly files: FolderFile[] }>();
    for (const file of files) {
        const kind = KINDS.map((one) => one.of(file.path, all)).find((one) => one !== null);
        if (kind !== undefined) {
            const group = groups.get(kind.label) ?? { mentions: new Set(), files: [] };
            group.mentions.add(kind.mention);
            group.files.push(file);
            groups.set(kind.label, group);
        }
    }
    const [isOut, wanted] = [new Set<FolderFile>(), new Set<string>()];
    for (const { files: some, mentions } of groups.values()) {
        some.forEach((file) => isOut.add(file));
        mentions.forEach((mention) => wanted.add(mention));
    }
    const named = new Set<string>();
    if (wanted.size > 0) {
        for (const { file } of files.filter((one) => !isOut.has(one) && isListOfNames(one.path))) {
            const said =
                file.size > MOST_SEARCHED_BYTES ? wanted : await mentionsIn(file, wanted).catch(() => wanted);
            said.forEach((one) => named.add(one));
        }
    }
    const derived = [...groups].filter(([, { mentions }]) => ![...mentions].some((one) => named.has(one)));
    const left = new Set(derived.flatMap(([, { files: some }]) => some));
    return {
        files: files.filter((file) => !left.has(file)),
        derived: derived.map(([label, { files: some }]) => ({ label, files: some })),
        junk: found.length - kept.length,
    };
}

/** Whether a dataset can have this id. */
export const isId = (id: string): boolean => /^[a-z\d][a-z\d_.-]{0,63}$/.test(id);

/** An id from the name of a folder. */
export function idOfName(name: string): string {
    const plain = name
        .normalize('NFKD')
        .toLowerCase()
        .replaceAll(/\p{M}/gu, '')
        .replaceAll(/[^a-z\d_.]+/g, '-')
        .replace(/^[^a-z\d]+/, '')
        .slice(0, MOST_ID)
        .replace(/[-_.]+$/, '');
    return plain === '' ? 'scene' : plain;
}

/** The id itself, or with the first number behind it that is not taken. */
export function freeId(id: string, isTaken: (id: string) => boolean): string {
    for (let number = 1; ; number += 1) {
        const end = number === 1 ? '' : `-${number}`;
        const one = `${id.slice(0, MOST_ID - end.length)}${end}`;
        if (!isTaken(one)) {
            return one;
        }
    }
}

export const bytesOf = (files: readonly FolderFile[]): number =>
    files.reduce((sum, { file }) => sum + file.size, 0);
