// How far a disk below the water surface may reach from where its centre appears. Needs frame, projection,
// surface, outline, place.

@group(0) @binding(6) var<uniform> surface: Surface;

// A small ball appears as an ellipse whose half width is the length of the row of the Jacobian. Others count
// as seen.
fn place_of(frame: Frame, mean: vec3<f32>, m: vec3<f32>, max_scale: f32, deviations: f32) -> Place {
    let c = crossing_of(level_of(frame, surface), surface.eta, m);
    let q = c.at;
    let by_x = pulled_crossing(c, vec3<f32>(frame.focal.x / q.z, 0.0, -frame.focal.x * q.x / (q.z * q.z)));
    let by_y = pulled_crossing(c, vec3<f32>(0.0, frame.focal.y / q.z, -frame.focal.y * q.y / (q.z * q.z)));
    let size = max_scale / (length(q) + length(m - q));
    let wide = 1.01 * wider(size) * deviations * max_scale;
    let pad = wider(size) * (deviations * LOW_PASS + 1.0);
    let reach = wide * vec2<f32>(length(by_x), length(by_y)) + vec2<f32>(pad);
    return Place(frame.focal * q.xy / q.z + frame.principal, select(vec2<f32>(1e30), reach, size <= SMALL),
        c.depth > 0.0 && q.z > NEAR);
}

// Disks have no third scale.
fn largest_of(log_scale: vec3<f32>) -> f32 {
    return max(log_scale.x, log_scale.y);
}
