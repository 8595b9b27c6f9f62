// As straight_pixels.wgsl, for rays at the water surface. Masks, normals and ranges belong to disks that are
// seen straight.

const HAS_MAPS: bool = false;

fn v_of(at: u32) -> vec4<f32> {
    return v_pixels[at];
}

fn v_surface_of(at: u32) -> vec4<f32> {
    return vec4<f32>(0.0);
}

fn v_mask_of(at: u32) -> f32 {
    return 0.0;
}
