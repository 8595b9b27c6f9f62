//@ import frame, disk, met, rays, maps, votes, exchange_disks, needed
//@ variant rasterize_disks rays=from_eye+disk_at_pixels maps=disk_maps
//@ variant trace_reflected rays=from_mirror+disk_at_pixels maps=no_maps
//@ variant trace_refracted rays=traced_at_pixels maps=no_maps
// Blends the disks of a tile, front to back, as rasterize_forward does splats. The rays of its pixels come
// from the eye, or from a water surface that reflects (from_mirror.wgsl) or refracts them
// (traced_at_pixels.wgsl).
//
//   image   [H*W]   vec4: rgb over the background, alpha = 1 - T
//   range_image [H*W]  sum of alpha T range, scene units: to where the ray meets the disk, or to the centre
//             where the low-pass decides; along the ray. Not of traced rays
//   normal_image [H*W] vec4: sum of alpha T normal, camera axes, towards the camera; sum of alpha T mask.
//             Not of traced rays
//   slots, tile_ends [tiles]  see needed.wgsl
// Twin: core/twins/src/disks.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> disks: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> slots: array<u32>;
@group(0) @binding(4) var<storage, read> visible_from_slot: array<u32>;
@group(0) @binding(5) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read_write> image: array<vec4<f32>>;
@group(0) @binding(9) var<storage, read_write> tile_ends: array<u32>;

// State of the thread's pixels: rows 0 to 3 in _a, 4 to 7 in _b.
struct Sums {
    T: vec4<f32>,
    // 1 until the ray ends, then 0.
    on: vec4<f32>,
    r: vec4<f32>,
    g: vec4<f32>,
    b: vec4<f32>,
}

var<private> sums_a: Sums;
var<private> sums_b: Sums;
var<private> maps_a: Maps;
var<private> maps_b: Maps;
// The disks of a batch that any of the thread's pixels needed, a bit for each.
var<private> needed_here: u32;

fn empty(on: vec4<f32>) -> Sums {
    let zero = vec4<f32>(0.0);
    return Sums(vec4<f32>(1.0), on, zero, zero, zero);
}

// Adds a disk to four pixels. Returns what is not 0 where the backward pass needs it: where it has a weight,
// and where it ends the ray.
fn add(sums: ptr<private, Sums>, maps: ptr<private, Maps>, disk: Splat, met: Met, normal: vec3<f32>) -> vec4<f32> {
    let raw = min(vec4<f32>(MAX_ALPHA), disk.d.y * exp(-0.5 * met.spread));
    let alpha = select(vec4<f32>(0.0), raw, raw >= vec4<f32>(MIN_ALPHA));
    let next = (*sums).T * (1.0 - alpha);
    let before = (*sums).on;
    (*sums).on = select(vec4<f32>(0.0), before, next >= vec4<f32>(MIN_TRANSMITTANCE));
    let w = (*sums).on * alpha * (*sums).T;
    (*sums).r += w * disk.e.x;
    (*sums).g += w * disk.e.y;
    (*sums).b += w * disk.e.z;
    (*sums).T -= w;
    add_maps(maps, disk, met, normal, w);
    return w + (before - (*sums).on);
}

// `i` is its place in the batch.
fn blend(disk: Splat, i: u32) {
    let plane = plane_of(disk);
    let normal = disk.c.w * plane.normal;
    let w_a = add(&sums_a, &maps_a, disk, meet(disk, plane, rays_a), normal);
    let w_b = add(&sums_b, &maps_b, disk, meet(disk, plane, rays_b), normal);
    let w = w_a + w_b;
    needed_here |= select(0u, 1u << i, max(max(w.x, w.y), max(w.z, w.w)) > 0.0);
}

fn store_pixel(column: u32, row: u32, rgb: vec3<f32>, T: f32) {
    if row < frame.size.y {
        image[row * frame.size.x + column] = vec4<f32>(rgb + T * frame.background, 1.0 - T);
    }
}

fn store_four(column: u32, row: u32, s: Sums) {
    store_pixel(column, row, vec3<f32>(s.r.x, s.g.x, s.b.x), s.T.x);
    store_pixel(column, row + 1u, vec3<f32>(s.r.y, s.g.y, s.b.y), s.T.y);
    store_pixel(column, row + 2u, vec3<f32>(s.r.z, s.g.z, s.b.z), s.T.z);
    store_pixel(column, row + 3u, vec3<f32>(s.r.w, s.g.w, s.b.w), s.T.w);
}

@compute @workgroup_size(LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let tile = frame.first_tile + folded(group, groups);
    if tile >= frame.end_tile {
        return;
    }
    let corner = vec2<u32>(tile % frame.tiles.x, tile / frame.tiles.x) * TILE;
    let column = corner.x + lane % TILE;
    let row = corner.y + (lane / TILE) * 8u;
    begin_rays(column, row);
    // Pixels outside the image and pixels without a ray end immediately.
    sums_a = empty(rays_a.on);
    sums_b = empty(rays_b.on);
    let begun = rays_a.on + rays_b.on;
    let has_rays = any_thread(lane, begun.x + begun.y + begun.z + begun.w > 0.0);

    let range = ranges[tile];
    front = range.x;
    for (var first = select(range.y, range.x, has_rays); first < range.y; first += BATCH) {
        share_splats(lane, first, range.y);
        needed_here = 0u;
        blend(shared_splat(0u), 0u);
        blend(shared_splat(1u), 1u);
        blend(shared_splat(2u), 2u);
        blend(shared_splat(3u), 3u);
        blend(shared_splat(4u), 4u);
        blend(shared_splat(5u), 5u);
        blend(shared_splat(6u), 6u);
        blend(shared_splat(7u), 7u);
        keep_needed(lane, first, range.y, needed_here);
        // Every fourth batch: stop if all rays of the tile have ended.
        if ((first - range.x) / BATCH) % 4u == 3u {
            let on = sums_a.on + sums_b.on;
            if !any_thread(lane, on.x + on.y + on.z + on.w > 0.0) {
                break;
            }
        }
    }

    if lane == 0u {
        tile_ends[tile] = front - range.x;
    }
    if column < frame.size.x {
        store_four(column, row, sums_a);
        store_four(column, row + 4u, sums_b);
        store_maps(column, row, maps_a);
        store_maps(column, row + 4u, maps_b);
    }
}
