//@ import frame, gaussian
// Density control, step 2 of 2: writes staged Gaussians into a block. Their step count is 0, so their moments
// start anew.
//
//   placements [count]  x: entry of the block, y: row in `staged`

struct Place {
    count: u32,
    pad0: u32,
    pad1: u32,
    pad2: u32,
}

@group(0) @binding(0) var<uniform> block: Block;
@group(0) @binding(1) var<uniform> place: Place;
@group(0) @binding(2) var<storage, read> placements: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> staged: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> transforms: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> sh_coeffs: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let n = folded(group, groups) * 64u + lane;
    if n >= place.count {
        return;
    }
    let i = placements[n].x;
    let at = placements[n].y * (3u + block.sh_stride);
    transforms[3u * i] = staged[at];
    transforms[3u * i + 1u] = staged[at + 1u];
    transforms[3u * i + 2u] = staged[at + 2u];
    for (var k = 0u; k < veiled(block.sh_stride, arrayLength(&sh_coeffs)); k++) {
        sh_coeffs[i * block.sh_stride + k] = staged[at + 3u + k];
    }
}
