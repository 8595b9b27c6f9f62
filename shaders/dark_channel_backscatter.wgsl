//@ import frame, water, medium, priors
// Physics-aware dark channel, step 6 of 6: the part of the gradient that flows through the backscatter B of
// the signal.
//
//     v_B^c = -w_c v_m for the channel c of m;  B = b_inf (1 - a e),  e = exp(-beta_b r),  r = R/a
//     w.r.t. R: b_inf beta_b e,  a: -b_inf e (1 + beta_b r),  beta_b: b_inf a r e,  b_inf: 1 - a e
//   image         [H*W] vec4: blended colour and alpha
//   range_image   [H*W] R, the blended range, scene units
//   signal        [H*W] vec2: bits of the gradient w.r.t. m, and the channel of m
//   v_image       [H*W] vec4: w.r.t. the blended colour and alpha; added to
//   v_range_image [H*W] w.r.t. the blended range; added to
//   partials      [rows*3] vec4: gradient w.r.t. beta_d, beta_b and b_inf; the rows of pixels are added to
// A thread takes every 64th pixel of its workgroup's chunk, as in `water_backward`, which runs before. The
// sums of the threads are added in their order, so runs are identical. Twin: core/twins/src/priors.rs

@group(0) @binding(0) var<uniform> priors: Priors;
@group(0) @binding(1) var<uniform> water: Water;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> range_image: array<f32>;
@group(0) @binding(4) var<storage, read> signal: array<vec2<u32>>;
@group(0) @binding(5) var<storage, read_write> v_image: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> v_range_image: array<f32>;
@group(0) @binding(7) var<storage, read_write> partials: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> refinement_partials: array<vec4<f32>>;

var<workgroup> sh_sums: array<vec4<f32>, 192>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let id = folded(group, groups);
    let pixels = priors.size.x * priors.size.y;
    let w = channel_weights(water, priors.unit);
    var by_b = vec3<f32>(0.0);
    var by_inf = vec3<f32>(0.0);
    var by_refinement = vec2<f32>(0.0);
    for (var k = 0u; k < WATER_CHUNK / 64u; k++) {
        let i = id * WATER_CHUNK + k * 64u + lane;
        if i < pixels {
            let taken = signal[i];
            let v = bitcast<f32>(taken.x);
            let alpha = image[i].a;
            if v != 0.0 && alpha >= LEAST_ALPHA {
                let r = range_image[i] / alpha;
                let own = select(vec3<f32>(0.0), vec3<f32>(1.0), vec3<u32>(taken.y) == vec3<u32>(0u, 1u, 2u));
                let v_b = -v * own * w;
                let m = refining_factors(water, r).y;
                let beta_b = m * water.beta_b;
                let through = exp(-beta_b * r);
                let veil = water.b_inf * through;
                let v_beta = (alpha * r) * veil * v_b;
                // W.r.t. the argument of the sigmoid of eq. 9; 0 without one, because Scale is 0.
                let s = refining_sigmoids(water, r).y;
                let v_x = water.scale * dot(water.beta_b, v_beta) * s * (1.0 - s);
                let v_r = v_x * water.refinement.z * water.per_unit / alpha;
                v_range_image[i] += dot(v_b, beta_b * veil) + v_r;
                v_image[i].a -= dot(v_b, veil * (1.0 + beta_b * r)) + v_r * r;
                by_b += m * v_beta;
                by_inf += (1.0 - alpha * through) * v_b;
                by_refinement += v_x * vec2<f32>(r * water.per_unit, 1.0);
            }
        }
    }
    sh_sums[3u * lane] = vec4<f32>(by_b, 0.0);
    sh_sums[3u * lane + 1u] = vec4<f32>(by_inf, 0.0);
    sh_sums[3u * lane + 2u] = vec4<f32>(0.0, 0.0, by_refinement);
    workgroupBarrier();
    if lane < 3u {
        var total = vec4<f32>(0.0);
        for (var k = 0u; k < 64u; k++) {
            total += sh_sums[3u * k + lane];
        }
        // Rows of pixels come first. Groups that only fill up the last row of a folded dispatch have no row.
        let to = 3u * id + 1u + lane;
        if lane < 2u && to < arrayLength(&partials) && id * WATER_CHUNK < pixels {
            partials[to] += total;
        }
        if lane == 2u && id < arrayLength(&refinement_partials) && id * WATER_CHUNK < pixels {
            refinement_partials[id] += total;
        }
    }
}
