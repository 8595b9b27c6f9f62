// How far a splat may reach from its centre on the image. Needs frame.

// Pixels, for a Gaussian whose centre is at `m` in camera space, with its largest scale and the number of
// standard deviations that are seen. Slack of 1 % and half a pixel: it may be too large, never too small.
fn reach_of(frame: Frame, m: vec3<f32>, max_scale: f32, deviations: f32) -> vec2<f32> {
    let ratio = clamp(m.xy / m.z, frame.ratio_min, frame.ratio_max);
    let spread = 1.01 * sqrt(1.0 + dot(ratio, ratio)) * max_scale / m.z;
    return deviations * (frame.focal * spread + vec2<f32>(sqrt(BLUR))) + vec2<f32>(0.5);
}

fn place_of(frame: Frame, mean: vec3<f32>, m: vec3<f32>, max_scale: f32, deviations: f32) -> Place {
    return Place(frame.focal * m.xy / m.z + frame.principal, reach_of(frame, m, max_scale, deviations), m.z > NEAR);
}

fn largest_of(log_scale: vec3<f32>) -> f32 {
    return max(log_scale.x, max(log_scale.y, log_scale.z));
}
