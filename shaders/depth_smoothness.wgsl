//@ import frame, water, medium, priors
// Depth smoothness that stops at edges of the photograph (SMP-UWGS eq. 14), backward.
//
//     loss = lambda / HW * sum over neighbours i, j in a row or column of exp(-|I_i - I_j|) |D_i - D_j|
// D is the expected range in units of the scene scale. |I_i - I_j| is the mean over the photograph's sRGB
// channels of the absolute difference. SeaSplat uses the signed difference, which gives half of the
// edges more weight than flat areas. Pairs count if both pixels count and have alpha above LEAST_ALPHA.
//   image         [H*W] vec4: blended colour and alpha
//   range_image   [H*W] R, the blended range, scene units; D = R / alpha / unit
//   truth         [H*W] packed photograph, sRGB; the highest byte is the mask
//   v_image       [H*W] vec4: w.r.t. the blended colour and alpha; added to
//   v_range_image [H*W] w.r.t. the blended range; added to
// One thread per pixel gathers from its four neighbours. Runs after `water_backward`.
// Twin: core/twins/src/priors.rs

@group(0) @binding(0) var<uniform> priors: Priors;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> range_image: array<f32>;
@group(0) @binding(3) var<storage, read> truth: array<u32>;
@group(0) @binding(4) var<storage, read_write> v_image: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> v_range_image: array<f32>;

// Derivative w.r.t. D of a pixel with this colour and range, from its pair with pixel `j`; 0 if there is no
// pair. Without branches, because a CPU adapter executes both sides.
fn pair(is_there: bool, j: u32, own: vec3<f32>, range: f32) -> f32 {
    let alpha = image[j].a;
    let pixel = truth[j];
    let edge = dot(abs(photographed(pixel) - own), vec3<f32>(1.0 / 3.0));
    let v = exp(-edge) * sign(range - range_image[j] / max(alpha, LEAST_ALPHA));
    return select(0.0, v, is_there & (alpha >= LEAST_ALPHA) & counts(pixel, priors.masked));
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    let width = priors.size.x;
    if i < width * priors.size.y {
        let alpha = image[i].a;
        let pixel = truth[i];
        if alpha >= LEAST_ALPHA && counts(pixel, priors.masked) {
            let own = photographed(pixel);
            let r = range_image[i] / alpha;
            let column = i % width;
            let row = i / width;
            let left = column > 0u;
            let right = column + 1u < width;
            let above = row > 0u;
            let below = row + 1u < priors.size.y;
            let v = pair(left, select(i, i - 1u, left), own, r) + pair(right, select(i, i + 1u, right), own, r)
                + pair(above, select(i, i - width, above), own, r)
                + pair(below, select(i, i + width, below), own, r);
            let v_range = priors.smooth_weight * v / (priors.unit * alpha);
            v_range_image[i] += v_range;
            v_image[i].a -= v_range * r;
        }
    }
}
