// What the blending of disks adds up at four pixels besides colour: ranges, normals and masks. Needs disk,
// met and the name frame.

@group(0) @binding(7) var<storage, read_write> range_image: array<f32>;
@group(0) @binding(8) var<storage, read_write> normal_image: array<vec4<f32>>;

struct Maps {
    range: vec4<f32>,
    nx: vec4<f32>,
    ny: vec4<f32>,
    nz: vec4<f32>,
    mask: vec4<f32>,
}

fn add_maps(maps: ptr<private, Maps>, disk: Splat, met: Met, normal: vec3<f32>, w: vec4<f32>) {
    (*maps).range += w * select(vec4<f32>(disk.d.z), met.t * met.lengths, met.is_hit);
    (*maps).nx += w * normal.x;
    (*maps).ny += w * normal.y;
    (*maps).nz += w * normal.z;
    (*maps).mask += w * disk.e.w;
}

fn store_map(column: u32, row: u32, range: f32, normal: vec4<f32>) {
    if row < frame.size.y {
        let at = row * frame.size.x + column;
        range_image[at] = range;
        normal_image[at] = normal;
    }
}

fn store_maps(column: u32, row: u32, m: Maps) {
    store_map(column, row, m.range.x, vec4<f32>(m.nx.x, m.ny.x, m.nz.x, m.mask.x));
    store_map(column, row + 1u, m.range.y, vec4<f32>(m.nx.y, m.ny.y, m.nz.y, m.mask.y));
    store_map(column, row + 2u, m.range.z, vec4<f32>(m.nx.z, m.ny.z, m.nz.z, m.mask.z));
    store_map(column, row + 3u, m.range.w, vec4<f32>(m.nx.w, m.ny.w, m.nz.w, m.mask.w));
}
