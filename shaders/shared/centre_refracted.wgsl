// The projected centre of a disk below the water surface. Needs frame, surface, sight_refracted.

// The gradient of the centre, camera axes, from that of where it appears on the image. Ranges have none.
fn centre_pulled(m: vec3<f32>, v_centre2d: vec2<f32>, v_range: f32) -> vec3<f32> {
    let c = crossing_at(m);
    let inv_z = 1.0 / c.at.z;
    let v = frame.focal * v_centre2d;
    return pulled_crossing(c, inv_z * vec3<f32>(v, -dot(v, c.at.xy) * inv_z));
}
