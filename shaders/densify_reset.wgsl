//@ import frame, gaussian
// Classic density control: lowers every opacity to at most 0.01 and clears its moments (Kerbl et al. 2023,
// section 5). Gaussians that views need become opaque again within a few of them. The others stay transparent
// and are removed.
//
//   moments [N*row] u32: the words `first` and `second` of a row are all that Adam keeps of the opacity;
//                   a word of 0 means zero in both forms of moments (shared/moments_*.wgsl)
// One thread per Gaussian.

struct Reset {
    // Number of u32 per row.
    row: u32,
    first: u32,
    second: u32,
    pad: u32,
}

// Logit of 0.01.
const MOST: f32 = -4.5951199;

@group(0) @binding(0) var<uniform> block: Block;
@group(0) @binding(1) var<uniform> reset: Reset;
@group(0) @binding(2) var<storage, read_write> transforms: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> moments: array<u32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i >= block.count {
        return;
    }
    transforms[3u * i].w = min(transforms[3u * i].w, MOST);
    moments[i * reset.row + reset.first] = 0u;
    moments[i * reset.row + reset.second] = 0u;
}
