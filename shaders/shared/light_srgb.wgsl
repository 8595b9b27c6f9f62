// Render and photograph are compared in sRGB, the encoding of the photograph.

fn truth_channel(pixel: u32, channel: u32) -> f32 {
    return f32((pixel >> (8u * channel)) & 255u) * (1.0 / 255.0);
}
