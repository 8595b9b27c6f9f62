//@ import frame, surface
// The reflected and the refracted ray of every pixel whose ray meets the water surface (WSGS, eq. 7 to 9).
//
//   image           [H*W] vec4 of rasterize_disks: rgb, alpha of the scene above water
//   normal_image    [H*W] vec4: its blended mask is the last number
//   reflected_rays  [H*W*2] vec4: (origin, 1 or 0 for no ray), (unit direction, F). In the frame of the
//                   mirrored camera, where the ray goes straight on
//   refracted_rays  [H*W*2] vec4: the same in the frame of the camera
// A pixel has no ray if the surface lies behind the scene above water, or is seen from nearly its edge.
// One thread per pixel. Twin: core/twins/src/surface.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> surface: Surface;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> normal_image: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> reflected_rays: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> refracted_rays: array<vec4<f32>>;

// Least cosine with the normal of a ray that meets the surface.
const LEAST_COSINE: f32 = 1e-3;
// From this cover on, a pixel shows nothing but the scene above water.
const DRY: f32 = 0.999;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i >= frame.size.x * frame.size.y {
        return;
    }
    let columns = max(frame.size.x, 1u);
    let at = vec2<f32>(f32(i % columns), f32(i / columns)) + 0.5;
    let d = normalize(vec3<f32>((at - frame.principal) / frame.focal, 1.0));
    let level = level_of(frame, surface);
    let n = level.normal;
    let cos_i = -dot(n, d);
    let cover = cover_of(surface, image[i].w, normal_image[i].w);
    if !(cos_i > LEAST_COSINE && level.height > 0.0 && cover < DRY) {
        reflected_rays[2u * i] = vec4<f32>(0.0);
        reflected_rays[2u * i + 1u] = vec4<f32>(0.0, 0.0, 1.0, 0.0);
        refracted_rays[2u * i] = vec4<f32>(0.0);
        refracted_rays[2u * i + 1u] = vec4<f32>(0.0, 0.0, 1.0, 0.0);
        return;
    }
    let origin = vec4<f32>((level.height / cos_i) * d, 1.0);
    let eta = surface.eta;
    let bent = eta * d + (eta * cos_i - refracted_cosine(eta, cos_i)) * n;
    let share = fresnel(surface, cos_i);
    reflected_rays[2u * i] = origin;
    reflected_rays[2u * i + 1u] = vec4<f32>(d, share);
    refracted_rays[2u * i] = origin;
    refracted_rays[2u * i + 1u] = vec4<f32>(normalize(bent), share);
}
