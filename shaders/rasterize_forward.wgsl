//@ import frame
// Blends the splats of a tile, front to back (Kerbl et al. 2023, eq. 3).
//
//     alpha = min(MAX_ALPHA, opacity exp(-sigma)),  C += alpha T c,  R += alpha T range,  T *= 1 - alpha
// A splat below 1/255 is skipped; the one that would take T below MIN_TRANSMITTANCE ends the ray unblended.
//
//   image   [H*W]   vec4: rgb over the background, alpha = 1 - T
//   range   [H*W]   sum of alpha T range, scene units
//   tile_ends [tiles]  how many of the tile's splats any pixel needed: where the backward stops
// One workgroup a tile, 32 threads, a thread owns eight pixels of a column: what a splat costs to load is shared
// by eight pixels, which makes this several times faster on a CPU adapter than a thread a pixel.
// Twin: core/src/reference/rasterize_forward.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> visible_from_slot: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> image: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> range_image: array<f32>;
@group(0) @binding(7) var<storage, read_write> tile_ends: array<u32>;

const BATCH: u32 = 32u;
var<workgroup> sh_splats: array<vec4<f32>, 96>;
var<workgroup> sh_ends: array<u32, 32>;

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

    var T_a = vec4<f32>(1.0);
    var T_b = vec4<f32>(1.0);
    var r_a = vec4<f32>(0.0);
    var r_b = vec4<f32>(0.0);
    var g_a = vec4<f32>(0.0);
    var g_b = vec4<f32>(0.0);
    var b_a = vec4<f32>(0.0);
    var b_b = vec4<f32>(0.0);
    var range_a = vec4<f32>(0.0);
    var range_b = vec4<f32>(0.0);
    // 1 while a ray goes on. Pixels outside the picture end at once.
    var on_a = vec4<f32>(0.0);
    var on_b = vec4<f32>(0.0);
    if column < frame.size.x {
        on_a = select(vec4<f32>(0.0), vec4<f32>(1.0), y_a < vec4<f32>(f32(frame.size.y)));
        on_b = select(vec4<f32>(0.0), vec4<f32>(1.0), y_b < vec4<f32>(f32(frame.size.y)));
    }
    var end = 0u;

    let range = ranges[tile];
    for (var first = range.x; first < range.y; first += BATCH) {
        let count = min(BATCH, range.y - first);
        if lane < count {
            let at = 3u * visible_from_slot[slots[first + lane]];
            sh_splats[3u * lane] = projected[at];
            sh_splats[3u * lane + 1u] = projected[at + 1u];
            sh_splats[3u * lane + 2u] = projected[at + 2u];
        }
        workgroupBarrier();
        if any(on_a + on_b > vec4<f32>(0.0)) {
            for (var i = 0u; i < count; i++) {
                let p0 = sh_splats[3u * i];
                let p1 = sh_splats[3u * i + 1u];
                let dx = p0.x - x;
                let dy_a = p0.y - y_a;
                let dy_b = p0.y - y_b;
                let s = 0.5 * p0.z * dx * dx;
                let t = p0.w * dx;
                let u = 0.5 * p1.x;
                let sigma_a = s + dy_a * (t + u * dy_a);
                let sigma_b = s + dy_b * (t + u * dy_b);
                let least = min(sigma_a, sigma_b);
                if any(least <= vec4<f32>(p1.w + 0.01)) {
                    let p2 = sh_splats[3u * i + 2u];
                    var alpha_a = min(vec4<f32>(MAX_ALPHA), p1.y * exp(-sigma_a));
                    var alpha_b = min(vec4<f32>(MAX_ALPHA), p1.y * exp(-sigma_b));
                    alpha_a = select(vec4<f32>(0.0), alpha_a, (alpha_a >= vec4<f32>(MIN_ALPHA)) & (sigma_a >= vec4<f32>(0.0)));
                    alpha_b = select(vec4<f32>(0.0), alpha_b, (alpha_b >= vec4<f32>(MIN_ALPHA)) & (sigma_b >= vec4<f32>(0.0)));
                    let next_a = T_a * (1.0 - alpha_a);
                    let next_b = T_b * (1.0 - alpha_b);
                    on_a = select(vec4<f32>(0.0), on_a, next_a >= vec4<f32>(MIN_TRANSMITTANCE));
                    on_b = select(vec4<f32>(0.0), on_b, next_b >= vec4<f32>(MIN_TRANSMITTANCE));
                    let w_a = on_a * alpha_a * T_a;
                    let w_b = on_b * alpha_b * T_b;
                    r_a += w_a * p2.x;
                    r_b += w_b * p2.x;
                    g_a += w_a * p2.y;
                    g_b += w_b * p2.y;
                    b_a += w_a * p2.z;
                    b_b += w_b * p2.z;
                    range_a += w_a * p1.z;
                    range_b += w_b * p1.z;
                    T_a = select(T_a, next_a, on_a > vec4<f32>(0.0));
                    T_b = select(T_b, next_b, on_b > vec4<f32>(0.0));
                    if any(w_a + w_b > vec4<f32>(0.0)) {
                        end = first + i + 1u - range.x;
                    }
                }
            }
        }
        sh_ends[lane] = select(0u, 1u, any(on_a + on_b > vec4<f32>(0.0)));
        workgroupBarrier();
        var going = 0u;
        for (var i = 0u; i < 32u; i++) {
            going += sh_ends[i];
        }
        if going == 0u {
            break;
        }
        workgroupBarrier();
    }

    workgroupBarrier();
    sh_ends[lane] = end;
    workgroupBarrier();
    if lane == 0u {
        var furthest = 0u;
        for (var i = 0u; i < 32u; i++) {
            furthest = max(furthest, sh_ends[i]);
        }
        tile_ends[tile] = furthest;
    }
    if column < frame.size.x {
        let bg = frame.background;
        for (var k = 0u; k < 8u; k++) {
            if row + k < frame.size.y {
                let at = (row + k) * frame.size.x + column;
                let j = k & 3u;
                let T = select(T_b[j], T_a[j], k < 4u);
                let rgb = select(vec3<f32>(r_b[j], g_b[j], b_b[j]), vec3<f32>(r_a[j], g_a[j], b_a[j]), k < 4u);
                image[at] = vec4<f32>(rgb + T * bg, 1.0 - T);
                range_image[at] = select(range_b[j], range_a[j], k < 4u);
            }
        }
    }
}
