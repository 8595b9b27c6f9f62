//@ import frame, surface
// Gradients w.r.t. the plane of the water surface, through the rays that it reflects and refracts, and
// through F (WSGS, section 4.2).
//
//   reflected_v, refracted_v  [H*W*2] vec4 of rasterize_disks_backward: gradients of origin and direction of
//                   each ray; the former in the frame of the mirrored camera
//   refracted_rays  [H*W*2] vec4 of surface_rays
//   v_fresnel       [H*W] of surface_compose_backward
//   partials        [groups] vec4: w.r.t. the normal (world axes, turned about the pivot) and the offset,
//                   summed over the workgroup's 64 pixels in their order
// Rays that graze the surface are left out: a small turn moves their origin far.
// One thread per pixel. Twin: core/twins/src/surface.rs

struct Pivot {
    // A point of the plane about which it turns, world axes.
    at: vec3<f32>,
    pad: f32,
}

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> surface: Surface;
@group(0) @binding(2) var<uniform> pivot: Pivot;
@group(0) @binding(3) var<storage, read> reflected_v: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> refracted_v: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> refracted_rays: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> v_fresnel: array<f32>;
@group(0) @binding(7) var<storage, read_write> partials: array<vec4<f32>>;

// Least cosine with the normal of a ray that says something about the plane.
const LEAST_STEEP: f32 = 0.1;

var<workgroup> sh_sums: array<vec4<f32>, 64>;

fn of_pixel(i: u32) -> vec4<f32> {
    let origin = refracted_rays[2u * i];
    if origin.w == 0.0 {
        return vec4<f32>(0.0);
    }
    let level = level_of(frame, surface);
    let n = level.normal;
    let d = normalize(origin.xyz);
    let cos_i = -dot(n, d);
    if cos_i < LEAST_STEEP {
        return vec4<f32>(0.0);
    }
    let eta = surface.eta;
    let cos_t = refracted_cosine(eta, cos_i);
    let mirrored_q = reflected_v[2u * i].xyz;
    let mirrored_d = reflected_v[2u * i + 1u].xyz;
    let v_up = mirrored_d - 2.0 * dot(n, mirrored_d) * n;
    let v_down = refracted_v[2u * i + 1u].xyz;
    let v_q = refracted_v[2u * i].xyz + mirrored_q - 2.0 * dot(n, mirrored_q) * n;
    // q = height d / cos_i, with height = n.eye - offset.
    let v_height = dot(v_q, d) / cos_i;
    let v_cos = -v_height * level.height / cos_i + dot(v_down, n) * (eta - eta * eta * cos_i / cos_t)
        + 2.0 * dot(v_up, n) + v_fresnel[i] * fresnel_slope(surface, cos_i);
    let v_n = -v_cos * d + (eta * cos_i - cos_t) * v_down + 2.0 * cos_i * v_up;
    let in_world = v_n.x * frame.view_x.xyz + v_n.y * frame.view_y.xyz + v_n.z * frame.view_z.xyz;
    return vec4<f32>(in_world + v_height * (frame.eye - pivot.at), -v_height);
}

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let id = folded(group, groups);
    let i = id * 64u + lane;
    let pixels = frame.size.x * frame.size.y;
    var own = vec4<f32>(0.0);
    if i < pixels {
        own = of_pixel(i);
    }
    sh_sums[lane] = own;
    workgroupBarrier();
    if lane == 0u && id * 64u < pixels {
        var total = vec4<f32>(0.0);
        for (var k = 0u; k < 64u; k++) {
            total += sh_sums[k];
        }
        partials[id] = total;
    }
}
