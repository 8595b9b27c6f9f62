//@ import frame
// Gradients of the blending, for every intersection.
//
// With F = sum of v . (what a splat adds) and `rem` what lies behind splat i, including the background:
//     dF/d alpha_i = T_i (c_i . v_rgb + range_i v_range) - rem_i / (1 - alpha_i)
// The rays are replayed front to back from the forward's result, so no per-pixel list is kept.
//
//   v_image   [H*W]   vec4: gradient of the loss by rgb and by alpha
//   v_range   [H*W]   gradient of the loss by the range image
//   slot_gradients [intersections*3] vec4, at the slot where the intersection was emitted, so that a splat's rows
//             are contiguous and are summed in one order: no atomics anywhere
//             (v_mean2d xy, v_conic a, b), (v_conic c, v_opacity, v_range, sum |v_mean2d|), (v_rgb, sum of weights)
// Work is laid out as in rasterize_forward. Eight splats at a time are summed over the tile through workgroup
// memory, in the order of the threads; a thread sums its own eight pixels first. Against a thread a splat with
// pixels streaming past (what the fastest GPU peers do) this touches workgroup memory 5 times less and has 2 barriers
// for 8 splats in place of 287 for 32, which is what counts on a CPU adapter.
// Every slot of a tile is written, also those behind the last splat that any pixel needed.
// Twin: core/src/reference/rasterize_backward.rs

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

const BATCH: u32 = 8u;
var<workgroup> sh_splats: array<vec4<f32>, 24>;
var<workgroup> sh_partial: array<vec4<f32>, 768>;

