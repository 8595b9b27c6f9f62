// Sizes and opacities of 3D Gaussians.

fn largest_of(log_scale: vec3<f32>) -> f32 {
    return max(log_scale.x, max(log_scale.y, log_scale.z));
}

fn seen_opacity(mean: vec3<f32>, opacity: f32, log_scale: vec3<f32>) -> f32 {
    return opacity;
}

fn weight_of(log_scale: vec3<f32>) -> f32 {
    return 1.0;
}
