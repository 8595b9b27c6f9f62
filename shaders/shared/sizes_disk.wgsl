// Sizes and opacities of disks, which have no third scale.

fn largest_of(log_scale: vec3<f32>) -> f32 {
    return max(log_scale.x, log_scale.y);
}

fn seen_opacity(mean: vec3<f32>, opacity: f32, log_scale: vec3<f32>) -> f32 {
    return opacity;
}

fn weight_of(log_scale: vec3<f32>) -> f32 {
    return 1.0;
}
