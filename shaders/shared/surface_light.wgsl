// Light that reaches the eye from a water surface (WSGS, eq. 11). Needs surface, water.

// Reflected and refracted light are in sRGB as they were blended.
fn light_of(surface: Surface, shown: vec3<f32>) -> vec3<f32> {
    return select(decoded(shown), shown, surface.as_shown != 0u);
}

fn shown_of(surface: Surface, light: vec3<f32>) -> vec3<f32> {
    return select(encoded(light), light, surface.as_shown != 0u);
}
