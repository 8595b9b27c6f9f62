//@ import frame, water, medium, priors
// Physics-aware dark channel, step 1 of 6: the direct signal of each pixel, in its darkest channel (SMP-UWGS
// eq. 12).
//
//     D^c = I^c - B^c,  m = min over c of w_c D^c,  linear light
//     B   = b_inf (1 - a exp(-beta_b r)),  a alpha, r = R/a the expected range
// I is the rendered underwater image or the photograph. If the water acts on Gaussians, each Gaussian was
// blended with the B of its own range; the B of the expected range is then an approximation.
// Open water (alpha below LEAST_ALPHA) has no direct signal: m = 0. A pixel that is masked or not finite has
// NO_SIGNAL.
//   range_image [H*W] R, the blended range, scene units
//   seen   [H*W] vec4: the underwater image, and alpha
//   truth  [H*W] packed photograph, sRGB; the highest byte is the mask
//   signal [H*W] vec2: bits of m, and its channel (the first of equal ones)
// One thread per pixel. Twin: core/twins/src/priors.rs

@group(0) @binding(0) var<uniform> priors: Priors;
@group(0) @binding(1) var<uniform> water: Water;
@group(0) @binding(2) var<storage, read> range_image: array<f32>;
@group(0) @binding(3) var<storage, read> seen: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> truth: array<u32>;
@group(0) @binding(5) var<storage, read_write> signal: array<vec2<u32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i < priors.size.x * priors.size.y {
        let picture = seen[i];
        let pixel = truth[i];
        var m = 0.0;
        var channel = 0u;
        if picture.a >= LEAST_ALPHA {
            let shown = select(picture.rgb, photographed(pixel), priors.on_photograph != 0u);
            let light = select(decoded(shown), shown, priors.linear != 0u);
            let d = channel_weights(water, priors.unit) * (light - backscatter(refined(water, range_image[i] / picture.a), picture.a, range_image[i]));
            m = d.x;
            if d.y < m {
                m = d.y;
                channel = 1u;
            }
            if d.z < m {
                m = d.z;
                channel = 2u;
            }
        }
        if !(counts(pixel, priors.masked) && is_finite(m)) {
            m = NO_SIGNAL;
        }
        signal[i] = vec2<u32>(bitcast<u32>(m), channel);
    }
}
