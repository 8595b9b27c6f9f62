//@ import frame, splat, votes, exchange, sums
// Gradients of the blending, for every intersection.
//
// With F = sum of v . (contribution of a splat), and `rem` the contributions behind splat i, including the
// background:
//     dF/d alpha_i = T_i (c_i . v_rgb + range_i v_range) - rem_i / (1 - alpha_i)
// The rays are replayed front to back, starting from the forward result, so no per-pixel list is stored.
//
//   v_image   [H*W]   vec4: gradient of the loss w.r.t. rgb and alpha
//   v_range_image [H*W]  gradient of the loss w.r.t. the range image
//   slot_gradients [intersections*3] vec4: (v_mean2d xy, v_conic a, b), (v_conic c, v_opacity, v_range,
//             sum |v_mean2d|), (v_rgb, sum of weights)
//             at the slot where the intersection was emitted, so that the rows of a splat are contiguous and
//             are summed in a fixed order, without atomics
// The work is distributed as in rasterize_forward. A thread sums a splat over its own eight pixels; then the
// threads of the tile are summed in their order (sums_*.wgsl).
// Every slot of a tile is written, including those after the last splat that any pixel needed.
// Twin: core/twins/src/rasterize_backward.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> visible_from_slot: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read> tile_ends: array<u32>;
@group(0) @binding(6) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> range_image: array<f32>;
@group(0) @binding(8) var<storage, read> v_image: array<vec4<f32>>;
@group(0) @binding(9) var<storage, read> v_range_image: array<f32>;
@group(0) @binding(10) var<storage, read_write> slot_gradients: array<vec4<f32>>;

var<private> x: f32;
var<private> y_a: vec4<f32>;
var<private> y_b: vec4<f32>;
var<private> T_a: vec4<f32>;
var<private> T_b: vec4<f32>;
var<private> on_a: vec4<f32>;
var<private> on_b: vec4<f32>;
// Gradients of the pixels: rgb and range.
var<private> vr_a: vec4<f32>;
var<private> vr_b: vec4<f32>;
var<private> vg_a: vec4<f32>;
var<private> vg_b: vec4<f32>;
var<private> vb_a: vec4<f32>;
var<private> vb_b: vec4<f32>;
var<private> vd_a: vec4<f32>;
var<private> vd_b: vec4<f32>;
var<private> rem_a: vec4<f32>;
var<private> rem_b: vec4<f32>;

struct Pixel {
    on: f32,
    v: vec3<f32>,
    v_range: f32,
    rem: f32,
}

// Zeros outside the image.
fn load_pixel(column: u32, row: u32) -> Pixel {
    if column >= frame.size.x || row >= frame.size.y {
        return Pixel(0.0, vec3<f32>(0.0), 0.0, 0.0);
    }
    let at = row * frame.size.x + column;
    let v = v_image[at];
    let seen = image[at];
    let v_range = v_range_image[at];
    // dot(seen.rgb, v) already includes the background's share T bg . v; alpha = 1 - T.
    return Pixel(1.0, v.xyz, v_range, dot(seen.xyz, v.xyz) + range_image[at] * v_range - (1.0 - seen.w) * v.w);
}

fn sum4(v: vec4<f32>) -> f32 {
    return (v.x + v.y) + (v.z + v.w);
}