fn sum4(v: vec4<f32>) -> f32 {
    return (v.x + v.y) + (v.z + v.w);
}

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let tile = folded(group, groups);
    if tile >= frame.tiles.x * frame.tiles.y {
        return;
    }
    let corner = vec2<u32>(tile % frame.tiles.x, tile / frame.tiles.x) * TILE;
    let column = corner.x + (lane & 15u);
    let row = corner.y + (lane >> 4u) * 8u;
    let x = f32(column) + 0.5;
    let y_a = vec4<f32>(f32(row)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let y_b = y_a + 4.0;
    let bg = frame.background;

    var on_a = vec4<f32>(0.0);
    var on_b = vec4<f32>(0.0);
    var vr_a = vec4<f32>(0.0);
    var vr_b = vec4<f32>(0.0);
    var vg_a = vec4<f32>(0.0);
    var vg_b = vec4<f32>(0.0);
    var vb_a = vec4<f32>(0.0);
    var vb_b = vec4<f32>(0.0);
    var vd_a = vec4<f32>(0.0);
    var vd_b = vec4<f32>(0.0);
    var rem_a = vec4<f32>(0.0);
    var rem_b = vec4<f32>(0.0);
    if column < frame.size.x {
        for (var k = 0u; k < 4u; k++) {
            if row + k < frame.size.y {
                let at = (row + k) * frame.size.x + column;
                let v = v_image[at];
                let seen = image[at];
                let v_range = v_range_image[at];
                on_a[k] = 1.0;
                vr_a[k] = v.x; vg_a[k] = v.y; vb_a[k] = v.z; vd_a[k] = v_range;
                // dot(seen.rgb, v) holds the background's share T bg . v already; alpha = 1 - T.
                rem_a[k] = dot(seen.xyz, v.xyz) + range_image[at] * v_range - (1.0 - seen.w) * v.w;
            }
            if row + k + 4u < frame.size.y {
                let at = (row + k + 4u) * frame.size.x + column;
                let v = v_image[at];
                let seen = image[at];
                let v_range = v_range_image[at];
                on_b[k] = 1.0;
                vr_b[k] = v.x; vg_b[k] = v.y; vb_b[k] = v.z; vd_b[k] = v_range;
                rem_b[k] = dot(seen.xyz, v.xyz) + range_image[at] * v_range - (1.0 - seen.w) * v.w;
            }
        }
    }
    var T_a = vec4<f32>(1.0);
    var T_b = vec4<f32>(1.0);

    let range = ranges[tile];
    let last = min(range.x + tile_ends[tile], range.y);
    for (var first = range.x; first < last; first += BATCH) {
        let count = min(BATCH, last - first);
        if lane < 3u * count {
            let at = 3u * visible_from_slot[slots[first + lane / 3u]];
            sh_splats[lane] = projected[at + lane % 3u];
        }
        workgroupBarrier();
        for (var i = 0u; i < count; i++) {
            let p0 = sh_splats[3u * i];
            let p1 = sh_splats[3u * i + 1u];
            var sum_0 = vec4<f32>(0.0);
            var sum_1 = vec4<f32>(0.0);
            var sum_2 = vec4<f32>(0.0);
            let dx = p0.x - x;
            let dy_a = p0.y - y_a;
            let dy_b = p0.y - y_b;
            let s = 0.5 * p0.z * dx * dx;
            let t = p0.w * dx;
            let u = 0.5 * p1.x;
            let sigma_a = s + dy_a * (t + u * dy_a);
            let sigma_b = s + dy_b * (t + u * dy_b);
            let least = min(select(vec4<f32>(3e38), sigma_a, on_a > vec4<f32>(0.0)),
                            select(vec4<f32>(3e38), sigma_b, on_b > vec4<f32>(0.0)));
            if any(least <= vec4<f32>(p1.w + 0.01)) {
                let p2 = sh_splats[3u * i + 2u];
                let fall_a = exp(-sigma_a);
                let fall_b = exp(-sigma_b);
                let raw_a = p1.y * fall_a;
                let raw_b = p1.y * fall_b;
                var alpha_a = min(vec4<f32>(MAX_ALPHA), raw_a);
                var alpha_b = min(vec4<f32>(MAX_ALPHA), raw_b);
                alpha_a = select(vec4<f32>(0.0), alpha_a, (alpha_a >= vec4<f32>(MIN_ALPHA)) & (sigma_a >= vec4<f32>(0.0)));
                alpha_b = select(vec4<f32>(0.0), alpha_b, (alpha_b >= vec4<f32>(MIN_ALPHA)) & (sigma_b >= vec4<f32>(0.0)));
                let next_a = T_a * (1.0 - alpha_a);
                let next_b = T_b * (1.0 - alpha_b);
                on_a = select(vec4<f32>(0.0), on_a, next_a >= vec4<f32>(MIN_TRANSMITTANCE));
                on_b = select(vec4<f32>(0.0), on_b, next_b >= vec4<f32>(MIN_TRANSMITTANCE));
                let w_a = on_a * alpha_a * T_a;
                let w_b = on_b * alpha_b * T_b;
                let worth_a = p2.x * vr_a + p2.y * vg_a + p2.z * vb_a + p1.z * vd_a;
                let worth_b = p2.x * vr_b + p2.y * vg_b + p2.z * vb_b + p1.z * vd_b;
                rem_a -= w_a * worth_a;
                rem_b -= w_b * worth_b;
                // Zero where the splat was not blended, and where the cap on alpha acts on opacity and shape.
                let live_a = select(vec4<f32>(0.0), vec4<f32>(1.0), (w_a > vec4<f32>(0.0)) & (raw_a <= vec4<f32>(MAX_ALPHA)));
                let live_b = select(vec4<f32>(0.0), vec4<f32>(1.0), (w_b > vec4<f32>(0.0)) & (raw_b <= vec4<f32>(MAX_ALPHA)));
                let va_a = live_a * (T_a * worth_a - rem_a / (1.0 - alpha_a));
                let va_b = live_b * (T_b * worth_b - rem_b / (1.0 - alpha_b));
                T_a = select(T_a, next_a, on_a > vec4<f32>(0.0));
                T_b = select(T_b, next_b, on_b > vec4<f32>(0.0));
                let vs_a = -alpha_a * va_a;
                let vs_b = -alpha_b * va_b;
                let vx_a = (p0.z * dx + p0.w * dy_a) * vs_a;
                let vx_b = (p0.z * dx + p0.w * dy_b) * vs_b;
                let vy_a = (t + p1.x * dy_a) * vs_a;
                let vy_b = (t + p1.x * dy_b) * vs_b;
                let vs_sum = vs_a + vs_b;
                let vsy_sum = vs_a * dy_a + vs_b * dy_b;
                sum_0 = vec4<f32>(sum4(vx_a + vx_b), sum4(vy_a + vy_b), 0.5 * dx * dx * sum4(vs_sum), dx * sum4(vsy_sum));
                sum_1 = vec4<f32>(
                    0.5 * sum4(vs_a * dy_a * dy_a + vs_b * dy_b * dy_b),
                    sum4(fall_a * va_a + fall_b * va_b),
                    sum4(w_a * vd_a + w_b * vd_b),
                    sum4(abs(vx_a) + abs(vx_b) + abs(vy_a) + abs(vy_b)),
                );
                sum_2 = vec4<f32>(
                    sum4(w_a * vr_a + w_b * vr_b),
                    sum4(w_a * vg_a + w_b * vg_b),
                    sum4(w_a * vb_a + w_b * vb_b),
                    sum4(w_a + w_b),
                );
            }
            let at = 96u * i + lane;
            sh_partial[at] = sum_0;
            sh_partial[at + 32u] = sum_1;
            sh_partial[at + 64u] = sum_2;
        }
        workgroupBarrier();
        if lane < 3u * count {
            var sum = vec4<f32>(0.0);
            let at = 32u * lane;
            for (var i = 0u; i < 32u; i++) {
                sum += sh_partial[at + i];
            }
            slot_gradients[3u * slots[first + lane / 3u] + lane % 3u] = sum;
        }
        workgroupBarrier();
    }
    for (var i = last + lane; i < range.y; i += 32u) {
        let at = 3u * slots[i];
        slot_gradients[at] = vec4<f32>(0.0);
        slot_gradients[at + 1u] = vec4<f32>(0.0);
        slot_gradients[at + 2u] = vec4<f32>(0.0);
    }
}
