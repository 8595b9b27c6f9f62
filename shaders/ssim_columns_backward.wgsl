//@ import frame, ssim
// SSIM, step 4 of 4: smooths along columns and gives the gradient of the loss by the render.
//
//     v_x = keep ((1-w) sign(x - y) - w (G*dm_x + 2 x G*ds_xx + y G*ds_xy)) / (3HW)
//   v_image [H*W*4]  this channel of vec4 (rgb, alpha); the alpha entry stays as it was
// One thread makes eight pixels of a column. Twin: core/src/reference/loss.rs

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read> smoothed: array<f32>;
@group(0) @binding(4) var<storage, read_write> v_image: array<f32>;

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let runs = (loss.size.y + RUN - 1u) / RUN;
    let i = folded(group, groups) * 32u + lane;
    if i >= runs * loss.size.x {
        return;
    }
    let column = i % loss.size.x;
    let y0 = (i / loss.size.x) * RUN;
    let plane = loss.size.x * loss.size.y;
    var m_a = vec4<f32>(0.0); var m_b = vec4<f32>(0.0);
    var s_a = vec4<f32>(0.0); var s_b = vec4<f32>(0.0);
    var c_a = vec4<f32>(0.0); var c_b = vec4<f32>(0.0);
    for (var k = 0u; k < TAPS; k++) {
        let row = i32(y0 + k) - 5;
        if row >= 0 && row < i32(loss.size.y) {
            let at = u32(row) * loss.size.x + column;
            let a = loss.weights_a[k];
            let b = loss.weights_b[k];
            let m = smoothed[at];
            let s = smoothed[plane + at];
            let c = smoothed[2u * plane + at];
            m_a += a * m; m_b += b * m;
            s_a += a * s; s_b += b * s;
            c_a += a * c; c_b += b * c;
        }
    }
    for (var j = 0u; j < RUN; j++) {
        if y0 + j < loss.size.y {
            let at = (y0 + j) * loss.size.x + column;
            let q = j & 3u;
            let low = j < 4u;
            let pixel = truth[at];
            let keep = select(1.0, mask_of(pixel), loss.masked != 0u);
            let x = image[at][loss.channel];
            let y = truth_channel(pixel, loss.channel);
            let by_ssim = select(m_b[q], m_a[q], low) + 2.0 * x * select(s_b[q], s_a[q], low) + y * select(c_b[q], c_a[q], low);
            let gradient = (1.0 - loss.ssim_weight) * sign(x - y) - loss.ssim_weight * by_ssim;
            v_image[4u * at + loss.channel] = keep * loss.scale * gradient;
        }
    }
}
