// What the backward pass of disks knows of a pixel: v_pixels, and the gradient of the blended mask. Needs the
// name v_pixels.

// Whether normals, ranges and masks have gradients.
const HAS_MAPS: bool = true;

@group(0) @binding(9) var<storage, read> v_mask_image: array<f32>;

fn v_of(at: u32) -> vec4<f32> {
    return v_pixels[2u * at];
}

fn v_surface_of(at: u32) -> vec4<f32> {
    return v_pixels[2u * at + 1u];
}

fn v_mask_of(at: u32) -> f32 {
    return v_mask_image[at];
}
