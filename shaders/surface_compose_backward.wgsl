//@ import frame, surface, water, surface_light
// Gradients through surface_compose.
//
//   v_image        [H*W] vec4, in: w.r.t. the picture; out: w.r.t. the straight picture
//   v_mask_image   [H*W] w.r.t. R, the blended mask
//   v_reflected, v_refracted  [H*W] vec4 for rasterize_disks_backward: (v_rgb, rem), where rem is the sum of
//                  v . (contribution) over all disks
//   v_fresnel      [H*W] w.r.t. F
// One thread per pixel. Twin: core/twins/src/surface.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> surface: Surface;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> normal_image: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> reflected: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> refracted: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> refracted_rays: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> v_image: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read_write> v_mask_image: array<f32>;
@group(0) @binding(9) var<storage, read_write> v_reflected: array<vec4<f32>>;
@group(0) @binding(10) var<storage, read_write> v_refracted: array<vec4<f32>>;
@group(0) @binding(11) var<storage, read_write> v_fresnel: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i >= frame.size.x * frame.size.y {
        return;
    }
    if refracted_rays[2u * i].w == 0.0 {
        v_mask_image[i] = 0.0;
        v_reflected[i] = vec4<f32>(0.0);
        v_refracted[i] = vec4<f32>(0.0);
        v_fresnel[i] = 0.0;
        return;
    }
    let share = refracted_rays[2u * i + 1u].w;
    let cover = cover_of(surface, image[i].w, normal_image[i].w);
    let up = reflected[i].xyz;
    let down = refracted[i].xyz;
    let light_up = light_of(surface, up);
    let light_down = light_of(surface, down);
    let light = share * light_up + (1.0 - share) * light_down;
    let v = v_image[i].xyz;
    let one = vec3<f32>(1.0);
    let as_shown = surface.as_shown != 0u;
    let v_light = (1.0 - cover) * v * select(encoded_slope(light), one, as_shown);
    let v_up = share * v_light * select(decoded_slope(up), one, as_shown);
    let v_down = (1.0 - share) * v_light * select(decoded_slope(down), one, as_shown);
    v_reflected[i] = vec4<f32>(v_up, dot(v_up, up));
    v_refracted[i] = vec4<f32>(v_down, dot(v_down, down));
    v_fresnel[i] = dot(v_light, light_up - light_down);
    let v_water = dot(v, shown_of(surface, light));
    let over = surface.over != 0u;
    v_mask_image[i] = select(dot(v, image[i].xyz) - v_water, 0.0, over);
    v_image[i] = select(vec4<f32>(cover * v, 0.0), vec4<f32>(v, -v_water), over);
}
