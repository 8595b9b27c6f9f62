// Sizes of disks that only refracted rays see: those below the water surface. Needs surface.

@group(0) @binding(4) var<uniform> surface: Surface;

fn largest_of(log_scale: vec3<f32>) -> f32 {
    return max(log_scale.x, log_scale.y);
}

// Others count as faded.
fn seen_opacity(mean: vec3<f32>, opacity: f32, log_scale: vec3<f32>) -> f32 {
    return select(0.0, opacity, dot(surface.normal, mean) < surface.offset);
}

fn weight_of(log_scale: vec3<f32>) -> f32 {
    return 1.0;
}
