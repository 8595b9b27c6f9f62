// A folder that is sent as a dataset: which files, under which paths, and their digests.

import assert from 'node:assert/strict';
import { test } from 'node:test';


import { digestOfBytes, digestOfFile } from '../../src/pages/upload/digest.ts';
import {
    MOST_FILE_BYTES,
    byUtf8,
    faultOfPath,
    faultsOf,
    freeId,
    idOfName,
    isId,
    isJunk,
    readFolder,
} from '../../src/pages/upload/folder.ts';
import { progressText } from '../../src/pages/upload/folder-panel.ts';
import { type Entry, filesOfEntries, filesOfInput } from '../../src/pages/upload/gather.ts';
import { type Hashing, hashFiles, workersFor } from '../../src/pages/upload/hash.ts';

const fileOf = (text: string): File => new File([text], 'x');
const folderOf = (...paths: readonly (string | readonly [path: string, text: string])[]) =>
    readFolder(
        paths.map((one) =>
            typeof one === 'string'
                ? { path: one, file: fileOf(one) }
                : { path: one[0], file: fileOf(one[1]) },
        ),
    );
const pathsOf = (files: readonly { readonly path: string }[]): readonly string[] =>
    files.map(({ path }) => path);
const sized = (path: string, size: number) => ({ path, file: { size } as File });

test('junk and hidden files are left out and counted', async () => {
    const junk = [
        '.DS_Store',
        'images/.DS_Store',
        'images/Thumbs.db',
        '.git/config',
        '__MACOSX/images/._a.jpg',
        'images/._a.jpg',
        'a/@eaDir/b',
        'desktop.ini',
    ];
    assert.ok(junk.every(isJunk));
    const kept = ['images/a.jpg', 'images/a..b.jpg', 'sparse/0/cameras.bin', 'thumbs.db.jpg'];
    assert.ok(!kept.some(isJunk));
    const folder = await folderOf(...junk, ...kept);
    assert.equal(folder.junk, junk.length);
    assert.deepEqual(pathsOf(folder.files), kept.toSorted());
    assert.deepEqual(folder.derived, []);
});

test('paths are NFC and ascend by their UTF-8 bytes', async () => {
    const folder = await folderOf(
        'images/\u{1F41F}.jpg',
        'images/\uFF5E.jpg',
        'images/a\u0308.jpg',
        'images/b.jpg',
    );
    assert.deepEqual(pathsOf(folder.files), [
        'images/b.jpg',
        'images/\u00E4.jpg',
        'images/\uFF5E.jpg',
        'images/\u{1F41F}.jpg',
    ]);
    const paths = ['a', 'a/b', 'a-b', '', '\uD83D\uDC1F', '\uE000', '\uFFFD', 'é', 'z'];
    const expected = paths.toSorted((a, b) => Buffer.compare(Buffer.from(a), Buffer.from(b)));
    assert.deepEqual(paths.toSorted(byUtf8), expected);
});

test('outer folders are stripped, parts of a scene are not', async () => {
    assert.deepEqual(
        pathsOf((await folderOf('reef/scan/images/a.jpg', 'reef/scan/sparse/0/cameras.bin')).files),
        ['images/a.jpg', 'sparse/0/cameras.bin'],
    );
    assert.deepEqual(
        pathsOf((await folderOf('__MACOSX/x', 'reef/transforms.json', 'reef/images/a.jpg')).files),
        ['images/a.jpg', 'transforms.json'],
    );
    for (const kept of ['sparse/0/cameras.bin', 'images/a.jpg', '0/cameras.bin', 'a.jpg']) {
        assert.deepEqual(pathsOf((await folderOf(kept)).files), [kept]);
    }
});

test('paths that the service refuses are named', () => {
    assert.equal(faultOfPath('left cam/frame 12.JPG'), null);
    assert.equal(faultOfPath('a..b/täuchung ß.png'), null);
    assert.equal(faultOfPath(`${'a'.repeat(1023)}b`), null);
    const wrong: readonly (readonly [path: string, said: RegExp])[] = [
        [`${'a'.repeat(1023)}ä`, /1025 bytes/],
        ['a\\b.jpg', /backslash/],
        ['a\nb.jpg', /control/],
        ['a\u0085.jpg', /control/],
        ['a/c:b.jpg', /drive/],
        ['a//b', /empty/],
        ['a/../b', /empty/],
        ['', /empty/],
        ['a\uD800.jpg', /Unicode/],
    ];
    for (const [path, said] of wrong) {
        assert.match(faultOfPath(path) ?? '', said, JSON.stringify(path));
    }
});

test('two spellings of a path, and files that are too large, are named', () => {
    assert.deepEqual(faultsOf([sized('a', 1), sized('b/a', MOST_FILE_BYTES)]), []);
    assert.match(faultsOf([sized('a', 1), sized('a', 2)])[0] ?? '', /"a" is there twice/);
    assert.match(faultsOf([sized('a', 1), sized('a/b', 2)])[0] ?? '', /"a" is a file and a folder/);
    assert.match(
        faultsOf([sized('points3D.bin', MOST_FILE_BYTES + 1)])[0] ?? '',
        /points3D\.bin.*256 MiB.*fathom dataset upload/,
    );
});

