// How the water is composed and stepped in one iteration. Mirror: core/src/gpu/layout.rs. Needs water.

struct Medium {
    // Pixels of the picture.
    pixels: u32,
    // MEDIUM_PER_GAUSSIAN, the same in sRGB, or where the water acts on pixels MEDIUM_DECODED,
    // MEDIUM_AS_SHOWN or MEDIUM_OVER_BLACK.
    compose: u32,
    // 1: what is formed is encoded for the loss; 0 where it is in sRGB already, or the loss in linear light.
    encode: u32,
    // Rows of partials that are summed; those of pixels come first, then those of Gaussians.
    rows: u32,
    gaussian_rows: u32,
    // 1: pixels of the truth with alpha below 255 are ignored.
    masked: u32,
    // Scene units by which the unconstrained numbers of eq. 8 are multiplied: the usual viewing distance.
    unit: f32,
    // Adam: rate, and 1/(1-b1^t), 1/(1-b2^t); weight of the squares of the nine (eq. 16), coefficients in
    // 1/unit.
    rate: f32,
    unbias1: f32,
    unbias2: f32,
    decay: f32,
    // Eq. 15: weight by pixel of the alpha of pixels whose photograph is open water, and the distance in sRGB
    // up to which it is.
    background_weight: f32,
    background_distance: f32,
    // Weight by pixel of what alpha lacks to 1 in all other pixels.
    surface_weight: f32,
    // 1: water_step sums the gradients for WaterParamPredict in place of a step.
    gathers: u32,
    // Columns and rows of the map of what the view's rays end on; 0 where the view has none and colours tell.
    map_columns: u32,
    map_rows: u32,
    // Weight by pixel of the alpha of pixels that the map has as open water.
    open_weight: f32,
    // Weight by pixel of how far the logarithm of the range is from that of the sparse points of the cell,
    // beyond range_slack.
    range_weight: f32,
    range_slack: f32,
    // Distance in sRGB from the colour of open water beyond which a pixel in a cell of MAP_EDGE is a surface.
    edge_distance: f32,
}

// What a cell of the map is: in the two lowest bits of its range (f32, scene units; 0 where no sparse point
// lies in it).
const MAP_UNKNOWN: u32 = 0u;
const MAP_SURFACE: u32 = 1u;
const MAP_OPEN: u32 = 2u;
const MAP_EDGE: u32 = 3u;

// Pixels that a workgroup of water_backward sums.
const WATER_CHUNK: u32 = 1024u;
// Pixels with less alpha are open water where the water acts on pixels.
const LEAST_ALPHA: f32 = 1e-3;

// J of a pixel times its alpha in linear light, from what was blended, where the water acts on pixels.
fn own_light(compose: u32, seen: vec4<f32>) -> vec3<f32> {
    if compose == MEDIUM_OVER_BLACK {
        return decoded(seen.rgb);
    }
    return select(seen.rgb, seen.a * decoded(seen.rgb / seen.a), compose == MEDIUM_AS_SHOWN);
}

// How much of a pixel of this alpha has the water behind it that ends no ray, its own alpha included.
fn watery_share(compose: u32, alpha: f32) -> f32 {
    return select(1.0, alpha, compose == MEDIUM_OVER_BLACK);
}

// A pixel in the light of which the water makes it: `seen` is what was blended and its alpha, `range` the
// blended range.
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
