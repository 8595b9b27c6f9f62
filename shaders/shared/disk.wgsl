// A disk in the camera's frame, or the gradient with respect to one, as five vectors.
//
//   disk      (centre, projected centre x), (a_u, projected centre y), (a_v, factor of the normal),
//             (-, opacity, range, -), (rgb, mask): rows of `disks` and the last two of `projected`
//   gradient  (v_u, v_v, tau, v_opacity), (v_u u, v_u v, v_v u, v_v v), (tau u, tau v, v_centre2d xy),
//             (v_normal along t_u, along t_v, v_range, sum |gradient on the image|), (v_rgb, v_mask)
// Sums over pixels; tau is the gradient w.r.t. the ray's parameter t, over N.d. v_centre2d and v_range are
// those of pixels where the low-pass decides.

struct Splat {
    a: vec4<f32>,
    b: vec4<f32>,
    c: vec4<f32>,
    d: vec4<f32>,
    e: vec4<f32>,
}

const NOTHING: Splat = Splat(vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0));
