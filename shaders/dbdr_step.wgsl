//@ import frame, counters
// One step of Adam on the weights and biases of the range factors (DBDR, SMP-UWGS eq. 9).
//
//   refinement_partials [rows]  vec4: w.r.t. weight and bias of the factor on beta_d, then of that on beta_b
//   state      the four parameters with Adam's moments
//   water [4]  vec4: the last row receives the four parameters, for kernels that read them as a uniform
// A gradient that is not finite takes no step and is counted.
// One workgroup; every sum has a fixed order. After an overflow this and all later kernels do nothing.
// Twin: core/twins/src/dbdr.rs

struct Dbdr {
    // Rows to sum.
    rows: u32,
    // Adam: rate, 1/(1-b1^t), 1/(1-b2^t).
    rate: f32,
    unbias1: f32,
    unbias2: f32,
}

// Mirror: core/src/gpu/layout.rs.
struct DbdrState {
    // The four parameters, their first moments and their second moments.
    raw: vec4<f32>,
    moment1: vec4<f32>,
    moment2: vec4<f32>,
    // Skipped steps.
    left_out: f32,
    pad: array<f32, 3>,
}

@group(0) @binding(0) var<uniform> dbdr: Dbdr;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> refinement_partials: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> state: DbdrState;
@group(0) @binding(4) var<storage, read_write> water: array<vec4<f32>>;

// The usual decay rates: every iteration has a gradient of the water.
const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

var<workgroup> sh_sums: array<vec4<f32>, 64>;

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) lane: u32) {
    var sum = vec4<f32>(0.0);
    let rows = veiled(dbdr.rows, arrayLength(&refinement_partials));
    for (var k = lane; k < rows; k += 64u) {
        sum += refinement_partials[k];
    }
    sh_sums[lane] = sum;
    workgroupBarrier();
    if lane != 0u || counters[OVERFLOW] != 0u || dbdr.rate == 0.0 {
        return;
    }
    var v = vec4<f32>(0.0);
    for (var k = 0u; k < 64u; k++) {
        v += sh_sums[k];
    }
    if !(is_finite(v.x) && is_finite(v.y) && is_finite(v.z) && is_finite(v.w)) {
        state.left_out += 1.0;
        return;
    }
    let first = BETA1 * state.moment1 + (1.0 - BETA1) * v;
    let second = BETA2 * state.moment2 + (1.0 - BETA2) * v * v;
    let step = dbdr.rate * (dbdr.unbias1 * first) / (sqrt(dbdr.unbias2 * second) + EPSILON);
    let next = state.raw - step;
    state.raw = next;
    state.moment1 = first;
    state.moment2 = second;
    water[3] = next;
}
