// A 2D Gaussian in the camera's frame, and an ellipse on the image that holds it (Huang et al. 2024). Needs
// frame, gaussian, projection, outline and the name frame.

//   disks [visible*3] vec4: (centre, projected centre x), (a_u, projected centre y), (a_v, factor that makes
//         a_u x a_v the unit normal towards the camera); camera axes, scene units, pixels. a = axis / scale.
@group(0) @binding(10) var<storage, read_write> disks: array<vec4<f32>>;

struct Shape {
    mean2d: vec2<f32>,
    conic: vec3<f32>,
    range: f32,
    depth: f32,
    opacity: f32,
    // 1 for a disk that is part of the scene above water (gaussian.wgsl).
    mask: f32,
    is_sound: bool,
}

fn shape_of(i: u32, visible_id: u32, mean: vec3<f32>, opacity: f32, quat: vec4<f32>, log_scale: vec3<f32>) -> Shape {
    let rot = rotation(quat);
    let scales = exp(log_scale.xy);
    let m = to_camera(frame, mean);
    let u = turned(frame, rot[0]);
    let v = turned(frame, rot[1]);
    let a_u = u / scales.x;
    let a_v = v / scales.y;
    let centre2d = frame.focal * m.xy / m.z + frame.principal;
    let bound = bound_of(frame, m, centre2d, u * scales.x, v * scales.y, 2.0 * max(log(255.0 * opacity), 0.0));
    let mean2d = centre2d + bound.offset;
    let det = bound.cov.x * bound.cov.z - bound.cov.y * bound.cov.y;
    let conic = vec3<f32>(bound.cov.z, -bound.cov.y, bound.cov.x) / det;
    let facing = dot(cross(u, v), m);
    let area = scales.x * scales.y;
    disks[3u * visible_id] = vec4<f32>(m, centre2d.x);
    disks[3u * visible_id + 1u] = vec4<f32>(a_u, centre2d.y);
    disks[3u * visible_id + 2u] = vec4<f32>(a_v, select(area, -area, facing > 0.0));
    let is_sound = det > 0.0 && is_finite(det) && is_finite(conic.x) && is_finite(conic.y) && is_finite(conic.z)
        && is_finite(mean2d.x) && is_finite(mean2d.y) && is_finite(1.0 / area)
        && is_finite(dot(a_u, a_u)) && is_finite(dot(a_v, a_v));
    return Shape(mean2d, conic, length(m), m.z, opacity, sigmoid(log_scale.z), is_sound);
}
