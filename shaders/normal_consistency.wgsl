//@ import frame, normals
// Normal consistency of disks (2DGS, Huang et al. 2024, eq. 14), first half.
//
//     loss = weight * sum over pixels of (alpha - n.N),  N = dy x dx / |dy x dx|
// n is the blended normal and N that of the expected range, by central differences dx, dy of the points where
// the rays end. Alpha counts as a constant, as in the authors' code. A pixel at the border of the image, or
// with a neighbour of low alpha, has no N.
//   v_normal_image [H*W] vec4: w.r.t. n; 0
//   v_slopes [H*W*2] vec4: w.r.t. dx and dy
// One thread per pixel. Twin: core/twins/src/normals.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> normals: Normals;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> range_image: array<f32>;
@group(0) @binding(4) var<storage, read> normal_image: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> v_normal_image: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> v_slopes: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let i = folded(group, groups) * 64u + lane;
    let width = frame.size.x;
    if i >= width * frame.size.y {
        return;
    }
    let column = i % width;
    let row = i / width;
    let inner = column > 0u && column + 1u < width && row > 0u && row + 1u < frame.size.y;
    // Without branches: a CPU adapter executes both sides.
    let left = select(i, i - 1u, inner);
    let right = select(i, i + 1u, inner);
    let above = select(i, i - width, inner);
    let below = select(i, i + width, inner);
    let dx = end_of(right) - end_of(left);
    let dy = end_of(below) - end_of(above);
    let across = cross(dy, dx);
    let size = length(across);
    let least = min(image[i].w, min(min(image[left].w, image[right].w), min(image[above].w, image[below].w)));
    let is_seen = inner && least >= normals.least_alpha && size > 1e-20 && is_finite(size);
    let weight = select(0.0, normals.weight, is_seen);
    let scale = select(0.0, 1.0 / size, is_seen);
    let unit = select(vec3<f32>(0.0), across, vec3<bool>(is_seen)) * scale;
    let v_unit = -weight * normal_image[i].xyz;
    let v_across = (v_unit - unit * dot(unit, v_unit)) * scale;
    v_normal_image[i] = vec4<f32>(-weight * unit, 0.0);
    v_slopes[2u * i] = vec4<f32>(select(vec3<f32>(0.0), cross(v_across, dy), vec3<bool>(is_seen)), 0.0);
    v_slopes[2u * i + 1u] = vec4<f32>(select(vec3<f32>(0.0), cross(dx, v_across), vec3<bool>(is_seen)), 0.0);
}