test('what other programs derive is left out, by groups', async () => {
    const scene = [
        'images/a.jpg',
        'masks/a.jpg.png',
        'sparse/0/cameras.bin',
        'sparse/0/images.bin',
        'sparse/0/points3D.ply',
    ];
    const derived = [
        'database.db',
        'database.db-wal',
        'images_2/a.jpg',
        'images_4/a.jpg',
        'masks_2/a.jpg.png',
        'dense/images/a.jpg',
        'dense/0/stereo/depth_maps/a.bin',
        'point_cloud/iteration_7000/point_cloud.ply',
        'fused.ply',
        'dive.MP4',
        'raw/a.ARW',
        'backup.zip',
    ];
    const folder = await folderOf(...scene, ...derived);
    assert.deepEqual(pathsOf(folder.files), scene);
    assert.deepEqual(pathsOf(folder.derived.flatMap(({ files }) => files)).toSorted(), derived.toSorted());
    assert.deepEqual(folder.derived.map(({ label, files }) => `${label}: ${files.length}`).toSorted(), [
        'Archives: 1',
        'COLMAP database: 2',
        'Dense reconstruction: dense: 2',
        'Dense reconstruction: points and meshes: 1',
        'Raw photographs: 1',
        'Smaller copies: images_2: 1',
        'Smaller copies: images_4: 1',
        'Smaller copies: masks_2: 1',
        'Trained models: 1',
        'Videos: 1',
    ]);
});

test('what a scene names is not taken for derived', async () => {
    const transforms =
        '{"ply_file_path": "fused.ply", ' +
        '"frames": [{"file_path": "images_4/a.jpg"}, {"file_path": ".\\\\images_8\\\\a.jpg"}]}';
    const named = ['images_4/a.jpg', 'images_8/a.jpg', 'fused.ply', 'images/a.jpg'];
    const folder = await folderOf(['transforms.json', transforms], 'images_2/a.jpg', ...named);
    assert.deepEqual(pathsOf(folder.files), [...named, 'transforms.json'].toSorted());
    assert.deepEqual(pathsOf(folder.derived.flatMap(({ files }) => files)), ['images_2/a.jpg']);
    // The names of a COLMAP model may begin with a folder.
    const colmap = await folderOf(
        ['sparse/0/images.bin', `${'\0'.repeat(99)}images_2/a.jpg\0`],
        'images_2/a.jpg',
        'images/b.jpg',
    );
    assert.deepEqual(colmap.derived, []);
    // Without images/ these are the photographs.
    assert.deepEqual((await folderOf('images_2/a.jpg', 'sparse/0/images.bin')).derived, []);
    // The dense workspace by itself is a scene, except for its depth maps.
    const dense = await folderOf(
        'images/a.jpg',
        'sparse/images.bin',
        'stereo/depth_maps/a.bin',
        'stereo/fusion.cfg',
    );
    assert.deepEqual(pathsOf(dense.files), ['images/a.jpg', 'sparse/images.bin']);
});

test('a folder gives an id that the service takes', () => {
    const names: readonly (readonly [name: string, id: string])[] = [
        ['reef-7', 'reef-7'],
        ['Tauchgang Süd (2)', 'tauchgang-sud-2'],
        ['.hidden', 'hidden'],
        ['__x__', 'x'],
        ['日本', 'scene'],
        ['', 'scene'],
        [`${'a'.repeat(63)}-b`, 'a'.repeat(63)],
    ];
    for (const [name, id] of names) {
        assert.equal(idOfName(name), id, name);
        assert.ok(isId(id));
    }
    for (const wrong of ['', 'A', '-a', 'a b', 'ä', 'a'.repeat(65)]) {
        assert.ok(!isId(wrong), wrong);
    }
    const taken = new Set(['reef', 'reef-2']);
    assert.equal(
        freeId('reef', (id) => taken.has(id)),
        'reef-3',
    );
    assert.equal(
        freeId('a'.repeat(64), (id) => !id.endsWith('-2')),
        `${'a'.repeat(62)}-2`,
    );
});

/** A folder as a drop gives it, in batches of 2. */
const entry = (name: string, children?: readonly Entry[]): Entry => {
    if (children === undefined) {
        return { name, isDirectory: false, file: (done) => done(fileOf(name)) };
    }
    const createReader = () => {
        const rest = [...children];
        return { readEntries: (done: (entries: readonly Entry[]) => void) => done(rest.splice(0, 2)) };
    };
    return { name, isDirectory: true, createReader };
};

