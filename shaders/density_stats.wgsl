//@ import frame, gaussian, sizes
//@ variant density_stats sizes=sizes_splat
//@ variant density_stats_disks sizes=sizes_disk
//@ variant density_stats_masked sizes=sizes_masked
//@ variant density_stats_above sizes=surface+sizes_above
//@ variant density_stats_below sizes=surface+sizes_below
// The inputs of density control, which the host reads back: opacity, mean gradients and size of each
// Gaussian. Clears the sums and keeps the smoothing.
//
//   stats [count] vec4: opacity (0 if a parameter is not finite), as sizes_*.wgsl sees it,
//                       mean over visits of sum |v_mean2d| (AbsGS, pixels),
//                       mean over visits of |sum v_mean2d| (3DGS, in units of half an image),
//                       largest standard deviation (scene units)

@group(0) @binding(0) var<uniform> block: Block;
@group(0) @binding(1) var<storage, read> transforms: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> density_sums: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> stats: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i >= block.count {
        return;
    }
    let t0 = transforms[3u * i];
    let t1 = transforms[3u * i + 1u];
    let t2 = transforms[3u * i + 2u];
    let finite = is_finite(dot(t0.xyz, t0.xyz)) && is_finite(t0.w) && is_finite(dot(t1, t1)) && is_finite(dot(t2.xyz, t2.xyz));
    let seen = density_sums[i];
    density_sums[i] = vec4<f32>(0.0, 0.0, seen.z, 0.0);
    let means = weight_of(t2.xyz) * vec2<f32>(seen.x, seen.w) / max(seen.y, 1.0);
    stats[i] = vec4<f32>(select(0.0, seen_opacity(t0.xyz, sigmoid(t0.w), t2.xyz), finite), means, exp(largest_of(t2.xyz)));
}
