//@ import frame, gaussian, surface
// Makes the disks of a block below the water surface black and mostly masked, so that what refracted light
// explains can leave the scene above water (WSGS, section 4.3). The published code blackens those above
// instead.
//
// One thread per disk.

@group(0) @binding(0) var<uniform> block: Block;
@group(0) @binding(1) var<uniform> surface: Surface;
@group(0) @binding(2) var<storage, read_write> transforms: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> sh_coeffs: array<vec4<f32>>;

// The logit of a mask of a tenth. With the half of the paper, and its weight and rate of masks, the blended
// mask of a pool stayed near 0.4 in the water, and the refracted set was too bright.
const MOSTLY_WATER: f32 = -2.2;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i >= block.count {
        return;
    }
    if dot(surface.normal, transforms[3u * i].xyz) >= surface.offset {
        return;
    }
    // The third number of a disk is the logit of its mask.
    transforms[3u * i + 2u].z = min(transforms[3u * i + 2u].z, MOSTLY_WATER);
    let at = i * block.sh_stride;
    sh_coeffs[at] = vec4<f32>(vec3<f32>(-0.5 / 0.28209479177387814), sh_coeffs[at].w);
}
