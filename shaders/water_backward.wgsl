//@ import frame, water, medium
// Backpropagates through `water`, and sums the gradient w.r.t. the water parameters.
//
//   truth    [H*W]       packed photograph, sRGB; the highest byte is the mask
//   v_image  [H*W]       vec4: in: w.r.t. the image; out: w.r.t. the blended colour and alpha
//   v_range_image [H*W]  w.r.t. the blended range; 0 if the water acts on Gaussians
//   partials [rows*3]    vec4: gradient w.r.t. beta_d, beta_b and b_inf, summed over the workgroup's
//                        WATER_CHUNK pixels
//   refinement_partials [rows]  vec4: the same w.r.t. the two weights and biases of eq. 9; one row if unused
// With m the factors of eq. 9 at r, the coefficients are m beta. So beta receives m times their gradient, and
// m receives the sum over channels of beta times it. The sigmoids pass the gradient on to weight, bias and,
// through z, to r.
// Alpha has a gradient of its own (eq. 15). Where the photograph shows open water, no Gaussian shall take its
// place. Elsewhere, open water shall not shine through the surface, because J would be too dark by that
// light.
// If the view has a ray map (core/src/water/open_water), the map decides which case applies, and cells of
// unknown kind get no such gradient. Without a map the colour decides.
// If b_inf changes with direction, its gradient is that w.r.t. b_inf along the ray times the factor.
// A thread takes every 64th pixel of its chunk. The sums of the threads are added in their order, so runs are
// identical. Twin: core/twins/src/water.rs

@group(0) @binding(0) var<uniform> medium: Medium;
@group(0) @binding(1) var<uniform> water: Water;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> range_image: array<f32>;
@group(0) @binding(4) var<storage, read> truth: array<u32>;
@group(0) @binding(5) var<storage, read_write> v_image: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> v_range_image: array<f32>;
@group(0) @binding(7) var<storage, read_write> partials: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> refinement_partials: array<vec4<f32>>;
@group(0) @binding(9) var<uniform> frame: Frame;
@group(0) @binding(10) var<storage, read> map: array<u32>;

// Alpha below which the pull on a surface grows no further.
const THIN: f32 = 0.05;
// A pixel at the edge of open water is open up to this share of edge_distance, from which on it is a surface.
// In between, nothing is decided.
const SURELY: f32 = 0.6;

var<workgroup> sh_sums: array<vec4<f32>, 256>;

// The map cell that contains pixel `i`.
fn cell_of(i: u32) -> u32 {
    let columns = max(frame.size.x, 1u);
    let column = (i % columns) * medium.map_columns / columns;
    let row = (i / columns) * medium.map_rows / max(frame.size.y, 1u);
    return map[min(row * medium.map_columns + column, arrayLength(&map) - 1u)];
}

// Gradient w.r.t. the range `r` of pixel `i`: pulls a range that is far off towards the sparse points of its
// cell, which lie on surfaces. Through water, a surface that few views see may float anywhere in front of its
// place, or be missing.
fn by_range(i: u32, pixel: u32, r: f32) -> f32 {
    let is_masked = (pixel >> 24u) != 255u && veiled(medium.masked, arrayLength(&truth)) != 0u;
    if is_masked || veiled(medium.map_columns, arrayLength(&map)) == 0u {
        return 0.0;
    }
    let range = bitcast<f32>(cell_of(i) & ~3u);
    let off = log(max(r, 1e-6) / max(range, 1e-6));
    let counts = range > 0.0 && abs(off) > medium.range_slack;
    return select(0.0, medium.range_weight * sign(off) / max(r, 1e-6), counts);
}

