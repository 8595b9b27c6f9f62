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

fn put(at: u32, inside: bool, m: f32, s: f32, c: f32) {
    if inside {
        let pixel = truth[at];
        let keep = select(1.0, mask_of(pixel), loss.masked != 0u);
        let x = image[at][loss.channel];
        let y = truth_channel(pixel, loss.channel);
        let gradient = (1.0 - loss.ssim_weight) * sign(x - y) - loss.ssim_weight * (m + 2.0 * x * s + y * c);
        v_image[4u * at + loss.channel] = keep * loss.scale * gradient;
    }
}

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
    let at = y0 * loss.size.x + column;
    let left = loss.size.y - y0;
    put(at + 0u * loss.size.x, left > 0u, m_a.x, s_a.x, c_a.x);
    put(at + 1u * loss.size.x, left > 1u, m_a.y, s_a.y, c_a.y);
    put(at + 2u * loss.size.x, left > 2u, m_a.z, s_a.z, c_a.z);
    put(at + 3u * loss.size.x, left > 3u, m_a.w, s_a.w, c_a.w);
    put(at + 4u * loss.size.x, left > 4u, m_b.x, s_b.x, c_b.x);
    put(at + 5u * loss.size.x, left > 5u, m_b.y, s_b.y, c_b.y);
    put(at + 6u * loss.size.x, left > 6u, m_b.z, s_b.z, c_b.z);
    put(at + 7u * loss.size.x, left > 7u, m_b.w, s_b.w, c_b.w);
}
