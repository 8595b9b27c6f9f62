//@ import frame, water, medium
// The underwater image in the light of the loss, between blending and loss (SMP-UWGS eq. 7).
//
//     per Gaussian: the blended image is under water already; open water (b_inf) shows where alpha < 1
//     per pixel:    I = Ja exp(-beta_d r) + b_inf (1 - a exp(-beta_b r))
//                   Ja the blended image in linear light, a its alpha, r = R/a
//                   over black: the second term is b_inf (a - a exp(-beta_b r))
//                   with eq. 9, beta_d and beta_b are multiplied by its factors at r
//     If b_inf changes with direction, it is multiplied by its factors along the ray of the pixel.
//   image [H*W] vec4: colour blended over black, and alpha
//   range_image [H*W]  R, the blended range, scene units
//   seen  [H*W] vec4: the image in the light of the loss, and alpha
// One thread per pixel. Twin: core/twins/src/water.rs

@group(0) @binding(0) var<uniform> medium: Medium;
@group(0) @binding(1) var<uniform> water: Water;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> range_image: array<f32>;
@group(0) @binding(4) var<storage, read_write> seen: array<vec4<f32>>;
@group(0) @binding(5) var<uniform> frame: Frame;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i < medium.pixels {
        let pixel = image[i];
        var here = water;
        here.b_inf *= colour_factors(water, direction_of(frame, i));
        var rgb = formed(veiled(medium.compose, arrayLength(&image) + 6u), here, pixel, range_image[i]);
        if veiled(medium.encode, arrayLength(&image)) != 0u {
            rgb = encoded(rgb);
        }
        seen[i] = vec4<f32>(rgb, pixel.a);
    }
}