// Gradient of eq. 15 w.r.t. the alpha of pixel `i`, whose photograph is `pixel`: up on a surface, down in
// open water. The pull on a surface grows as its alpha falls, like a barrier. Where almost no light comes
// through the water, nothing else protects a thin surface from the terms that make Gaussians smaller and
// fainter.
fn by_alpha(i: u32, pixel: u32, alpha: f32, b_inf: vec3<f32>) -> f32 {
    if (pixel >> 24u) != 255u && veiled(medium.masked, arrayLength(&truth)) != 0u {
        return 0.0;
    }
    let upwards = medium.surface_weight / max(alpha, THIN);
    let colour = vec3<f32>(f32(pixel & 255u), f32((pixel >> 8u) & 255u), f32((pixel >> 16u) & 255u)) / 255.0;
    let off = distance(colour, encoded(b_inf));
    if veiled(medium.map_columns, arrayLength(&map)) != 0u {
        let what = cell_of(i) & 3u;
        let is_open = what == MAP_OPEN || (what == MAP_EDGE && off < SURELY * medium.edge_distance);
        let is_surface = what == MAP_SURFACE || (what == MAP_EDGE && off > medium.edge_distance);
        return select(0.0, medium.open_weight, is_open) - select(0.0, upwards, is_surface);
    }
    return select(-upwards, medium.background_weight, off < medium.background_distance);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let id = folded(group, groups);
    let compose = veiled(medium.compose, arrayLength(&image) + 6u);
    let encode = veiled(medium.encode, arrayLength(&image));
    var by_d = vec3<f32>(0.0);
    var by_b = vec3<f32>(0.0);
    var by_inf = vec3<f32>(0.0);
    var by_refinement = vec4<f32>(0.0);
    for (var k = 0u; k < WATER_CHUNK / 64u; k++) {
        let i = id * WATER_CHUNK + k * 64u + lane;
        if i < medium.pixels {
            let pixel = image[i];
            let range = range_image[i];
            let factors = colour_factors(water, direction_of(frame, i));
            let b_inf = factors * water.b_inf;
            var here = water;
            here.b_inf = b_inf;
            var v = v_image[i].rgb;
            if encode != 0u {
                v *= encoded_slope(formed(compose, here, pixel, range));
            }
            var v_blended = vec4<f32>(0.0);
            var v_range = 0.0;
            if compose == MEDIUM_PER_GAUSSIAN_SRGB {
                v_blended = vec4<f32>(v, -dot(v, encoded(b_inf)));
                by_inf += factors * (1.0 - pixel.a) * encoded_slope(b_inf) * v;
            } else if compose == MEDIUM_PER_GAUSSIAN {
                v_blended = vec4<f32>(v, -dot(v, b_inf));
                by_inf += factors * (1.0 - pixel.a) * v;
            } else if pixel.a >= LEAST_ALPHA {
                let r = range / pixel.a;
                let m = refining_factors(water, r);
                let beta_d = m.x * water.beta_d;
                let beta_b = m.y * water.beta_b;
                let through = exp(-beta_d * r);
                let own = own_light(compose, pixel);
                let veil = b_inf * exp(-beta_b * r);
                let v_d = -r * own * through * v;
                let v_b = (r * pixel.a) * veil * v;
                // W.r.t. the arguments of the sigmoids; 0 without them, because Scale is 0.
                let sigmoids = refining_sigmoids(water, r);
                let v_m = vec2<f32>(dot(water.beta_d, v_d), dot(water.beta_b, v_b));
                let v_x = water.scale * v_m * sigmoids * (1.0 - sigmoids);
                let z = r * water.per_unit;
                let v_r = dot(v, pixel.a * beta_b * veil - beta_d * own * through)
                    + dot(v_x, water.refinement.xz) * water.per_unit + by_range(i, truth[i], r);
                v_range = v_r / pixel.a;
                let v_own = v * through;
                v_blended = vec4<f32>(v_own, -dot(v, veil) - v_range * r);
                if compose == MEDIUM_AS_SHOWN {
                    let shown = pixel.rgb / pixel.a;
                    let slope = decoded_slope(shown);
                    v_blended = vec4<f32>(v_own * slope, v_blended.a + dot(v_own, decoded(shown) - slope * shown));
                }
                if compose == MEDIUM_OVER_BLACK {
                    v_blended = vec4<f32>(v_own * decoded_slope(pixel.rgb), v_blended.a + dot(v, b_inf));
                }
                by_d += m.x * v_d;
                by_b += m.y * v_b;
                by_inf += factors * (watery_share(compose, pixel.a) - pixel.a * exp(-beta_b * r)) * v;
                by_refinement += vec4<f32>(v_x.x * z, v_x.x, v_x.y * z, v_x.y);
            } else {
                by_inf += factors * watery_share(compose, 0.0) * v;
            }
            v_blended.a += by_alpha(i, truth[i], pixel.a, b_inf);
            v_image[i] = v_blended;
            v_range_image[i] = v_range;
        }
    }
    sh_sums[4u * lane] = vec4<f32>(by_d, 0.0);
    sh_sums[4u * lane + 1u] = vec4<f32>(by_b, 0.0);
    sh_sums[4u * lane + 2u] = vec4<f32>(by_inf, 0.0);
    sh_sums[4u * lane + 3u] = by_refinement;
    workgroupBarrier();
    if lane < 4u {
        var total = vec4<f32>(0.0);
        for (var k = 0u; k < 64u; k++) {
            total += sh_sums[4u * k + lane];
        }
        let to = 3u * id + lane;
        // Groups that only fill up the last row of a folded dispatch have no row.
        if lane < 3u && to < arrayLength(&partials) && id < medium.gaussian_rows {
            partials[to] = total;
        }
        if lane == 3u && id < arrayLength(&refinement_partials) && id < medium.gaussian_rows {
            refinement_partials[id] = total;
        }
    }
}
