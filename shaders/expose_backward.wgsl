//@ import frame, exposure
// Backpropagates through the exposure of a view, and sums the gradient w.r.t. the exposure by workgroup.
//
//     v_colour = A^T v_colour',  v_[A | b] = sum over pixels of v_colour' (colour, 1)^T
//   v_image  [H*W]       vec4: in: w.r.t. colour'; out: w.r.t. colour; 0 where a pixel does not count
//   partials [groups*3]  vec4: rows of v_[A | b], summed over the workgroup's EXPOSE_CHUNK pixels
// A thread takes every 64th pixel of its chunk. The sums of the threads are added in their order, so runs are
// identical. Twin: core/twins/src/exposure.rs

@group(0) @binding(0) var<uniform> exposure: Exposure;
@group(0) @binding(1) var<storage, read> exposures: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> v_image: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> partials: array<vec4<f32>>;

var<workgroup> sh_sums: array<vec4<f32>, 192>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let id = folded(group, groups);
    let at = 3u * exposure.view;
    let row_r = exposures[at];
    let row_g = exposures[at + 1u];
    let row_b = exposures[at + 2u];
    var sum_r = vec4<f32>(0.0);
    var sum_g = vec4<f32>(0.0);
    var sum_b = vec4<f32>(0.0);
    for (var k = 0u; k < EXPOSE_CHUNK / 64u; k++) {
        let i = id * EXPOSE_CHUNK + k * 64u + lane;
        if i < exposure.pixels {
            let v = v_image[i];
            let colour = vec4<f32>(image[i].rgb, 1.0);
            sum_r += v.r * colour;
            sum_g += v.g * colour;
            sum_b += v.b * colour;
            v_image[i] = vec4<f32>(v.r * row_r.xyz + v.g * row_g.xyz + v.b * row_b.xyz, v.a);
        }
    }
    sh_sums[3u * lane] = sum_r;
    sh_sums[3u * lane + 1u] = sum_g;
    sh_sums[3u * lane + 2u] = sum_b;
    workgroupBarrier();
    if lane < 3u {
        var total = vec4<f32>(0.0);
        for (var k = 0u; k < 64u; k++) {
            total += sh_sums[3u * k + lane];
        }
        let to = 3u * id + lane;
        // Groups that only fill up the last row of a folded dispatch have no row.
        if to < arrayLength(&partials) {
            partials[to] = total;
        }
    }
}
