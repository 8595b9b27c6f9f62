// The priors on direct signal and depth of one iteration (SMP-UWGS eq. 12 to 14). Mirror:
// core/src/gpu/layout.rs. Needs water.

struct Priors {
    // Width and height of the picture, pixels.
    size: vec2<u32>,
    // 1: pixels of the truth with alpha below 255 do not count.
    masked: u32,
    // 1: the dark channel is that of the photograph, else that of the picture that was rendered.
    on_photograph: u32,
    // 1: the picture that was rendered is in linear light, else in sRGB.
    linear: u32,
    // Pixels of the patch on either side of its centre.
    radius: u32,
    // Scene units: the usual viewing distance.
    unit: f32,
    // Eq. 13, by pixel of the picture: weight of both parts, and what the negative part weighs beside the
    // positive.
    dark_weight: f32,
    negative: f32,
    // Eq. 14, by pixel of the picture.
    smooth_weight: f32,
    pad0: f32,
    pad1: f32,
}

// In the place of a pixel's signal: no window takes it.
const NO_SIGNAL: f32 = 3.0e38;
// In the place of the row or column of a window's minimum: it has none.
const NOWHERE: u32 = 0xffffffffu;
// Keeps the weight of a channel without attenuation finite (SMP-UWGS's code).
const LEAST_ATTENUATION: f32 = 1e-6;

// w_c of eq. 12: 1 / beta_d, the largest of the three as 1 (SMP-UWGS's code; the paper says "normalised").
fn channel_weights(water: Water, unit: f32) -> vec3<f32> {
    let w = 1.0 / (water.beta_d * unit + LEAST_ATTENUATION);
    return w / max(w.x, max(w.y, w.z));
}

// B of a pixel whose alpha is not near 0: the water's own light by its expected range, linear light.
fn backscatter(water: Water, alpha: f32, range: f32) -> vec3<f32> {
    return water.b_inf * (1.0 - alpha * exp(-water.beta_b * (range / alpha)));
}

// Whether the photograph's pixel counts, `masked` as Priors.masked.
fn counts(pixel: u32, masked: u32) -> bool {
    return ((pixel >> 24u) == 255u) | (masked == 0u);
}

// The photograph's colour, sRGB.
fn photographed(pixel: u32) -> vec3<f32> {
    return vec3<f32>(f32(pixel & 255u), f32((pixel >> 8u) & 255u), f32((pixel >> 16u) & 255u)) / 255.0;
}
