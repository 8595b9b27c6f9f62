//@ import frame, normals
// Normal consistency of disks, second half: from the slopes to range and alpha.
//
//   v_slopes [H*W*2] vec4 of normal_consistency
//   v_image       [H*W] vec4: w.r.t. the blended colour and alpha; added to
//   v_range_image [H*W] w.r.t. the blended range; added to
// One thread per pixel gathers from its four neighbours. Twin: core/twins/src/normals.rs

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> range_image: array<f32>;
@group(0) @binding(3) var<storage, read> v_slopes: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> v_image: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> v_range_image: array<f32>;

// The gradient that `j` holds in its row of v_slopes; 0 if there is no such pixel.
fn slope(is_there: bool, j: u32, part: u32) -> vec3<f32> {
    return select(vec3<f32>(0.0), v_slopes[2u * j + part].xyz, vec3<bool>(is_there));
}

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
    let left = column > 0u;
    let right = column + 1u < width;
    let above = row > 0u;
    let below = row + 1u < frame.size.y;
    // A pixel is the right neighbour of the one to its left.
    let v_end = slope(left, select(i, i - 1u, left), 0u) - slope(right, select(i, i + 1u, right), 0u)
        + slope(above, select(i, i - width, above), 1u) - slope(below, select(i, i + width, below), 1u);
    let alpha = image[i].w;
    if alpha <= 1e-6 {
        return;
    }
    let v_range = dot(v_end, ray_of(i)) / alpha;
    v_range_image[i] += v_range;
    v_image[i].w -= v_range * range_image[i] / alpha;
}
