//@ import frame, counters, water, medium
// One step of Adam on the unconstrained water parameters (SMP-UWGS eq. 8), from the sums of pixels and
// Gaussians.
//
//     beta = softplus(p) / unit, b_inf = sigmoid(p)
//   partials [rows*3] vec4: w.r.t. beta_d, beta_b and b_inf
//   state             the p with Adam's moments, and the accumulated gradients
//   water    [4]      vec4: the water parameters, for kernels that read them as a uniform; the rest is
//                     unchanged
// The squared water parameters are penalised (eq. 16). A gradient that is not finite takes no step and is
// counted. While WaterParamPredict sets the water, the gradients are accumulated for it and the parameters
// stay.
// One workgroup; every sum has a fixed order. After an overflow this and all later kernels do nothing.
// Twin: core/twins/src/water.rs

// Mirror: core/src/gpu/layout.rs.
struct WaterState {
    // The unconstrained parameters p, their first moments and their second moments.
    raw: array<f32, 9>,
    moment1: array<f32, 9>,
    moment2: array<f32, 9>,
    // Skipped steps.
    left_out: f32,
    // Factor on the learning rate of each p: the more certain the prior, the smaller.
    shares: array<f32, 9>,
    // Sums of gradients w.r.t. p, and the number of iterations in them.
    gathered: array<f32, 9>,
    gathered_iterations: f32,
}

@group(0) @binding(0) var<uniform> medium: Medium;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> state: WaterState;
@group(0) @binding(4) var<storage, read_write> water: array<vec4<f32>>;

// The usual decay rates: every iteration has a gradient of the water.
const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

var<workgroup> sh_sums: array<vec4<f32>, 192>;
var<workgroup> sh_gradients: array<f32, 9>;
var<workgroup> sh_values: array<f32, 9>;

fn softplus(x: f32) -> f32 {
    return max(x, 0.0) + log(1.0 + exp(-abs(x)));
}

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) lane: u32) {
    let short = counters[OVERFLOW] != 0u;
    var by_d = vec4<f32>(0.0);
    var by_b = vec4<f32>(0.0);
    var by_inf = vec4<f32>(0.0);
    let rows = veiled(medium.rows, arrayLength(&partials) / 3u);
    for (var k = lane; k < rows; k += 64u) {
        by_d += partials[3u * k];
        by_b += partials[3u * k + 1u];
        by_inf += partials[3u * k + 2u];
    }
    sh_sums[3u * lane] = by_d;
    sh_sums[3u * lane + 1u] = by_b;
    sh_sums[3u * lane + 2u] = by_inf;
    workgroupBarrier();
    if lane < 9u {
        let row = lane / 3u;
        var v = 0.0;
        for (var k = 0u; k < 64u; k++) {
            v += sh_sums[3u * k + row][lane % 3u];
        }
        let p = state.raw[lane];
        let at = 1.0 / (1.0 + exp(-p));
        if row == 2u {
            v = (v + 2.0 * medium.decay * at) * at * (1.0 - at);
        } else {
            v = (v / medium.unit + 2.0 * medium.decay * softplus(p)) * at;
        }
        sh_gradients[lane] = v;
    }
    workgroupBarrier();
    var sound = true;
    for (var k = 0u; k < 9u; k++) {
        sound = sound && is_finite(sh_gradients[k]);
    }
    let gathers = veiled(medium.gathers, arrayLength(&partials)) != 0u;
    if lane == 0u && !short {
        state.left_out += select(1.0, 0.0, sound);
        state.gathered_iterations += select(0.0, 1.0, sound && gathers);
    }
    if lane < 9u {
        var p = state.raw[lane];
        if sound && !short && gathers {
            state.gathered[lane] += sh_gradients[lane];
        } else if sound && !short {
            let v = sh_gradients[lane];
            let first = BETA1 * state.moment1[lane] + (1.0 - BETA1) * v;
            let second = BETA2 * state.moment2[lane] + (1.0 - BETA2) * v * v;
            state.moment1[lane] = first;
            state.moment2[lane] = second;
            p -= state.shares[lane] * medium.rate * (medium.unbias1 * first) / (sqrt(medium.unbias2 * second) + EPSILON);
            state.raw[lane] = p;
        }
        sh_values[lane] = select(softplus(p) / medium.unit, 1.0 / (1.0 + exp(-p)), lane >= 6u);
    }
    workgroupBarrier();
    if lane < 3u && sound && !short && !gathers {
        let rest = water[lane].w;
        water[lane] = vec4<f32>(sh_values[3u * lane], sh_values[3u * lane + 1u], sh_values[3u * lane + 2u], rest);
    }
}
