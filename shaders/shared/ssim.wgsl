// The Gaussian window of SSIM: 11 taps, sigma 1.5, as in 3DGS (Wang et al. 2004). Zero padding at borders.
//
// A thread computes eight neighbouring outputs at once. It loads each of the 18 inputs that they need once,
// not eleven times. Input k has weight weights_a[k] in outputs 0 to 3 and weights_b[k] in outputs 4 to 7.

const RUN: u32 = 8u;

struct LossParams {
    size: vec2<u32>,
    // 0, 1 or 2.
    channel: u32,
    // 1: pixels of the photograph with alpha below 255 are ignored.
    masked: u32,
    ssim_weight: f32,
    // 1 / (3 * width * height).
    scale: f32,
    // Entry of the log of losses for this iteration.
    log_at: u32,
    pad: u32,
    weights_a: array<vec4<f32>, 18>,
    weights_b: array<vec4<f32>, 18>,
}

// 1 if the pixel counts, else 0.
fn mask_of(pixel: u32) -> f32 {
    return select(0.0, 1.0, (pixel >> 24u) == 255u);
}
