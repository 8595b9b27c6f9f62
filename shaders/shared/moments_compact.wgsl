// Adam's moments in 16 bits: 64 bytes for the transform, and half the size of the coefficients. Needs
// adam.wgsl.
//
//   moments     [N*4]  vec4<u32>: 11 pairs in the order of the transform (first moment in the low half,
//                      root of the second in the high half), then as f32: second moments of red, green and
//                      blue, and the scale of sh_moments
//   sh_moments  [N*S]  vec2<u32>: four snorm16, laid out as sh_coeffs, in units of the scale
//
// Moments of the transform are stored as logarithms, because their sizes differ by many powers of ten between
// parameters, scenes and Gaussians. What matters is the relative error: at most 0.14 % and 0.07 %.
//
// The gradient of coefficient k of a channel is basis_k(direction) times that of the channel. The squares of
// the 2l + 1 functions of a band add up to (2l + 1) / 4 pi in every direction. So the mean square over a band
// is the same for all bands. One second moment per channel, E[v_c^2] / 4 pi, serves them all; for the
// constant colour it is exactly Adam's own.

@group(0) @binding(10) var<storage, read_write> moments: array<vec4<u32>>;
@group(0) @binding(11) var<storage, read_write> sh_moments: array<vec2<u32>>;

// The levels cover 2^-64 to 2^64.
const LOWEST: f32 = -64.0;
const LEVELS_FIRST: f32 = 256.0;
const LEVELS_ROOT: f32 = 512.0;

fn decode_first(words: vec4<u32>) -> vec4<f32> {
    let level = words & vec4<u32>(0x7fffu);
    let size = exp2(vec4<f32>(level) * (1.0 / LEVELS_FIRST) + LOWEST);
    let signed = select(size, -size, (words & vec4<u32>(0x8000u)) != vec4<u32>(0u));
    return select(signed, vec4<f32>(0.0), level == vec4<u32>(0u));
}

fn decode_root(words: vec4<u32>) -> vec4<f32> {
    let level = words >> vec4<u32>(16u);
    return select(exp2(vec4<f32>(level) * (1.0 / LEVELS_ROOT) + LOWEST), vec4<f32>(0.0), level == vec4<u32>(0u));
}

// Level 0 stands for zero and for everything below the lowest power.
fn encode(first: vec4<f32>, root: vec4<f32>) -> vec4<u32> {
    let tiny = vec4<f32>(5.4210109e-20);
    let m = clamp(round((log2(max(abs(first), tiny)) - LOWEST) * LEVELS_FIRST), vec4<f32>(0.0), vec4<f32>(32767.0));
    let s = clamp(round((log2(max(root, tiny)) - LOWEST) * LEVELS_ROOT), vec4<f32>(0.0), vec4<f32>(65535.0));
    let sign = select(vec4<u32>(0u), vec4<u32>(0x8000u), first < vec4<f32>(0.0));
    return vec4<u32>(m) | sign | (vec4<u32>(s) << vec4<u32>(16u));
}

fn keeps_gradients() -> bool {
    return false;
}
fn keep_gradients(i: u32, d0: vec4<f32>, d1: vec4<f32>, d2: vec4<f32>) {}
fn keep_colour_gradient(n: u32, gradient: vec4<f32>) {}

// State of the current Gaussian: second moments of the channels, the factor on first moments, and the scales
// of sh_moments.
var<private> second: vec3<f32>;
var<private> per_channel: vec3<f32>;
var<private> scale_before: f32;
var<private> scale_after: f32;

// `most` is the largest basis function, so that no first moment exceeds the scale.
fn begin_colour(i: u32, v_rgb: vec3<f32>, most: f32, pace: Pace) {
    let row2 = moments[4u * i + 2u];
    let row3 = moments[4u * i + 3u];
    let before = old(vec4<f32>(bitcast<f32>(row2.w), bitcast<f32>(row3.x), bitcast<f32>(row3.y), bitcast<f32>(row3.z)), pace);
    second = BETA2 * before.xyz + (1.0 - BETA2) * (SH_C0 * SH_C0) * v_rgb * v_rgb;
    scale_before = before.w;
    let largest = max(abs(v_rgb.x), max(abs(v_rgb.y), abs(v_rgb.z)));
    scale_after = BETA1 * scale_before + (1.0 - BETA1) * most * largest;
    per_channel = pace.unbias.x / (sqrt(second * pace.unbias.y) + EPSILON);
}

fn colour_step(n: u32, part: u32, gradient: vec4<f32>, rate: vec4<f32>, pace: Pace) -> vec4<f32> {
    let words = sh_moments[n];
    let before = old(scale_before * vec4<f32>(unpack2x16snorm(words.x), unpack2x16snorm(words.y)), pace);
    let m = moved(BETA1, before, gradient);
    let shares = m * select(0.0, 1.0 / scale_after, scale_after > 0.0);
    sh_moments[n] = vec2<u32>(pack2x16snorm(shares.xy), pack2x16snorm(shares.zw));
    // Four coefficients of three channels lie in three vectors.
    let p = per_channel;
    let channels = select(select(p.zxyz, p.yzxy, part == 1u), p.xyzx, part == 0u);
    return rate * channels * m;
}

fn end_colour(i: u32) {
    moments[4u * i + 3u] = vec4<u32>(bitcast<u32>(second.y), bitcast<u32>(second.z), bitcast<u32>(scale_after), 0u);
}

fn transform_step(i: u32, part: u32, gradient: vec4<f32>, rate: vec4<f32>, pace: Pace) -> vec4<f32> {
    let words = moments[4u * i + part];
    let root = old(decode_root(words), pace);
    let m = moved(BETA1, old(decode_first(words), pace), gradient);
    let v = moved(BETA2, root * root, gradient * gradient);
    var packed = encode(m, sqrt(v));
    if part == 2u {
        packed.w = bitcast<u32>(second.x);
    }
    moments[4u * i + part] = packed;
    return rate * (m * pace.unbias.x) / (sqrt(v * pace.unbias.y) + EPSILON);
}
