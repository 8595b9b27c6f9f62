//@ import frame, exposure
// Applies the exposure of a training view to its render, before the loss (as 3DGS does since October 2024).
//
//     colour' = A colour + b
//   image     [H*W]      vec4: rgb, alpha
//   exposures [views*3]  vec4: rows of [A | b]
//   exposed   [H*W]      vec4: colour', alpha
// One thread per pixel. Twin: core/twins/src/exposure.rs

@group(0) @binding(0) var<uniform> exposure: Exposure;
@group(0) @binding(1) var<storage, read> exposures: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> exposed: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i < exposure.pixels {
        let pixel = image[i];
        let colour = vec4<f32>(pixel.rgb, 1.0);
        let at = 3u * exposure.view;
        let rgb = vec3<f32>(
            dot(exposures[at], colour),
            dot(exposures[at + 1u], colour),
            dot(exposures[at + 2u], colour),
        );
        exposed[i] = vec4<f32>(rgb, pixel.a);
    }
}
