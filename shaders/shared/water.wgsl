// What water does to light (SMP-UWGS eq. 7), in linear light, and the sRGB curve (IEC 61966-2-1). Mirror:
// core/src/gpu/layout.rs.
//
//     I = J exp(-beta_d r) + b_inf (1 - exp(-beta_b r)),  r the distance along the ray in scene units
// When the water acts on pixels, beta_d and beta_b may depend on r themselves (eq. 9, `refined`).
// The colours of Gaussians are J in sRGB, so that any viewer shows a model correctly. They are decoded before
// the water acts. The result is blended in linear light, or encoded again and blended in sRGB as viewers
// blend. MEDIUM_AS_SHOWN and MEDIUM_OVER_BLACK blend the colours as they are. The curve continues above 1.
// Twin: core/twins/src/water.rs

struct Water {
    // 1/scene unit.
    beta_d: vec3<f32>,
    // Scale of eq. 9; 0 if the coefficients do not depend on range.
    scale: f32,
    beta_b: vec3<f32>,
    // Eq. 9: 1 / the unit of range, 1/scene unit.
    per_unit: f32,
    // Linear light.
    b_inf: vec3<f32>,
    // Largest change of log b_inf with direction; 0 if b_inf is the same in all directions.
    most: f32,
    // Eq. 9: weight and bias of the factor on beta_d, then of the factor on beta_b.
    refinement: vec4<f32>,
    // Change of log b_inf with the unit direction from the camera, scene axes: slope in xyz, offset in w.
    red: vec4<f32>,
    green: vec4<f32>,
    blue: vec4<f32>,
}

// Values of frame.medium. MEDIUM_NONE: colours are blended as they are.
const MEDIUM_NONE: u32 = 0u;
// The water acts on each Gaussian.
const MEDIUM_PER_GAUSSIAN: u32 = 1u;
// Colours are only decoded: the water acts on the image, or is left out.
const MEDIUM_DECODED: u32 = 2u;
// Only the backscatter in front of each Gaussian, without the Gaussian's own colour.
const MEDIUM_VEIL: u32 = 3u;
// As MEDIUM_PER_GAUSSIAN and MEDIUM_VEIL, blended in sRGB.
const MEDIUM_PER_GAUSSIAN_SRGB: u32 = 4u;
const MEDIUM_VEIL_SRGB: u32 = 5u;
// Colours are blended in sRGB and the image is decoded: the water acts on the image, or is left out.
const MEDIUM_AS_SHOWN: u32 = 6u;
// The same, but rays that hit nothing are black, not open water.
const MEDIUM_OVER_BLACK: u32 = 7u;

// Eq. 9 as factors on beta_d and beta_b that all channels share: [m_d, m_b] = ReLU(Scale sigmoid(w z + b)), z
// the range in its unit. Scale is above 0, so the ReLU changes nothing. This function gives the two sigmoids.
// Beyond 30 they are constant in f32.
fn refining_sigmoids(water: Water, range: f32) -> vec2<f32> {
    let x = water.refinement.xz * (range * water.per_unit) + water.refinement.yw;
    return 1.0 / (1.0 + exp(-clamp(x, vec2<f32>(-30.0), vec2<f32>(30.0))));
}

fn refining_factors(water: Water, range: f32) -> vec2<f32> {
    return select(water.scale * refining_sigmoids(water, range), vec2<f32>(1.0), water.scale == 0.0);
}

// Factors on b_inf along `direction` (unit length, scene axes). Twin: `ByDirection::factors`.
fn colour_factors(water: Water, direction: vec3<f32>) -> vec3<f32> {
    let d = vec4<f32>(direction, 1.0);
    let x = vec3<f32>(dot(water.red, d), dot(water.green, d), dot(water.blue, d));
    return select(exp(clamp(x, vec3<f32>(-water.most), vec3<f32>(water.most))), vec3<f32>(1.0), water.most == 0.0);
}

// The water with its coefficients at `range`.
fn refined(water: Water, range: f32) -> Water {
    let m = refining_factors(water, range);
    var at = water;
    at.beta_d *= m.x;
    at.beta_b *= m.y;
    return at;
}

fn decoded(s: vec3<f32>) -> vec3<f32> {
    let v = max(s, vec3<f32>(0.0));
    return select(pow((v + 0.055) / 1.055, vec3<f32>(2.4)), v / 12.92, v <= vec3<f32>(0.04045));
}

// Derivative of `decoded`.
fn decoded_slope(s: vec3<f32>) -> vec3<f32> {
    let v = max(s, vec3<f32>(0.0));
    return select((2.4 / 1.055) * pow((v + 0.055) / 1.055, vec3<f32>(1.4)), vec3<f32>(1.0 / 12.92), v <= vec3<f32>(0.04045));
}

// The linear part continues below 0; its slope of 12.92 is the largest.
fn encoded(l: vec3<f32>) -> vec3<f32> {
    let v = max(l, vec3<f32>(0.0031308));
    return select(1.055 * pow(v, vec3<f32>(1.0 / 2.4)) - 0.055, 12.92 * l, l <= vec3<f32>(0.0031308));
}

// Derivative of `encoded`.
fn encoded_slope(l: vec3<f32>) -> vec3<f32> {
    let v = max(l, vec3<f32>(0.0031308));
    return select((1.055 / 2.4) * pow(v, vec3<f32>(1.0 / 2.4 - 1.0)), vec3<f32>(12.92), l <= vec3<f32>(0.0031308));
}

// Linear light of a colour `s` (sRGB, not below 0) seen at `range`.
fn lit(water: Water, s: vec3<f32>, range: f32) -> vec3<f32> {
    return decoded(s) * exp(-water.beta_d * range) + water.b_inf * (1.0 - exp(-water.beta_b * range));
}

// The value to blend for a Gaussian of colour `s` (sRGB, not below 0).
fn in_medium(medium: u32, water: Water, s: vec3<f32>, range: f32) -> vec3<f32> {
    if medium == MEDIUM_DECODED {
        return decoded(s);
    }
    if medium >= MEDIUM_AS_SHOWN {
        return s;
    }
    let own = select(s, vec3<f32>(0.0), medium == MEDIUM_VEIL || medium == MEDIUM_VEIL_SRGB);
    let seen = lit(water, own, range);
    return select(seen, encoded(seen), medium >= MEDIUM_PER_GAUSSIAN_SRGB);
}

// From the gradient w.r.t. the blended value of a Gaussian to that w.r.t. its linear light.
fn by_light(medium: u32, water: Water, s: vec3<f32>, range: f32, v: vec3<f32>) -> vec3<f32> {
    return select(v, v * encoded_slope(lit(water, s, range)), medium >= MEDIUM_PER_GAUSSIAN_SRGB && medium < MEDIUM_AS_SHOWN);
}

// Factor on the learning rate of a colour `s` (sRGB) seen at `range` through the water: 1 over the slope of
// the seen colour, also in sRGB. A step then changes the seen colour as much as in air. At least 1, at most
// MAX_COLOUR_LR_SCALE.
const MAX_COLOUR_LR_SCALE: f32 = 8.0;

fn lr_scale_under_water(water: Water, s: vec3<f32>, range: f32) -> vec3<f32> {
    let here = refined(water, range);
    let slope = exp(-here.beta_d * range) * decoded_slope(s) * encoded_slope(lit(here, s, range));
    return 1.0 / clamp(slope, vec3<f32>(1.0 / MAX_COLOUR_LR_SCALE), vec3<f32>(1.0));
}