fn unblend(splat: Splat) -> Splat {
    let p0 = splat.a;
    let p1 = splat.b;
    let p2 = splat.c;
    let dx = p0.x - x;
    let dy_a = p0.y - y_a;
    let dy_b = p0.y - y_b;
    let s = 0.5 * p0.z * dx * dx;
    let t = p0.w * dx;
    let u = 0.5 * p1.x;
    let sigma_a = s + dy_a * (t + u * dy_a);
    let sigma_b = s + dy_b * (t + u * dy_b);
    let fall_a = exp(-sigma_a);
    let fall_b = exp(-sigma_b);
    let raw_a = p1.y * fall_a;
    let raw_b = p1.y * fall_b;
    let capped_a = min(vec4<f32>(MAX_ALPHA), raw_a);
    let capped_b = min(vec4<f32>(MAX_ALPHA), raw_b);
    let alpha_a = select(vec4<f32>(0.0), capped_a, (capped_a >= vec4<f32>(MIN_ALPHA)) & (sigma_a >= vec4<f32>(0.0)));
    let alpha_b = select(vec4<f32>(0.0), capped_b, (capped_b >= vec4<f32>(MIN_ALPHA)) & (sigma_b >= vec4<f32>(0.0)));
    let left_a = 1.0 - alpha_a;
    let left_b = 1.0 - alpha_b;
    on_a = select(vec4<f32>(0.0), on_a, T_a * left_a >= vec4<f32>(MIN_TRANSMITTANCE));
    on_b = select(vec4<f32>(0.0), on_b, T_b * left_b >= vec4<f32>(MIN_TRANSMITTANCE));
    let w_a = on_a * alpha_a * T_a;
    let w_b = on_b * alpha_b * T_b;
    let worth_a = p2.x * vr_a + p2.y * vg_a + p2.z * vb_a + p1.z * vd_a;
    let worth_b = p2.x * vr_b + p2.y * vg_b + p2.z * vb_b + p1.z * vd_b;
    rem_a -= w_a * worth_a;
    rem_b -= w_b * worth_b;
    // Zero if the splat was not blended, or if MAX_ALPHA capped its alpha.
    let va_a = select(vec4<f32>(0.0), T_a * worth_a - rem_a / left_a, (w_a > vec4<f32>(0.0)) & (raw_a <= vec4<f32>(MAX_ALPHA)));
    let va_b = select(vec4<f32>(0.0), T_b * worth_b - rem_b / left_b, (w_b > vec4<f32>(0.0)) & (raw_b <= vec4<f32>(MAX_ALPHA)));
    T_a -= w_a;
    T_b -= w_b;
    let vs_a = -alpha_a * va_a;
    let vs_b = -alpha_b * va_b;
    let vsy_a = vs_a * dy_a;
    let vsy_b = vs_b * dy_b;
    let vx_a = (p0.z * dx) * vs_a + p0.w * vsy_a;
    let vx_b = (p0.z * dx) * vs_b + p0.w * vsy_b;
    let vy_a = t * vs_a + p1.x * vsy_a;
    let vy_b = t * vs_b + p1.x * vsy_b;
    return Splat(
        vec4<f32>(sum4(vx_a + vx_b), sum4(vy_a + vy_b), 0.5 * dx * dx * sum4(vs_a + vs_b), dx * sum4(vsy_a + vsy_b)),
        vec4<f32>(
            0.5 * sum4(vsy_a * dy_a + vsy_b * dy_b),
            sum4(fall_a * va_a + fall_b * va_b),
            sum4(w_a * vd_a + w_b * vd_b),
            sum4((abs(vx_a) + abs(vx_b)) + (abs(vy_a) + abs(vy_b))),
        ),
        vec4<f32>(
            sum4(w_a * vr_a + w_b * vr_b),
            sum4(w_a * vg_a + w_b * vg_b),
            sum4(w_a * vb_a + w_b * vb_b),
            sum4(w_a + w_b),
        ),
    );
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
    x = f32(column) + 0.5;
    y_a = vec4<f32>(f32(row)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    y_b = y_a + 4.0;
    let p0 = load_pixel(column, row);
    let p1 = load_pixel(column, row + 1u);
    let p2 = load_pixel(column, row + 2u);
    let p3 = load_pixel(column, row + 3u);
    let p4 = load_pixel(column, row + 4u);
    let p5 = load_pixel(column, row + 5u);
    let p6 = load_pixel(column, row + 6u);
    let p7 = load_pixel(column, row + 7u);
    on_a = vec4<f32>(p0.on, p1.on, p2.on, p3.on);
    on_b = vec4<f32>(p4.on, p5.on, p6.on, p7.on);
    vr_a = vec4<f32>(p0.v.x, p1.v.x, p2.v.x, p3.v.x);
    vr_b = vec4<f32>(p4.v.x, p5.v.x, p6.v.x, p7.v.x);
    vg_a = vec4<f32>(p0.v.y, p1.v.y, p2.v.y, p3.v.y);
    vg_b = vec4<f32>(p4.v.y, p5.v.y, p6.v.y, p7.v.y);
    vb_a = vec4<f32>(p0.v.z, p1.v.z, p2.v.z, p3.v.z);
    vb_b = vec4<f32>(p4.v.z, p5.v.z, p6.v.z, p7.v.z);
    vd_a = vec4<f32>(p0.v_range, p1.v_range, p2.v_range, p3.v_range);
    vd_b = vec4<f32>(p4.v_range, p5.v_range, p6.v_range, p7.v_range);
    rem_a = vec4<f32>(p0.rem, p1.rem, p2.rem, p3.rem);
    rem_b = vec4<f32>(p4.rem, p5.rem, p6.rem, p7.rem);
    T_a = vec4<f32>(1.0);
    T_b = vec4<f32>(1.0);

    let range = ranges[tile];
    let last = min(range.x + tile_ends[tile], range.y);
    for (var first = range.x; first < last; first += BATCH) {
        share_splats(lane, first, last);
        give_sums(lane, 0u, unblend(shared_splat(0u)));
        give_sums(lane, 1u, unblend(shared_splat(1u)));
        give_sums(lane, 2u, unblend(shared_splat(2u)));
        give_sums(lane, 3u, unblend(shared_splat(3u)));
        give_sums(lane, 4u, unblend(shared_splat(4u)));
        give_sums(lane, 5u, unblend(shared_splat(5u)));
        give_sums(lane, 6u, unblend(shared_splat(6u)));
        give_sums(lane, 7u, unblend(shared_splat(7u)));
        write_sums(lane, first, last);
    }
    for (var i = last + lane; i < range.y; i += LANES) {
        let at = 3u * slots[i];
        slot_gradients[at] = vec4<f32>(0.0);
        slot_gradients[at + 1u] = vec4<f32>(0.0);
        slot_gradients[at + 2u] = vec4<f32>(0.0);
    }
}
