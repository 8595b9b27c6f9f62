// The view embedding of a training view (FiLM, SMP-UWGS eq. 10): factors on the colours of its picture, by
// cell of pixels. Mirror: core/src/gpu/layout.rs. Twin: core/twins/src/film.rs
//
// Of a cell whose mean colour is x, with hidden unit j:
//     a_j = W1_j x + b1_j,  s_j = a_j (1 + gamma_j) + delta_j,  o = sum of W2_j (relu(s_j) - relu(a_j))
//     F = exp(BOUND tanh(o / BOUND))
// gamma and delta are the embedding of the view. Without one (0) F is 1: that is what held-out views have.
//   weights    [32*3]     vec4: (W1_j, b1_j) and (W2_j, 0) of each unit; their first moments; their second
//                         ones
//   embeddings [views*16] vec2: gamma_j, delta_j

struct Film {
    // Pixels of the picture, and the parts that each side is cut into, whose products are the cells.
    size: vec2<u32>,
    cells: vec2<u32>,
    // Index of the view, and number of all views.
    view: u32,
    views: u32,
    // Adam on the weights: rate, and 1/(1-b1^t), 1/(1-b2^t).
    rate: f32,
    unbias1: f32,
    unbias2: f32,
    // The same on the embedding of the view, with t the number of its steps.
    view_rate: f32,
    view_unbias1: f32,
    view_unbias2: f32,
}

const HIDDEN: u32 = 16u;
// Colours become at most exp(0.5) = 1.65 times as bright or as dark.
const BOUND: f32 = 0.5;

// First pixel of part `i` of a side that is cut into `count` parts: they differ by at most one pixel.
fn part_begin(i: u32, count: u32, side: u32) -> u32 {
    return i * side / count;
}

// The part that pixel `x` lies in.
fn part_of(x: u32, count: u32, side: u32) -> u32 {
    return ((x + 1u) * count - 1u) / side;
}

struct Between {
    // The part whose centre is before a pixel, and how far the pixel is on the way to the next one's.
    part: u32,
    share: f32,
}

// Beyond the first and the last centre the picture has the factors of those.
fn between(x: u32, count: u32, side: u32) -> Between {
    let at = clamp((f32(x) + 0.5) * f32(count) / f32(side) - 0.5, 0.0, f32(count - 1u));
    let part = min(u32(at), max(count, 2u) - 2u);
    return Between(part, at - f32(part));
}

// Of the factors of a pixel, what share is that of `part`.
fn share_of(b: Between, part: u32) -> f32 {
    return select(0.0, 1.0 - b.share, part == b.part) + select(0.0, b.share, part == b.part + 1u);
}
