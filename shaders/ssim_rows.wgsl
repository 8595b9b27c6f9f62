//@ import frame, ssim
// SSIM, step 1 of 4: one channel of render and truth, and their products, smoothed along rows.
//
//   moments [5*H*W]  planes of x, y, xx, yy, xy (x the render, y the truth, 0..1; both 0 where masked)
// One thread makes eight neighbouring pixels of a row. Twin: core/src/reference/loss.rs

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read_write> moments: array<f32>;

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let runs = (loss.size.x + RUN - 1u) / RUN;
    let i = folded(group, groups) * 32u + lane;
    if i >= runs * loss.size.y {
        return;
    }
    let row = i / runs;
    let x0 = (i % runs) * RUN;
    var x_a = vec4<f32>(0.0); var x_b = vec4<f32>(0.0);
    var y_a = vec4<f32>(0.0); var y_b = vec4<f32>(0.0);
    var xx_a = vec4<f32>(0.0); var xx_b = vec4<f32>(0.0);
    var yy_a = vec4<f32>(0.0); var yy_b = vec4<f32>(0.0);
    var xy_a = vec4<f32>(0.0); var xy_b = vec4<f32>(0.0);
    for (var k = 0u; k < TAPS; k++) {
        let column = i32(x0 + k) - 5;
        if column >= 0 && column < i32(loss.size.x) {
            let at = row * loss.size.x + u32(column);
            let pixel = truth[at];
            let keep = select(1.0, mask_of(pixel), loss.masked != 0u);
            let x = keep * image[at][loss.channel];
            let y = keep * truth_channel(pixel, loss.channel);
            let a = loss.weights_a[k];
            let b = loss.weights_b[k];
            x_a += a * x; x_b += b * x;
            y_a += a * y; y_b += b * y;
            xx_a += a * (x * x); xx_b += b * (x * x);
            yy_a += a * (y * y); yy_b += b * (y * y);
            xy_a += a * (x * y); xy_b += b * (x * y);
        }
    }
    let plane = loss.size.x * loss.size.y;
    for (var j = 0u; j < RUN; j++) {
        if x0 + j < loss.size.x {
            let at = row * loss.size.x + x0 + j;
            let q = j & 3u;
            let low = j < 4u;
            moments[at] = select(x_b[q], x_a[q], low);
            moments[plane + at] = select(y_b[q], y_a[q], low);
            moments[2u * plane + at] = select(xx_b[q], xx_a[q], low);
            moments[3u * plane + at] = select(yy_b[q], yy_a[q], low);
            moments[4u * plane + at] = select(xy_b[q], xy_a[q], low);
        }
    }
}
