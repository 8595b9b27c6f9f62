//@ import frame, gaussian, projection, place, reach
//@ variant cull reach=reach_splat
//@ variant cull_disks reach=side_any+outline+reach_disk
//@ variant cull_reflected reach=surface+side_above+outline+reach_disk
//@ variant cull_refracted reach=surface+outline+reach_refracted
// Marks the Gaussians that a view may see.
//
// The test bounds the projected box without a covariance. The standard deviation of a splat in pixels is at
// most f/z * sqrt(1 + u^2 + v^2) * max scale, plus that of the low-pass. Guards are phrased positively, so
// NaN fails them. The 2D part of frame.mip_filter only makes splats fainter; the 3D part also widens them
// here. A water surface hides the disks above it from refracted rays, and those below from reflected ones.
// Chunks that cull_chunks rejected are skipped.
// One thread per Gaussian; flags [gaussians] are 0 or 1 and are scanned next.
// Twin: none of its own; the kernel test compares the visible set of the frame with
// core/twins/src/project_forward.rs.

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> block: Block;
@group(0) @binding(2) var<storage, read> transforms: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> chunk_seen: array<u32>;
// z: smoothing; frozen blocks have a single row of zeros.
@group(0) @binding(5) var<storage, read> density_sums: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> flags: array<u32>;

fn may_be_seen(i: u32) -> bool {
    let mean_opacity = transforms[3u * i];
    let log_scale = transforms[3u * i + 2u].xyz;
    let quat = transforms[3u * i + 1u];
    let m = to_camera(frame, mean_opacity.xyz);
    let opacity = sigmoid(mean_opacity.w);
    let norm2 = dot(quat, quat);
    var max_scale = exp(largest_of(log_scale));
    if veiled(frame.mip_filter, arrayLength(&flags)) != 0u {
        max_scale = length(vec2<f32>(max_scale, density_sums[min(i, arrayLength(&density_sums) - 1u)].z));
    }
    let finite = is_finite(m.x) && is_finite(m.y) && is_finite(m.z) && is_finite(norm2) && is_finite(max_scale)
        && is_finite(log_scale.x) && is_finite(log_scale.y) && is_finite(log_scale.z) && is_finite(mean_opacity.w);
    if !(finite && opacity >= MIN_ALPHA && norm2 > 0.0) {
        return false;
    }
    let place = place_of(frame, mean_opacity.xyz, m, max_scale, sqrt(2.0 * max(log(255.0 * opacity), 0.0)));
    return place.is_ahead && all(place.at + place.reach > frame.rect_min)
        && all(place.at - place.reach < frame.rect_max);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i < block.count {
        // All Gaussians of a workgroup belong to one chunk.
        if chunk_seen[i / CHUNK] == 0u {
            flags[block.base + i] = 0u;
        } else {
            flags[block.base + i] = select(0u, 1u, may_be_seen(i));
        }
    }
}
