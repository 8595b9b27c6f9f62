//@ import frame, counters, gaussian, harmonics, colour, water, medium, gather
//@ variant water_gradients gather=colour_gradient_of_slots
//@ variant water_gradients_bands gather=colour_gradient_of_bands
// Gradients w.r.t. the water parameters through the visible Gaussians of one block, when the water acts on
// Gaussians.
//
//     w.r.t. beta_d: -r J exp(-beta_d r) v
//     w.r.t. beta_b: r b_inf exp(-beta_b r) v
//     w.r.t. b_inf:  (1 - exp(-beta_b r)) v
// v is the gradient w.r.t. the linear light of a Gaussian, from that w.r.t. its blended value
// (colour_gradient_of_*.wgsl).
//   partials [rows*3] vec4: w.r.t. beta_d, beta_b and b_inf, summed over the workgroup's 64 Gaussians,
//                     in their order
// One thread per Gaussian of the block, visible or not, so that the sums are the same in bands of tiles. Runs
// before project_backward moves the Gaussians. Twin: core/twins/src/water.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> block: Block;
@group(0) @binding(2) var<uniform> medium: Medium;
@group(0) @binding(3) var<storage, read> counters: array<u32>;
@group(0) @binding(4) var<storage, read> flags: array<u32>;
@group(0) @binding(8) var<storage, read> transforms: array<vec4<f32>>;
@group(0) @binding(9) var<storage, read> sh_coeffs: array<vec4<f32>>;
@group(0) @binding(10) var<uniform> water: Water;
@group(0) @binding(11) var<storage, read_write> partials: array<vec4<f32>>;

var<workgroup> sh_sums: array<vec4<f32>, 192>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let id = folded(group, groups);
    let i = id * 64u + lane;
    var by_d = vec3<f32>(0.0);
    var by_b = vec3<f32>(0.0);
    var by_inf = vec3<f32>(0.0);
    // After an overflow there is nothing to sum.
    if i < block.count && counters[OVERFLOW] == 0u {
        let by_blended = v_colour(i);
        if any(by_blended != vec3<f32>(0.0)) {
            let offset = transforms[3u * i].xyz - frame.eye;
            let r = length(offset);
            let own = max(colour(i, offset / r), vec3<f32>(0.0));
            let clear = decoded(own);
            let v = by_light(veiled(frame.medium, arrayLength(&transforms) + 6u), water, own, r, by_blended);
            let veil = exp(-water.beta_b * r);
            by_d = -r * clear * exp(-water.beta_d * r) * v;
            by_b = r * water.b_inf * veil * v;
            by_inf = (1.0 - veil) * v;
        }
    }
    sh_sums[3u * lane] = vec4<f32>(by_d, 0.0);
    sh_sums[3u * lane + 1u] = vec4<f32>(by_b, 0.0);
    sh_sums[3u * lane + 2u] = vec4<f32>(by_inf, 0.0);
    workgroupBarrier();
    if lane < 3u {
        var total = vec4<f32>(0.0);
        for (var k = 0u; k < 64u; k++) {
            total += sh_sums[3u * k + lane];
        }
        // Blocks need not begin at a multiple of 64, so each may have one row more than it fills.
        let to = 3u * (medium.gaussian_rows + block.base / 64u + block.index + id) + lane;
        if id * 64u < block.count && to < arrayLength(&partials) {
            partials[to] = total;
        }
    }
}
