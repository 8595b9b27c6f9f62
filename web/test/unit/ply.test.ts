import assert from 'node:assert/strict';
import { test } from 'node:test';

import { frameAmong, isAntialiased, isPly, readHeader, waterAmong } from '../../src/viewer/ply.ts';

const WATER = '{"format":2,"medium":"per_pixel","blend":"srgb","beta_d":[1,2,3],"beta_b":[1,2,3],"b_inf":[0,0,1]}';
const PROPERTIES = ['x', 'y', 'z', 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity', 'scale_0', 'scale_1', 'scale_2', 'rot_0'];

function file(change: { comments?: string[]; count?: number; rows?: number; properties?: string[]; format?: string } = {}): Uint8Array {
    const { comments = [], count = 2, rows = 2, properties = PROPERTIES, format = 'binary_little_endian' } = change;
    const lines = [
        'ply',
        `format ${format} 1.0`,
        ...comments.map((comment) => `comment ${comment}`),
        `element vertex ${count}`,
        ...properties.map((name) => `property float ${name}`),
        'end_header',
        '',
    ];
    const header = new TextEncoder().encode(lines.join('\n'));
    const bytes = new Uint8Array(header.length + rows * properties.length * 4);
    bytes.set(header);
    return bytes;
}

test('the header gives comments, elements and the start of the rows', () => {
    const bytes = file({ comments: ['by hand', 'wreck of the Müritz'] });
    const header = readHeader(bytes, 'm.ply');
    assert.deepEqual(header.comments, ['by hand', 'wreck of the Müritz']);
    assert.deepEqual(header.elements.map(({ name, count, rowBytes }) => [name, count, rowBytes]), [['vertex', 2, 44]]);
    assert.equal(header.bytes, bytes.length - 2 * 44);
    assert.ok(isPly(bytes));
    assert.ok(!isPly(new Uint8Array([80, 75, 3, 4])));
});

test('the water is read from the comment of a header', () => {
    assert.deepEqual(waterAmong(['by hand', `fathom_water ${WATER}`])?.beta_d, [1, 2, 3]);
    assert.equal(waterAmong(['by hand']), null);
    assert.throws(() => waterAmong(['fathom_water {']), /not JSON/);
    assert.throws(() => waterAmong([`fathom_water ${WATER.replace('2', '9')}`]), /format 9/);
});

test('filter and frame are read from comments', () => {
    assert.ok(isAntialiased(['antialiased: opacity makes up for a low-pass of 0.3 px^2']));
    assert.ok(isAntialiased(['SplatRenderMode: mip']));
    assert.ok(!isAntialiased(['SplatRenderMode: default']));
    assert.deepEqual(frameAmong(['fathom frame: scene_to_model_quat_wxyz 0 1 0 0']), [1, 0, 0, 0]);
    assert.equal(frameAmong(['other']), null);
});

test('a damaged file is refused with what is wrong and what to do', () => {
    const refused = (bytes: Uint8Array, why: RegExp): void => assert.throws(() => readHeader(bytes, 'm.ply'), why);
    refused(file().slice(0, 60), /header has no end/);
    refused(file({ rows: 1 }), /incomplete: it has \d+ bytes/);
    refused(file({ count: 0, rows: 0 }), /no Gaussians/);
    refused(file({ format: 'ascii' }), /format ascii/);
    refused(file({ properties: ['x', 'y', 'z', 'red'] }), /without Gaussians: x, y, z, red/);
});
