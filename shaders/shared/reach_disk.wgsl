// How far a disk may reach from its projected centre on the image. Needs frame, outline.

// As in reach_splat.wgsl. With s the scale and r the deviations, the ellipse of bound_of has half axes of at
// most r s sqrt(1 + |m.xy / m.z|^2) / sqrt(left), and lies r times as far times r s / sqrt(left) off centre.
fn reach_of(frame: Frame, m: vec3<f32>, max_scale: f32, deviations: f32) -> vec2<f32> {
    let wide = deviations * max_scale;
    let left = m.z * m.z - wide * wide;
    // It may reach behind the camera: it counts as seen.
    if !(left > 2.0 * LEAST_IN_FRONT * m.z * m.z) {
        return vec2<f32>(1e30);
    }
    let ratio = m.xy / m.z;
    let half = 1.01 * wide * sqrt(1.0 + dot(ratio, ratio)) / sqrt(left);
    let off = half * wide / sqrt(left);
    let along = frame.focal * half + 3.0 * max(frame.focal.x, frame.focal.y) * off;
    return along + vec2<f32>(deviations * LOW_PASS + 0.5);
}

fn place_of(frame: Frame, mean: vec3<f32>, m: vec3<f32>, max_scale: f32, deviations: f32) -> Place {
    return Place(frame.focal * m.xy / m.z + frame.principal, reach_of(frame, m, max_scale, deviations),
        m.z > NEAR && is_on_side(mean));
}

// Disks have no third scale.
fn largest_of(log_scale: vec3<f32>) -> f32 {
    return max(log_scale.x, log_scale.y);
}
