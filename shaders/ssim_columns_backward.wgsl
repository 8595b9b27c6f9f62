//@ import ssim, frame, window, light
//@ variant ssim_columns_backward light=light_srgb
//@ variant ssim_columns_backward_linear light=water+light_linear
// SSIM, step 4 of 4: smooths along columns and computes the gradient of the loss w.r.t. the render.
//
//     v_x = keep ((1-w) sign(x - y) - w (G*dm_x + 2 x G*ds_xx + y G*ds_xy)) / (3HW)
//   v_image [H*W*4]  this channel of vec4 (rgb, alpha); the alpha entry is unchanged
// One thread computes eight pixels of a column. Twin: core/twins/src/loss.rs

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read> smoothed: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> v_image: array<f32>;

var<private> y0: u32;
var<private> column: u32;

fn input(k: u32) -> vec4<f32> {
    let row = i32(y0 + k) - 5;
    let inside = select(0.0, 1.0, row >= 0 && row < i32(loss.size.y));
    return inside * smoothed[u32(clamp(row, 0, i32(loss.size.y) - 1)) * loss.size.x + column];
}

fn put(j: u32, inside: bool, by: vec4<f32>) {
    if inside {
        let at = (y0 + j) * loss.size.x + column;
        let pixel = truth[at];
        let keep = select(1.0, mask_of(pixel), loss.masked != 0u);
        let x = image[at][loss.channel];
        let y = truth_channel(pixel, loss.channel);
        let by_ssim = by.x + 2.0 * x * by.y + y * by.z;
        let gradient = (1.0 - loss.ssim_weight) * sign(x - y) - loss.ssim_weight * by_ssim;
        v_image[4u * at + loss.channel] = keep * loss.scale * gradient;
    }
}

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let runs = (loss.size.y + RUN - 1u) / RUN;
    let i = folded(group, groups) * 32u + lane;
    column = i % loss.size.x;
    // Excess threads work on the last run and write nothing.
    y0 = min(i / loss.size.x, runs - 1u) * RUN;
    smooth_run();
    let left = select(0u, loss.size.y - y0, i < runs * loss.size.x);
    put(0u, left > 0u, sums[0]);
    put(1u, left > 1u, sums[1]);
    put(2u, left > 2u, sums[2]);
    put(3u, left > 3u, sums[3]);
    put(4u, left > 4u, sums[4]);
    put(5u, left > 5u, sums[5]);
    put(6u, left > 6u, sums[6]);
    put(7u, left > 7u, sums[7]);
}
