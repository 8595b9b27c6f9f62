//@ import frame, disk, met, rays, notes, votes, exchange_disks, sums_disks
//@ variant rasterize_disks_backward rays=from_eye+disk_at_pixels notes=straight_pixels+fixed_rays
//@ variant trace_reflected_backward rays=from_mirror+disk_at_pixels notes=traced_pixels+fixed_rays
//@ variant trace_refracted_backward rays=traced_at_pixels notes=traced_pixels+fixed_rays
//@ variant trace_reflected_moving_backward rays=from_mirror+disk_at_pixels notes=traced_pixels+ray_gradients
//@ variant trace_refracted_moving_backward rays=traced_at_pixels notes=traced_pixels+ray_gradients
// Gradients of the blending of disks, for every intersection; see rasterize_backward.
//
//   v_pixels vec4: of gather_pixel_gradients [H*W*2], or of surface_compose_backward [H*W] for traced rays
//   slots, tile_ends [tiles]  see needed.wgsl; what comes behind has no gradient
//   slot_gradients [intersections*5] vec4: the gradient of disk.wgsl, at the slot where the intersection was
//            emitted
// In the coordinates of the disk all gradients are sums of a few products, for any ray: with v_p the gradient
// w.r.t. p and tau = (v_p.d + v_range |d|) / N.d, those of centre and axes follow in project_backward.
// Twin: core/twins/src/disks.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> disks: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> visible_from_slot: array<u32>;
@group(0) @binding(5) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read> tile_ends: array<u32>;
@group(0) @binding(7) var<storage, read> v_pixels: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> slot_gradients: array<vec4<f32>>;

// Four pixels: transmittance, whether the ray goes on, the gradients of rgb, normal and range, the remainder,
// and the gradient of the mask.
struct Four {
    T: vec4<f32>,
    on: vec4<f32>,
    r: vec4<f32>,
    g: vec4<f32>,
    b: vec4<f32>,
    nx: vec4<f32>,
    ny: vec4<f32>,
    nz: vec4<f32>,
    range: vec4<f32>,
    rem: vec4<f32>,
    mask: vec4<f32>,
}

var<private> four_a: Four;
var<private> four_b: Four;

var<private> noted_a: Noted;
var<private> noted_b: Noted;

struct Pixel {
    v: vec4<f32>,
    surface: vec4<f32>,
    mask: f32,
}

// Zeros outside the image.
fn load_pixel(column: u32, row: u32) -> Pixel {
    if column >= frame.size.x || row >= frame.size.y {
        return Pixel(vec4<f32>(0.0), vec4<f32>(0.0), 0.0);
    }
    let at = row * frame.size.x + column;
    return Pixel(v_of(at), v_surface_of(at), v_mask_of(at));
}

fn load_four(column: u32, row: u32, on: vec4<f32>) -> Four {
    let p = load_pixel(column, row);
    let q = load_pixel(column, row + 1u);
    let r = load_pixel(column, row + 2u);
    let s = load_pixel(column, row + 3u);
    return Four(
        vec4<f32>(1.0),
        on,
        vec4<f32>(p.v.x, q.v.x, r.v.x, s.v.x),
        vec4<f32>(p.v.y, q.v.y, r.v.y, s.v.y),
        vec4<f32>(p.v.z, q.v.z, r.v.z, s.v.z),
        vec4<f32>(p.surface.x, q.surface.x, r.surface.x, s.surface.x),
        vec4<f32>(p.surface.y, q.surface.y, r.surface.y, s.surface.y),
        vec4<f32>(p.surface.z, q.surface.z, r.surface.z, s.surface.z),
        vec4<f32>(p.surface.w, q.surface.w, r.surface.w, s.surface.w),
        vec4<f32>(p.v.w, q.v.w, r.v.w, s.v.w),
        vec4<f32>(p.mask, q.mask, r.mask, s.mask),
    );
}

fn sum4(v: vec4<f32>) -> f32 {
    return (v.x + v.y) + (v.z + v.w);
}

