//@ import frame, gaussian
// The 3D filter of Mip-Splatting (Yu et al. 2024, section 5.1): the smoothing of each Gaussian that makes it
// no finer than its finest sampling by the training views.
//
// A view samples a Gaussian at depth z with f / z samples per scene unit, f the larger focal length. The view
// counts if the centre is in front of it and inside the image, or outside by at most 15 % of its size (as in
// their code). The variance of the filter is 0.2 / (largest rate)^2. A Gaussian that no view samples is not
// smoothed.
//   views  [V*5] vec4: rows of world to camera (rotation xyz, translation w), (focal xy, principal xy),
//                      (size xy, 0, 0)
//   density_sums [N]   vec4: standard deviation of the filter in z, scene units
// One thread per Gaussian.

// The value of the paper.
const VARIANCE: f32 = 0.2;

@group(0) @binding(0) var<uniform> block: Block;
@group(0) @binding(1) var<storage, read> transforms: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> views: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> density_sums: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i >= block.count {
        return;
    }
    let mean = vec4<f32>(transforms[3u * i].xyz, 1.0);
    var rate = 0.0;
    for (var at = 0u; at < arrayLength(&views); at += 5u) {
        let m = vec3<f32>(dot(views[at], mean), dot(views[at + 1u], mean), dot(views[at + 2u], mean));
        let lens = views[at + 3u];
        let size = views[at + 4u].xy;
        let pixel = lens.xy * m.xy / m.z + lens.zw;
        if m.z > NEAR && all(pixel > -0.15 * size) && all(pixel < 1.15 * size) {
            rate = max(rate, max(lens.x, lens.y) / m.z);
        }
    }
    density_sums[i].z = select(0.0, sqrt(VARIANCE) / rate, rate > 0.0);
}
