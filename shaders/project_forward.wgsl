//@ import frame, gaussian, projection, shape, harmonics, colour, water
//@ variant project_forward shape=sight_eye+shape_splat
//@ variant project_disks shape=sight_eye+outline+shape_disk
//@ variant project_refracted shape=surface+sight_refracted+outline+shape_refracted
// Projects the visible Gaussians of one block into the view (Zwicker et al. 2002; Kerbl et al. 2023). They
// are 3D Gaussians, or disks that are also written in the camera's frame, seen straight or through a water
// surface (shape_*.wgsl).
//
//   projected             [visible*3]  vec4: (mean2d xy, conic a, b), (conic c, opacity, range, E), (rgb,
//                                      mask) pixels, 1/pixel^2, scene units
//                                      E = ln(255 opacity): alpha >= 1/255 <=> sigma <= E
//                                      opacity includes the low-pass compensation if frame.mip_filter is on
//                                      mask is 0 for 3D Gaussians
//                                      rgb is the value to blend: through the water if frame.medium says so
//   depth_keys            [visible]    bits of z minus those of NEAR: 30 bits, ordered like z
//   order                 [visible]    the entry's own index, the value that the depth sort moves
//   gaussian_from_visible [visible]    index inside the block
// One thread per Gaussian of the block. Twins: core/twins/src/project_forward.rs, core/twins/src/disks.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> block: Block;
@group(0) @binding(2) var<storage, read> transforms: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> sh_coeffs: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> flags: array<u32>;
@group(0) @binding(5) var<storage, read> counters: array<u32>;
@group(0) @binding(6) var<storage, read_write> projected: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> depth_keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> order: array<u32>;
@group(0) @binding(9) var<storage, read_write> gaussian_from_visible: array<u32>;
@group(0) @binding(11) var<uniform> water: Water;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    // After the scan, flags hold the number of visible Gaussians before each; an increment marks a visible
    // one.
    if i >= block.count || counters[1] == 0u {
        return;
    }
    let visible_id = flags[block.base + i];
    var next = counters[1];
    if block.base + i + 1u < frame.gaussians {
        next = flags[block.base + i + 1u];
    }
    if next == visible_id {
        return;
    }
    let mean_opacity = transforms[3u * i];
    let quat = normalize(transforms[3u * i + 1u]);
    let shape = shape_of(i, visible_id, mean_opacity.xyz, sigmoid(mean_opacity.w), quat, transforms[3u * i + 2u].xyz);
    var extent = log(255.0 * shape.opacity);
    if !shape.is_sound {
        extent = -1.0;
    }
    let rgb = colour(i, normalize(mean_opacity.xyz - sight_of(mean_opacity.xyz)));
    // Before the clamp: max(NaN, 0) may be 0.
    if !(is_finite(rgb.x) && is_finite(rgb.y) && is_finite(rgb.z)) {
        extent = -1.0;
    }
    projected[3u * visible_id] = vec4<f32>(shape.mean2d, shape.conic.xy);
    projected[3u * visible_id + 1u] = vec4<f32>(shape.conic.z, shape.opacity, shape.range, extent);
    var blended = max(rgb, vec3<f32>(0.0));
    let medium = veiled(frame.medium, arrayLength(&flags) + 6u);
    if medium != MEDIUM_NONE {
        blended = in_medium(medium, water, blended, shape.range);
    }
    projected[3u * visible_id + 2u] = vec4<f32>(blended, shape.mask);
    depth_keys[visible_id] = min(bitcast<u32>(shape.depth) - bitcast<u32>(NEAR), 0x3fffffffu);
    order[visible_id] = visible_id;
    gaussian_from_visible[visible_id] = i;
}
