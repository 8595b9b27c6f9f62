//@ import frame, counters, surface
// One step of Adam on the offset of the water surface and, on request, on the tilt of its normal.
//
//   partials [rows] vec4 of surface_gradients
//   state    Adam's moments
//   plane    the surface, which other kernels read as a uniform
// A gradient that is not finite takes no step and is counted.
// One workgroup; every sum has a fixed order. After an overflow this and all later kernels do nothing.
// Twin: core/twins/src/surface.rs

struct SurfaceStep {
    rows: u32,
    // Adam: rates of the offset (scene units) and of the tilt (radians), 1/(1-b1^t), 1/(1-b2^t).
    offset_rate: f32,
    tilt_rate: f32,
    unbias1: f32,
    unbias2: f32,
    pad: u32,
    pad1: u32,
    pad2: u32,
    // A point of the plane about which it turns, world axes.
    pivot: vec3<f32>,
    pad3: f32,
}

// Mirror: core/src/gpu/layout.rs.
struct SurfaceState {
    // Of normal and offset.
    moment1: vec4<f32>,
    moment2: vec4<f32>,
    // Skipped steps.
    left_out: f32,
    pad0: f32,
    pad1: f32,
    pad2: f32,
}

@group(0) @binding(0) var<uniform> step: SurfaceStep;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> state: SurfaceState;
@group(0) @binding(4) var<storage, read_write> plane: Surface;

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-15;

var<workgroup> sh_sums: array<vec4<f32>, 64>;

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) lane: u32) {
    var sum = vec4<f32>(0.0);
    let rows = veiled(step.rows, arrayLength(&partials));
    for (var k = lane; k < rows; k += 64u) {
        sum += partials[k];
    }
    sh_sums[lane] = sum;
    workgroupBarrier();
    if lane != 0u || counters[OVERFLOW] != 0u {
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
    // The normal keeps its length.
    let n = plane.normal;
    v = vec4<f32>(v.xyz - dot(v.xyz, n) * n, v.w);
    let first = BETA1 * state.moment1 + (1.0 - BETA1) * v;
    let second = BETA2 * state.moment2 + (1.0 - BETA2) * v * v;
    state.moment1 = first;
    state.moment2 = second;
    let rates = vec4<f32>(vec3<f32>(step.tilt_rate), step.offset_rate);
    let moved = rates * (step.unbias1 * first) / (sqrt(step.unbias2 * second) + EPSILON);
    let turned = normalize(n - (moved.xyz - dot(moved.xyz, n) * n));
    plane.normal = turned;
    plane.offset += dot(turned - n, step.pivot) - moved.w;
}
