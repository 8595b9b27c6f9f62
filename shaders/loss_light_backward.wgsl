//@ import frame, water, medium
// Backpropagates through `loss_light`.
//
//     v_s = v_l decoded'(s),  s = encoded(l)
//   seen    [H*W] vec4: l, the image in linear light
//   v_image [H*W] vec4: in: w.r.t. l; out: w.r.t. s
// One thread per pixel. Twin: `decode` in core/twins/src/water.rs

@group(0) @binding(0) var<uniform> medium: Medium;
@group(0) @binding(1) var<storage, read> seen: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> v_image: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i < medium.pixels {
        let v = v_image[i];
        v_image[i] = vec4<f32>(v.rgb * decoded_slope(encoded(seen[i].rgb)), v.a);
    }
}
