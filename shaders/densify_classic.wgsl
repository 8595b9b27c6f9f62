//@ import frame, gaussian, random
// Classic density control, step 1 of 2: clones small Gaussians and splits large ones (Kerbl et al. 2023,
// section 5).
//
// A clone is a copy in the same place. The parent keeps its moments and the copy starts without any, so that
// they move apart. A split draws two centres from the Gaussian and divides its scales by 1.6; opacity stays.
// The first child takes the place of the parent, and both children have a step count of 0. The second child,
// or the copy, is staged for densify_place.
//   children [count]   x: parent in the block, y: row of its child in `staged`, z: 1 split, 0 cloned
//   staged [n*(3+S)]   vec4: transforms, then coefficients
// One thread per parent. Random numbers depend on (seed, iteration, index among all trainable Gaussians).

struct Divide {
    count: u32,
    seed: u32,
    iteration: u32,
    pad: u32,
}

// ln 1.6: 0.8 times the number of children (3DGS).
const SHRINKING: f32 = 0.47000363;

@group(0) @binding(0) var<uniform> block: Block;
@group(0) @binding(1) var<uniform> divide: Divide;
@group(0) @binding(2) var<storage, read> children: array<vec4<u32>>;
@group(0) @binding(3) var<storage, read_write> transforms: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> sh_coeffs: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> staged: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let n = folded(group, groups) * 64u + lane;
    if n >= divide.count {
        return;
    }
    let i = children[n].x;
    let split = children[n].z != 0u;
    let t0 = transforms[3u * i];
    let t1 = transforms[3u * i + 1u];
    let t2 = transforms[3u * i + 2u];
    let steps = bitcast<f32>(0u);
    var centre = t0.xyz;
    var log_scale = t2.xyz;
    if split {
        let bits = random_bits(divide.seed, STREAM_SPLIT, block.base + i, divide.iteration);
        let bits2 = random_bits(divide.seed, STREAM_SPLIT, block.base + i, ~divide.iteration);
        let p = normal_pair(bits.x, bits.y);
        let q = normal_pair(bits.z, bits2.x);
        let r = normal_pair(bits2.y, bits2.z);
        let rot = rotation(normalize(t1));
        let scales = exp(t2.xyz);
        centre = t0.xyz + rot * (scales * vec3<f32>(q.y, r));
        log_scale = t2.xyz - SHRINKING;
        transforms[3u * i] = vec4<f32>(t0.xyz + rot * (scales * vec3<f32>(p, q.x)), t0.w);
        transforms[3u * i + 2u] = vec4<f32>(log_scale, steps);
    }
    let at = children[n].y * (3u + block.sh_stride);
    staged[at] = vec4<f32>(centre, t0.w);
    staged[at + 1u] = t1;
    staged[at + 2u] = vec4<f32>(log_scale, steps);
    for (var k = 0u; k < veiled(block.sh_stride, arrayLength(&sh_coeffs)); k++) {
        staged[at + 3u + k] = sh_coeffs[i * block.sh_stride + k];
    }
}
