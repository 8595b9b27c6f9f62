// The Gaussian window of SSIM: 11 taps, sigma 1.5, as in 3DGS (Wang et al. 2004). Zero padding at borders.
//
// A thread makes eight neighbouring outputs at once: each of the 18 inputs that they need is loaded once, not
// eleven times. Input k weighs weights_a[k] in outputs 0 to 3 and weights_b[k] in outputs 4 to 7.

const RUN: u32 = 8u;

struct LossParams {
    size: vec2<u32>,
    // 0, 1 or 2.
    channel: u32,
    // 1: pixels of the truth with alpha below 255 are ignored.
    masked: u32,
    ssim_weight: f32,
    // 1 / (3 * width * height).
    scale: f32,
    // Where in the log of losses this iteration writes.
    log_at: u32,
    pad: u32,
    weights_a: array<vec4<f32>, 18>,
    weights_b: array<vec4<f32>, 18>,
}

// 1 where the pixel counts.
fn mask_of(pixel: u32) -> f32 {
    return select(0.0, 1.0, (pixel >> 24u) == 255u);
}
