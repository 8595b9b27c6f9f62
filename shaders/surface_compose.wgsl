//@ import frame, surface, water, surface_light
// The picture of a scene with a water surface from those of its three sets of disks (WSGS, eq. 11 and 12).
//
//   water = F reflected + (1 - F) refracted, added as light
//   picture = (1 - alpha) water + straight, or with masks (1 - R) water + R straight
//   image            [H*W] vec4 of rasterize_disks: straight, alpha
//   normal_image     [H*W] vec4: R, the blended mask, is the last number
//   refracted_rays   [H*W*2] vec4 of surface_rays: whether the pixel has rays, and F
//   picture          [H*W] vec4: rgb, alpha; the latter is 1 on water
// One thread per pixel. Twin: core/twins/src/surface.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> surface: Surface;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> normal_image: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> reflected: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> refracted: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> refracted_rays: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> picture: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i >= frame.size.x * frame.size.y {
        return;
    }
    let straight = image[i];
    if refracted_rays[2u * i].w == 0.0 {
        picture[i] = straight;
        return;
    }
    let share = refracted_rays[2u * i + 1u].w;
    let cover = cover_of(surface, straight.w, normal_image[i].w);
    let worth = select(cover, 1.0, surface.over != 0u);
    let light = share * light_of(surface, reflected[i].xyz) + (1.0 - share) * light_of(surface, refracted[i].xyz);
    picture[i] = vec4<f32>((1.0 - cover) * shown_of(surface, light) + worth * straight.xyz, 1.0);
}
