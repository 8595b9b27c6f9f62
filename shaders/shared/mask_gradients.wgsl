// What the backward pass of disks knows of a pixel: v_pixels, and the gradient of the blended mask. Rays from
// the eye have no gradient. Needs the name v_pixels.

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

alias Noted = f32;

fn note(noted: ptr<private, Noted>, disk: Splat, plane: Plane, met: Met, v_u: vec4<f32>, v_v: vec4<f32>,
        turn: vec4<f32>) {}

fn store_noted(column: u32, row: u32, noted: Noted) {}
