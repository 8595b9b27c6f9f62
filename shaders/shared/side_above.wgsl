// The water surface reflects only what lies above it. Needs surface.

@group(0) @binding(6) var<uniform> surface: Surface;

fn is_on_side(mean: vec3<f32>) -> bool {
    return dot(surface.normal, mean) > surface.offset;
}