// The gradient of a disk at four pixels, summed; behind it, the remainder and the transmittance.
fn unblend_four(four: ptr<private, Four>, noted: ptr<private, Noted>, disk: Splat, plane: Plane,
        normal: vec3<f32>, rays: Rays) -> Splat {
    let zero = vec4<f32>(0.0);
    let met = meet(disk, plane, rays);
    let fall = exp(-0.5 * met.spread);
    let raw = disk.d.y * fall;
    let capped = min(vec4<f32>(MAX_ALPHA), raw);
    let alpha = select(zero, capped, capped >= vec4<f32>(MIN_ALPHA));
    let left = 1.0 - alpha;
    (*four).on = select(zero, (*four).on, (*four).T * left >= vec4<f32>(MIN_TRANSMITTANCE));
    let w = (*four).on * alpha * (*four).T;
    let range = select(vec4<f32>(disk.d.z), met.t * met.lengths, met.is_hit);
    let worth = disk.e.x * (*four).r + disk.e.y * (*four).g + disk.e.z * (*four).b + range * (*four).range
        + normal.x * (*four).nx + normal.y * (*four).ny + normal.z * (*four).nz + disk.e.w * (*four).mask;
    (*four).rem -= w * worth;
    // Zero if the disk was not blended, or if MAX_ALPHA capped its alpha.
    let v_alpha = select(zero, (*four).T * worth - (*four).rem / left, (w > zero) & (raw <= vec4<f32>(MAX_ALPHA)));
    (*four).T -= w;
    let v_sigma = -alpha * v_alpha;
    let v_range = w * (*four).range;

    // Where the ray meets the disk; u and v are 0 elsewhere.
    let v_u = v_sigma * met.u;
    let v_v = v_sigma * met.v;
    let v_p_along = v_u * met.along_u + v_v * met.along_v;
    let turn = select(zero, v_p_along * met.per_slope, met.is_hit);
    let tau = turn + select(zero, v_range * met.lengths * met.per_slope, met.is_hit);
    note(noted, disk, plane, met, rays, v_u, v_v, turn);
    let per_focal = 1.0 / frame.focal;
    let on_image_x = met.far * per_focal.x * (v_u * disk.b.x + v_v * disk.c.x - plane.normal.x * turn);
    let on_image_y = met.far * per_focal.y * (v_u * disk.b.y + v_v * disk.c.y - plane.normal.y * turn);

    // Where the low-pass decides.
    let v_thin = select((1.0 / DISK_BLUR) * v_sigma, zero, met.is_hit);
    let v_x = v_thin * met.dx;
    let v_y = v_thin * met.dy;

    let vn_u = w * ((*four).nx * disk.b.x + (*four).ny * disk.b.y + (*four).nz * disk.b.z);
    let vn_v = w * ((*four).nx * disk.c.x + (*four).ny * disk.c.y + (*four).nz * disk.c.z);
    return Splat(
        vec4<f32>(sum4(v_u), sum4(v_v), sum4(tau), sum4(fall * v_alpha)),
        vec4<f32>(sum4(v_u * met.u), sum4(v_u * met.v), sum4(v_v * met.u), sum4(v_v * met.v)),
        vec4<f32>(sum4(tau * met.u), sum4(tau * met.v), sum4(v_x), sum4(v_y)),
        vec4<f32>(
            sum4(vn_u) * inverseSqrt(dot(disk.b.xyz, disk.b.xyz)),
            sum4(vn_v) * inverseSqrt(dot(disk.c.xyz, disk.c.xyz)),
            sum4(select(v_range, zero, met.is_hit)),
            sum4(abs(on_image_x + v_x) + abs(on_image_y + v_y)),
        ),
        vec4<f32>(sum4(w * (*four).r), sum4(w * (*four).g), sum4(w * (*four).b), sum4(w * (*four).mask)),
    );
}

fn unblend(disk: Splat) -> Splat {
    let plane = plane_of(disk);
    let normal = disk.c.w * plane.normal;
    let p = unblend_four(&four_a, &noted_a, disk, plane, normal, rays_a);
    let q = unblend_four(&four_b, &noted_b, disk, plane, normal, rays_b);
    return Splat(p.a + q.a, p.b + q.b, p.c + q.c, p.d + q.d, p.e + q.e);
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
    four_a = load_four(column, row, rays_a.on);
    four_b = load_four(column, row + 4u, rays_b.on);

    let range = ranges[tile];
    let last = min(range.x + tile_ends[tile], range.y);
    for (var first = range.x; first < last; first += BATCH) {
        share_splats(lane, first, last);
        give_sums(lane, 0u, unblend(shared_splat(0u)));
        give_sums(lane, 1u, unblend(shared_splat(1u)));
        give_sums(lane, 2u, unblend(shared_splat(2u)));
        give_sums(lane, 3u, unblend(shared_splat(3u)));
        write_sums(lane, first, 0u, last);
        give_sums(lane, 4u, unblend(shared_splat(4u)));
        give_sums(lane, 5u, unblend(shared_splat(5u)));
        give_sums(lane, 6u, unblend(shared_splat(6u)));
        give_sums(lane, 7u, unblend(shared_splat(7u)));
        write_sums(lane, first, 1u, last);
    }
    store_noted(column, row, noted_a);
    store_noted(column, row + 4u, noted_b);
    for (var i = last + lane; i < range.y; i += LANES) {
        let at = 5u * slots[i];
        slot_gradients[at] = vec4<f32>(0.0);
        slot_gradients[at + 1u] = vec4<f32>(0.0);
        slot_gradients[at + 2u] = vec4<f32>(0.0);
        slot_gradients[at + 3u] = vec4<f32>(0.0);
        slot_gradients[at + 4u] = vec4<f32>(0.0);
    }
}
