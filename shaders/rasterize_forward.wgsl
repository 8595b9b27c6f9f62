//@ import frame, splat, votes, exchange
// Blends the splats of a tile, front to back (Kerbl et al. 2023, eq. 3).
//
//     alpha = min(MAX_ALPHA, opacity exp(-sigma)),  C += alpha T c,  R += alpha T range,  T *= 1 - alpha
// A splat with alpha below 1/255 is skipped. The first splat that would bring T below MIN_TRANSMITTANCE is
// not blended and ends the ray.
//
//   image   [H*W]   vec4: rgb over the background, alpha = 1 - T
//   range_image [H*W]  sum of alpha T range, scene units
//   tile_ends [tiles]  number of the tile's splats that any pixel needed: the backward pass stops there
// One workgroup per tile of TILE x TILE pixels. A thread owns eight pixels of a column (LANES = TILE * TILE /
// 8), so eight pixels share the cost of fetching a splat. How threads share splats is in exchange_*.wgsl.
// Twin: core/twins/src/rasterize_forward.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> projected: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> visible_from_slot: array<u32>;
@group(0) @binding(4) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> image: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> range_image: array<f32>;
@group(0) @binding(7) var<storage, read_write> tile_ends: array<u32>;

// State of the thread's pixels: rows 0 to 3 in _a, 4 to 7 in _b.
var<private> x: f32;
var<private> y_a: vec4<f32>;
var<private> y_b: vec4<f32>;
var<private> T_a: vec4<f32>;
var<private> T_b: vec4<f32>;
var<private> r_a: vec4<f32>;
var<private> r_b: vec4<f32>;
var<private> g_a: vec4<f32>;
var<private> g_b: vec4<f32>;
var<private> b_a: vec4<f32>;
var<private> b_b: vec4<f32>;
var<private> range_a: vec4<f32>;
var<private> range_b: vec4<f32>;
// 1 until the ray ends, then 0.
var<private> on_a: vec4<f32>;
var<private> on_b: vec4<f32>;
// Number of splats that any of the thread's pixels needed.
var<private> end: u32;

fn blend(splat: Splat, number: u32) {
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
    let raw_a = min(vec4<f32>(MAX_ALPHA), p1.y * exp(-sigma_a));
    let raw_b = min(vec4<f32>(MAX_ALPHA), p1.y * exp(-sigma_b));
    let alpha_a = select(vec4<f32>(0.0), raw_a, (raw_a >= vec4<f32>(MIN_ALPHA)) & (sigma_a >= vec4<f32>(0.0)));
    let alpha_b = select(vec4<f32>(0.0), raw_b, (raw_b >= vec4<f32>(MIN_ALPHA)) & (sigma_b >= vec4<f32>(0.0)));
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
    // The transmittance of an ended ray does not change: w is 0 there.
    T_a -= w_a;
    T_b -= w_b;
    let w = w_a + w_b;
    end = select(end, number + 1u, max(max(w.x, w.y), max(w.z, w.w)) > 0.0);
}

fn store_pixel(column: u32, row: u32, rgb: vec3<f32>, range: f32, T: f32) {
    if row < frame.size.y {
        let at = row * frame.size.x + column;
        image[at] = vec4<f32>(rgb + T * frame.background, 1.0 - T);
        range_image[at] = range;
    }
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
    T_a = vec4<f32>(1.0);
    T_b = vec4<f32>(1.0);
    r_a = vec4<f32>(0.0);
    r_b = vec4<f32>(0.0);
    g_a = vec4<f32>(0.0);
    g_b = vec4<f32>(0.0);
    b_a = vec4<f32>(0.0);
    b_b = vec4<f32>(0.0);
    range_a = vec4<f32>(0.0);
    range_b = vec4<f32>(0.0);
    end = 0u;
    // Pixels outside the image end immediately.
    let inside = column < frame.size.x;
    on_a = select(vec4<f32>(0.0), vec4<f32>(1.0), (y_a < vec4<f32>(f32(frame.size.y))) & vec4<bool>(inside));
    on_b = select(vec4<f32>(0.0), vec4<f32>(1.0), (y_b < vec4<f32>(f32(frame.size.y))) & vec4<bool>(inside));

    let range = ranges[tile];
    for (var first = range.x; first < range.y; first += BATCH) {
        share_splats(lane, first, range.y);
        let number = first - range.x;
        blend(shared_splat(0u), number + 0u);
        blend(shared_splat(1u), number + 1u);
        blend(shared_splat(2u), number + 2u);
        blend(shared_splat(3u), number + 3u);
        blend(shared_splat(4u), number + 4u);
        blend(shared_splat(5u), number + 5u);
        blend(shared_splat(6u), number + 6u);
        blend(shared_splat(7u), number + 7u);
        // Every fourth batch: stop if all rays of the tile have ended.
        if (number / BATCH) % 4u == 3u {
            let on = on_a + on_b;
            if !any_thread(lane, on.x + on.y + on.z + on.w > 0.0) {
                break;
            }
        }
    }

    let furthest = greatest(lane, end);
    if lane == 0u {
        tile_ends[tile] = furthest;
    }
    if inside {
        store_pixel(column, row, vec3<f32>(r_a.x, g_a.x, b_a.x), range_a.x, T_a.x);
        store_pixel(column, row + 1u, vec3<f32>(r_a.y, g_a.y, b_a.y), range_a.y, T_a.y);
        store_pixel(column, row + 2u, vec3<f32>(r_a.z, g_a.z, b_a.z), range_a.z, T_a.z);
        store_pixel(column, row + 3u, vec3<f32>(r_a.w, g_a.w, b_a.w), range_a.w, T_a.w);
        store_pixel(column, row + 4u, vec3<f32>(r_b.x, g_b.x, b_b.x), range_b.x, T_b.x);
        store_pixel(column, row + 5u, vec3<f32>(r_b.y, g_b.y, b_b.y), range_b.y, T_b.y);
        store_pixel(column, row + 6u, vec3<f32>(r_b.z, g_b.z, b_b.z), range_b.z, T_b.z);
        store_pixel(column, row + 7u, vec3<f32>(r_b.w, g_b.w, b_b.w), range_b.w, T_b.w);
    }
}
