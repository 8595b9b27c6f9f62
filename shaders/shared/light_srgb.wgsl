// The light in which render and photograph are compared: sRGB, as the photograph is.

fn truth_channel(pixel: u32, channel: u32) -> f32 {
    return f32((pixel >> (8u * channel)) & 255u) * (1.0 / 255.0);
}
