//@ import frame, counters, exposure, adam
// One step of Adam on the exposure of a view; then the mean of all exposures is moved back to the identity.
//
//   partials  [groups*3]  vec4: from expose_backward
//   exposures [views*3]   vec4: rows of [A | b]
//   moments   [views*6]   vec4: first moments of the three rows, then their second moments
// A darker model under brighter exposures gives the same images, so the loss does not determine the
// brightness of the model. Held-out views use the identity. Therefore the mean exposure of the training views
// is kept at the identity: the step of one view is subtracted, in equal parts, from all views.
// One workgroup; every sum has a fixed order. After an overflow this and all later kernels do nothing.
// Twin: core/twins/src/exposure.rs

@group(0) @binding(0) var<uniform> exposure: Exposure;
@group(0) @binding(1) var<storage, read> counters: array<u32>;
@group(0) @binding(2) var<storage, read> partials: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> exposures: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> moments: array<vec4<f32>>;

var<workgroup> sh_sums: array<vec4<f32>, 192>;
var<workgroup> sh_steps: array<vec4<f32>, 3>;

@compute @workgroup_size(64)
fn main(@builtin(local_invocation_index) lane: u32) {
    if counters[OVERFLOW] != 0u {
        return;
    }
    let groups = veiled((exposure.pixels + EXPOSE_CHUNK - 1u) / EXPOSE_CHUNK, arrayLength(&partials));
    var sum_r = vec4<f32>(0.0);
    var sum_g = vec4<f32>(0.0);
    var sum_b = vec4<f32>(0.0);
    for (var g = lane; g < groups; g += 64u) {
        sum_r += partials[3u * g];
        sum_g += partials[3u * g + 1u];
        sum_b += partials[3u * g + 2u];
    }
    sh_sums[3u * lane] = sum_r;
    sh_sums[3u * lane + 1u] = sum_g;
    sh_sums[3u * lane + 2u] = sum_b;
    workgroupBarrier();
    if lane < 3u {
        var v = vec4<f32>(0.0);
        for (var k = 0u; k < 64u; k++) {
            v += sh_sums[3u * k + lane];
        }
        let at = 6u * exposure.view + lane;
        let first = moved(BETA1, moments[at], v);
        let second = moved(BETA2, moments[at + 3u], v * v);
        moments[at] = first;
        moments[at + 3u] = second;
        let size = sqrt(exposure.unbias2 * second) + EPSILON;
        sh_steps[lane] = (exposure.rate * exposure.unbias1) * first / size;
    }
    workgroupBarrier();
    let share = 1.0 / f32(exposure.views);
    let rows = 3u * veiled(exposure.views, arrayLength(&exposures));
    for (var i = lane; i < rows; i += 64u) {
        let own = select(0.0, 1.0, i / 3u == exposure.view);
        exposures[i] += (share - own) * sh_steps[i % 3u];
    }
}
