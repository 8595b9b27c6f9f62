// A projected splat, or the gradient w.r.t. one, as three vectors.
//
//   splat     (mean2d xy, conic a, b), (conic c, opacity, range, E), (rgb, 0)
//   gradient  (v_mean2d xy, v_conic a, b), (v_conic c, v_opacity, v_range, sum |v_mean2d|), (v_rgb, sum of
//             weights)

struct Splat {
    a: vec4<f32>,
    b: vec4<f32>,
    c: vec4<f32>,
}

const NOTHING: Splat = Splat(vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0));
