//@ import frame
// Packs what rasterize_disks_backward needs of each pixel.
//
//   v_pixels [H*W*2] vec4: (v_rgb, rem), (v_normal, v_range), where rem is the sum of v . (contribution) over
//            all disks and the background, the start of the remainder in rasterize_backward
// One thread per pixel. Twin: core/twins/src/disks.rs, `trace_backward`

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> range_image: array<f32>;
@group(0) @binding(3) var<storage, read> normal_image: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> v_image: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> v_range_image: array<f32>;
@group(0) @binding(6) var<storage, read> v_normal_image: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> v_mask_image: array<f32>;
@group(0) @binding(8) var<storage, read_write> v_pixels: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i >= frame.size.x * frame.size.y {
        return;
    }
    let v = v_image[i];
    let seen = image[i];
    let v_range = v_range_image[i];
    let v_normal = v_normal_image[i].xyz;
    // dot(seen.rgb, v) already includes the background's share T bg . v; alpha = 1 - T.
    let rem = dot(seen.xyz, v.xyz) + range_image[i] * v_range + dot(normal_image[i].xyz, v_normal)
        + normal_image[i].w * v_mask_image[i] - (1.0 - seen.w) * v.w;
    v_pixels[2u * i] = vec4<f32>(v.xyz, rem);
    v_pixels[2u * i + 1u] = vec4<f32>(v_normal, v_range);
}
