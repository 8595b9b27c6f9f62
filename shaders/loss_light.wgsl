//@ import frame, water, medium
// Decodes the underwater image when Gaussians are blended in sRGB and the loss is in linear light.
//
//   seen [H*W] vec4: in: sRGB and alpha; out: linear light and alpha
// One thread per pixel. Twin: `decode` in core/twins/src/water.rs

@group(0) @binding(0) var<uniform> medium: Medium;
@group(0) @binding(1) var<storage, read_write> seen: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i < medium.pixels {
        let pixel = seen[i];
        seen[i] = vec4<f32>(decoded(pixel.rgb), pixel.a);
    }
}
