//@ import frame, film, film_map
// Multiplies an image by the factors of its view embedding (eq. 10), bilinear between the centres of cells
// (film.wgsl).
//
//     I_d = F * I_u
//   image  [H*W]    vec4: rgb of I_u, alpha
//   maps   [cells]  vec4: F of a cell
//   filmed [H*W]    vec4: rgb of I_d, alpha
// One thread per pixel. Twin: core/twins/src/film.rs

@group(0) @binding(0) var<uniform> film: Film;
@group(0) @binding(1) var<storage, read> maps: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> filmed: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i < film.size.x * film.size.y {
        let pixel = image[i];
        filmed[i] = vec4<f32>(factor_at(i % film.size.x, i / film.size.x) * pixel.rgb, pixel.a);
    }
}
