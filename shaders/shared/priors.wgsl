// The priors on direct signal and depth in one iteration (SMP-UWGS eq. 12 to 14). Mirror:
// core/src/gpu/layout.rs. Needs water.

struct Priors {
    // Width and height of the image, pixels.
    size: vec2<u32>,
    // 1: pixels of the photograph with alpha below 255 are ignored.
    masked: u32,
    // 1: the dark channel is computed from the photograph; 0: from the render.
    on_photograph: u32,
    // 1: the render is in linear light; 0: in sRGB.
    linear: u32,
    // Radius of a patch, pixels.
    radius: u32,
    // Scene scale, scene units.
    unit: f32,
    // Weight of eq. 13, per pixel, and weight of its negative part relative to the positive part.
    dark_weight: f32,
    negative: f32,
    // Weight of eq. 14, per pixel.
    smooth_weight: f32,
    pad0: f32,
    pad1: f32,
}

// In place of a pixel's signal: no window selects it.
const NO_SIGNAL: f32 = 3.0e38;
// In place of the row or column of a minimum: the window has none.
const NOWHERE: u32 = 0xffffffffu;
// Keeps the weight of a channel without attenuation finite (code of SMP-UWGS).
const LEAST_ATTENUATION: f32 = 1e-6;

// w_c of eq. 12: 1 / beta_d, scaled so that the largest is 1 (code of SMP-UWGS; the paper: "normalised").
fn channel_weights(water: Water, unit: f32) -> vec3<f32> {
    let w = 1.0 / (water.beta_d * unit + LEAST_ATTENUATION);
    return w / max(w.x, max(w.y, w.z));
}

// B of a pixel whose alpha is not near 0: backscatter at its expected range, linear light.
fn backscatter(water: Water, alpha: f32, range: f32) -> vec3<f32> {
    return water.b_inf * (1.0 - alpha * exp(-water.beta_b * (range / alpha)));
}

// Whether a pixel of the photograph counts; `masked` as in Priors.
fn counts(pixel: u32, masked: u32) -> bool {
    return ((pixel >> 24u) == 255u) | (masked == 0u);
}

// The photograph's colour, sRGB.
fn photographed(pixel: u32) -> vec3<f32> {
    return vec3<f32>(f32(pixel & 255u), f32((pixel >> 8u) & 255u), f32((pixel >> 16u) & 255u)) / 255.0;
}
