// Adam (Kingma and Ba 2015) for the Gaussians that a view sees. Twin: core/twins/src/adam.rs

// Smaller decay rates than usual: steps are counted per Gaussian, and few views see each
// (core/twins/src/adam.rs).
const BETA1: f32 = 0.8;
const BETA2: f32 = 0.99;
const EPSILON: f32 = 1e-15;

struct Pace {
    // 1/(1-b1^t), 1/(1-b2^t).
    unbias: vec2<f32>,
    // No step was taken yet: the stored moments belong to another Gaussian.
    fresh: bool,
}

fn pace_of(count: u32) -> Pace {
    let unbias = 1.0 / (1.0 - vec2<f32>(pow(BETA1, f32(count)), pow(BETA2, f32(count))));
    return Pace(unbias, count == 1u);
}

fn moved(beta: f32, before: vec4<f32>, now: vec4<f32>) -> vec4<f32> {
    return beta * before + (1.0 - beta) * now;
}

fn old(moment: vec4<f32>, pace: Pace) -> vec4<f32> {
    return select(moment, vec4<f32>(0.0), pace.fresh);
}
