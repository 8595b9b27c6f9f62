// The view embedding of a training view (FiLM, SMP-UWGS eq. 10): factors on the colours of its image, by cell
// of pixels. Mirror: core/src/gpu/layout.rs. Twin: core/twins/src/film.rs
//
// For a cell of mean colour x, with hidden unit j:
//     a_j = W1_j x + b1_j,  s_j = a_j (1 + gamma_j) + delta_j,  o = sum of W2_j (relu(s_j) - relu(a_j))
//     F = exp(BOUND tanh(o / BOUND))
// gamma and delta are the embedding of the view. With an embedding of 0, as for held-out views, F is 1.
//   weights    [32*3]     vec4: (W1_j, b1_j) and (W2_j, 0) of each unit; then their first moments; then their
//                         second moments
//   embeddings [views*16] vec2: gamma_j, delta_j

struct Film {
    // Image size in pixels, and number of cells along each side.
    size: vec2<u32>,
    cells: vec2<u32>,
    // Index of the view, and number of views.
    view: u32,
    views: u32,
    // Adam on the weights: rate, and 1/(1-b1^t), 1/(1-b2^t).
    rate: f32,
    unbias1: f32,
    unbias2: f32,
    // The same for the embedding of the view; t counts the steps of this view.
    view_rate: f32,
    view_unbias1: f32,
    view_unbias2: f32,
}

const HIDDEN: u32 = 16u;
// Colours become at most exp(0.5) = 1.65 times brighter or darker.
const BOUND: f32 = 0.5;

// First pixel of part `i` of a side divided into `count` parts, whose sizes differ by at most one pixel.
fn part_begin(i: u32, count: u32, side: u32) -> u32 {
    return i * side / count;
}

// The part that contains pixel `x`.
fn part_of(x: u32, count: u32, side: u32) -> u32 {
    return ((x + 1u) * count - 1u) / side;
}

struct Between {
    // The part whose centre precedes the pixel, and the position of the pixel between that centre (0) and the
    // next (1).
    part: u32,
    share: f32,
}

// Pixels before the first centre or after the last have the factors of that part.
fn between(x: u32, count: u32, side: u32) -> Between {
    let at = clamp((f32(x) + 0.5) * f32(count) / f32(side) - 0.5, 0.0, f32(count - 1u));
    let part = min(u32(at), max(count, 2u) - 2u);
    return Between(part, at - f32(part));
}

// Interpolation weight of `part` at a pixel.
fn share_of(b: Between, part: u32) -> f32 {
    return select(0.0, 1.0 - b.share, part == b.part) + select(0.0, b.share, part == b.part + 1u);
}
