//@ import frame, film, film_map
// Backpropagates through the view embedding to the image (eq. 10), after film_cells_backward has read the
// gradient.
//
//     v_I_u = F * v_I_d + the part through the mean of the cell
//   maps    [cells]    vec4: F of a cell
//   v_cells [cells*2]  vec4: w.r.t. o; and w.r.t. I_u of each pixel of the cell through its mean
//   v_image [H*W]      vec4: in: w.r.t. I_d; out: w.r.t. I_u
// One thread per pixel. Twin: core/twins/src/film.rs

@group(0) @binding(0) var<uniform> film: Film;
@group(0) @binding(1) var<storage, read> maps: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> v_cells: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> v_image: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    if i < film.size.x * film.size.y {
        let x = i % film.size.x;
        let y = i / film.size.x;
        let cell = part_of(y, film.cells.y, film.size.y) * film.cells.x + part_of(x, film.cells.x, film.size.x);
        let v = v_image[i];
        v_image[i] = vec4<f32>(factor_at(x, y) * v.rgb + v_cells[2u * cell + 1u].xyz, v.a);
    }
}
