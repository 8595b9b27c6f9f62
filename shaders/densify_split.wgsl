//@ import frame, gaussian
// Density control, step 1 of 2: splits a Gaussian along its longest axis. The first child takes the place of
// the parent. The second is staged; densify_place writes it to a new entry, or to one whose Gaussian has
// faded.
//
// The children lie at -d and +d along the axis, so that their mixture keeps the parent's variance:
//     d^2 + s'^2 = s^2 with s' = d = s / sqrt 2
// The opacity of a child is 1 - (1 - o)^(1/sqrt 2), because at its centre the other child adds to it. With a
// step count of 0, neither child takes over the parent's moments.
//   splits [count]   x: Gaussian of the block to split, y: row of its second child in `staged`
//   staged [n*(3+S)] vec4: transforms, then coefficients

struct Split {
    count: u32,
    // 2 for disks: the third number of a disk is not a scale.
    axes: u32,
    pad1: u32,
    pad2: u32,
}

@group(0) @binding(0) var<uniform> block: Block;
@group(0) @binding(1) var<uniform> split: Split;
@group(0) @binding(2) var<storage, read> splits: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read_write> transforms: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> sh_coeffs: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> staged: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let n = folded(group, groups) * 64u + lane;
    if n >= split.count {
        return;
    }
    let i = splits[n].x;
    let t0 = transforms[3u * i];
    let t1 = transforms[3u * i + 1u];
    let t2 = transforms[3u * i + 2u];
    let rot = rotation(normalize(t1));
    let log_scale = t2.xyz;
    var axis = rot[0];
    var longest = vec3<f32>(1.0, 0.0, 0.0);
    var reach = log_scale.x;
    if log_scale.y > reach { axis = rot[1]; longest = vec3<f32>(0.0, 1.0, 0.0); reach = log_scale.y; }
    if split.axes == 3u && log_scale.z > reach { axis = rot[2]; longest = vec3<f32>(0.0, 0.0, 1.0); reach = log_scale.z; }
    let offset = axis * (exp(reach) * 0.70710678);
    let child_scale = log_scale - 0.34657359 * longest;
    let opacity = clamp(sigmoid(t0.w), 1e-6, 0.9999);
    let child_opacity = 1.0 - pow(1.0 - opacity, 0.70710678);
    let logit = log(child_opacity / (1.0 - child_opacity));
    let steps = bitcast<f32>(0u);

    transforms[3u * i] = vec4<f32>(t0.xyz - offset, logit);
    transforms[3u * i + 2u] = vec4<f32>(child_scale, steps);
    let at = splits[n].y * (3u + block.sh_stride);
    staged[at] = vec4<f32>(t0.xyz + offset, logit);
    staged[at + 1u] = t1;
    staged[at + 2u] = vec4<f32>(child_scale, steps);
    for (var k = 0u; k < veiled(block.sh_stride, arrayLength(&sh_coeffs)); k++) {
        staged[at + 3u + k] = sh_coeffs[i * block.sh_stride + k];
    }
}