test('a dropped folder is read to its end', async () => {
    const images = entry(
        'images',
        ['a', 'b', 'c', 'd', 'e'].map((name) => entry(`${name}.jpg`)),
    );
    const sparse = entry('sparse', [entry('0', [entry('cameras.bin')]), entry('empty', [])]);
    const counts: number[] = [];
    const one = await filesOfEntries([entry('Reef', [images, sparse, entry('notes.txt')])], (count) =>
        counts.push(count),
    );
    const expected = [
        'images/a.jpg',
        'images/b.jpg',
        'images/c.jpg',
        'images/d.jpg',
        'images/e.jpg',
        'notes.txt',
        'sparse/0/cameras.bin',
    ];
    assert.equal(one.name, 'Reef');
    assert.deepEqual(pathsOf(one.found).toSorted(), expected);
    assert.equal(counts.at(-1), expected.length);
    const parts = await filesOfEntries([images, sparse, entry('notes.txt')], () => {});
    assert.equal(parts.name, '');
    assert.deepEqual(pathsOf(parts.found).toSorted(), expected);
});

test('a chosen folder gives its name and paths below it', () => {
    const of = (path: string): File =>
        Object.defineProperty(fileOf(path), 'webkitRelativePath', { value: path });
    const chosen = filesOfInput([of('Reef/images/a.jpg'), of('Reef/b.txt')]);
    assert.equal(chosen.name, 'Reef');
    assert.deepEqual(pathsOf(chosen.found), ['images/a.jpg', 'b.txt']);
    assert.deepEqual(filesOfInput([]), { name: '', found: [] });
});

test('digests are BLAKE3', async () => {
    // From test_vectors.json of BLAKE3: bytes that count from 0 to 250.
    const vectors: readonly (readonly [length: number, digest: string])[] = [
        [0, 'af1349b9f5f9a1a6a0404dea36dcc9499bcb25c9adc112b7cc9a93cae41f3262'],
        [1, '2d3adedff11b61f14c886e35afa036736dcd87a74d27b5c1510225d0f592e213'],
        [1024, '42214739f095a406f3fc83deb889744ac00df831c10daa55189b5d121c855af7'],
        [1025, 'd00278ae47eb27b34faecf67b4fe263f82d5412916c1ffd97c8cb7fb814b8444'],
        [31_744, '62b6960e1a44bcc1eb1a611a8d6235b6b4b78f32e7abc4fb4c6cdcce94895c47'],
        [102_400, 'bc3e3d41a1146b069abffad3c0d44860cf664390afce4d9661f7902e7943e085'],
    ];
    for (const [length, digest] of vectors) {
        const bytes = Uint8Array.from({ length }, (_, at) => at % 251);
        let read = 0;
        assert.equal(digestOfBytes(bytes), digest);
        assert.equal(await digestOfFile(new Blob([bytes]), (more) => (read += more)), digest);
        assert.equal(read, length);
    }
});

test('progress says how much, how fast and how long', () => {
    assert.equal(progressText('Uploading', 0, 5_000_000, 0), 'Uploading: 0 bytes of 5.00 MB');
    assert.equal(
        progressText('Uploading', 2_000_000, 5_000_000, 50_000),
        'Uploading: 2.00 MB of 5.00 MB, 50.0 kB a second, 1 min left',
    );
    assert.equal(
        progressText('Reading', 5_000_000, 5_000_000, 50_000),
        'Reading: 5.00 MB of 5.00 MB, 50.0 kB a second, 0 s left',
    );
});

test('a file that gives fewer bytes than it should has changed', async () => {
    const short = { size: 5, stream: () => new Blob(['abc']).stream() } as Blob;
    await assert.rejects(
        digestOfFile(short, () => {}),
        { name: 'NotReadableError' },
    );
});

test('files are hashed once, and one that cannot be read is named', async () => {
    const files = ['a', 'b', 'c', 'd'].map((path) => ({ path, file: fileOf(path) }));
    const hashed: string[] = [];
    let ended = 0;
    const start =
        (broken = ''): (() => Hashing) =>
        () => ({
            hash: async (file, onBytes) => {
                const text = await file.text();
                if (text === broken) {
                    throw new DOMException('gone', 'NotReadableError');
                }
                hashed.push(text);
                onBytes(file.size);
                return `digest of ${text}`;
            },
            end: () => (ended += 1),
        });
    const known = new Map<Blob, string>([[files[1]!.file, 'known']]);
    let bytes = 0;
    const options = {
        signal: AbortSignal.timeout(9000),
        onBytes: (more: number) => (bytes += more),
        workers: 2,
    };
    await hashFiles(files, known, { ...options, start: start() });
    assert.deepEqual(hashed.toSorted(), ['a', 'c', 'd']);
    assert.deepEqual([bytes, ended], [3, 2]);
    assert.deepEqual(
        files.map(({ file }) => known.get(file)),
        ['digest of a', 'known', 'digest of c', 'digest of d'],
    );
    await assert.rejects(
        hashFiles(files, new Map(), { ...options, start: start('c') }),
        /^Fault: "c" cannot be read/,
    );
    const stopped = AbortSignal.abort();
    await assert.rejects(hashFiles(files, new Map(), { ...options, signal: stopped, start: start() }), {
        name: 'AbortError',
    });
    assert.deepEqual([1, 2, 3, 64].map(workersFor), [1, 1, 2, 4]);
});
