// Render and photograph are compared in linear light (SMP-UWGS section 4). Needs water.

fn truth_channel(pixel: u32, channel: u32) -> f32 {
    return decoded(vec3<f32>(f32((pixel >> (8u * channel)) & 255u) / 255.0)).x;
}
