// The projected centre of a disk that is seen from the eye: f x/z + principal point. Needs frame.

// The gradient of the centre, camera axes, from those of the projected centre and of the range |m|.
fn centre_pulled(m: vec3<f32>, v_centre2d: vec2<f32>, v_range: f32) -> vec3<f32> {
    let inv_z = 1.0 / m.z;
    let v = frame.focal * v_centre2d;
    return inv_z * vec3<f32>(v, -dot(v, m.xy) * inv_z) + (v_range / length(m)) * m;
}
