// How the water is applied and stepped in one iteration. Mirror: core/src/gpu/layout.rs. Needs water.

struct Medium {
    // Pixels of the image.
    pixels: u32,
    // MEDIUM_PER_GAUSSIAN or MEDIUM_PER_GAUSSIAN_SRGB; when the water acts on pixels, MEDIUM_DECODED,
    // MEDIUM_AS_SHOWN or MEDIUM_OVER_BLACK.
    compose: u32,
    // 1: the formed image is encoded for the loss. 0: it is in sRGB already, or the loss is in linear light.
    encode: u32,
    // Rows of partials to sum: first those of pixels, then those of Gaussians.
    rows: u32,
    gaussian_rows: u32,
    // 1: pixels of the photograph with alpha below 255 are ignored.
    masked: u32,
    // Scene scale, scene units: the unit of the unconstrained parameters of eq. 8.
    unit: f32,
    // Adam: rate, 1/(1-b1^t), 1/(1-b2^t). decay is the weight of the squared water parameters (eq. 16),
    // coefficients in 1/unit.
    rate: f32,
    unbias1: f32,
    unbias2: f32,
    decay: f32,
    // Eq. 15: weight per pixel of alpha where the photograph shows open water, and the largest distance in
    // sRGB from its colour that counts as open water.
    background_weight: f32,
    background_distance: f32,
    // Weight per pixel of 1 - alpha in all other pixels.
    surface_weight: f32,
    // 1: water_step accumulates the gradients for WaterParamPredict and takes no step.
    gathers: u32,
    // Columns and rows of the view's ray map; 0 if the view has none, and colours decide instead.
    map_columns: u32,
    map_rows: u32,
    // Weight per pixel of the alpha of pixels that the map marks as open water.
    open_weight: f32,
    // Weight per pixel of the difference between the log range and that of the cell's sparse points, beyond
    // range_slack.
    range_weight: f32,
    range_slack: f32,
    // Distance in sRGB from the colour of open water beyond which a pixel in a MAP_EDGE cell is a surface.
    edge_distance: f32,
}

// Kind of a map cell, in the two lowest bits of its range (f32, scene units; 0 if the cell has no sparse
// point).
const MAP_UNKNOWN: u32 = 0u;
const MAP_SURFACE: u32 = 1u;
const MAP_OPEN: u32 = 2u;
const MAP_EDGE: u32 = 3u;

// Pixels that a workgroup of water_backward sums.
const WATER_CHUNK: u32 = 1024u;
// When the water acts on pixels, a pixel with less alpha is open water.
const LEAST_ALPHA: f32 = 1e-3;

// J times alpha of a pixel, linear light, from the blended colour, when the water acts on pixels.
fn own_light(compose: u32, seen: vec4<f32>) -> vec3<f32> {
    if compose == MEDIUM_OVER_BLACK {
        return decoded(seen.rgb);
    }
    return select(seen.rgb, seen.a * decoded(seen.rgb / seen.a), compose == MEDIUM_AS_SHOWN);
}

// Share of a pixel that receives backscatter: all of it, or only its alpha if rays that hit nothing are
// black.
fn watery_share(compose: u32, alpha: f32) -> f32 {
    return select(1.0, alpha, compose == MEDIUM_OVER_BLACK);
}

// A pixel as the water forms it, in the light in which the water is composed. `seen` is the blended colour
// with its alpha, `range` the blended range.
fn formed(compose: u32, water: Water, seen: vec4<f32>, range: f32) -> vec3<f32> {
    if compose == MEDIUM_PER_GAUSSIAN_SRGB {
        return seen.rgb + (1.0 - seen.a) * encoded(water.b_inf);
    }
    if compose == MEDIUM_PER_GAUSSIAN {
        return seen.rgb + (1.0 - seen.a) * water.b_inf;
    }
    if !(seen.a >= LEAST_ALPHA) {
        return watery_share(compose, 0.0) * water.b_inf;
    }
    let r = range / seen.a;
    let here = refined(water, r);
    let veil = water.b_inf * (watery_share(compose, seen.a) - seen.a * exp(-here.beta_b * r));
    return own_light(compose, seen) * exp(-here.beta_d * r) + veil;
}
