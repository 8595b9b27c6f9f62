//@ import frame, ssim
// SSIM, step 1 of 4: one channel of render and truth, and their products, smoothed along rows.
//
//   moments [5*H*W]  planes of x, y, xx, yy, xy (x the render, y the truth, 0..1; both 0 where masked)
// One thread makes eight neighbouring pixels of a row. Twin: core/src/reference/loss.rs

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read_write> moments: array<f32>;

fn put(at: u32, inside: bool, x: f32, y: f32, xx: f32, yy: f32, xy: f32) {
    if inside {
        let plane = loss.size.x * loss.size.y;
        moments[at] = x;
        moments[plane + at] = y;
        moments[2u * plane + at] = xx;
        moments[3u * plane + at] = yy;
        moments[4u * plane + at] = xy;
    }
}

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
    let at = row * loss.size.x + x0;
    let left = loss.size.x - x0;
    put(at + 0u, left > 0u, x_a.x, y_a.x, xx_a.x, yy_a.x, xy_a.x);
    put(at + 1u, left > 1u, x_a.y, y_a.y, xx_a.y, yy_a.y, xy_a.y);
    put(at + 2u, left > 2u, x_a.z, y_a.z, xx_a.z, yy_a.z, xy_a.z);
    put(at + 3u, left > 3u, x_a.w, y_a.w, xx_a.w, yy_a.w, xy_a.w);
    put(at + 4u, left > 4u, x_b.x, y_b.x, xx_b.x, yy_b.x, xy_b.x);
    put(at + 5u, left > 5u, x_b.y, y_b.y, xx_b.y, yy_b.y, xy_b.y);
    put(at + 6u, left > 6u, x_b.z, y_b.z, xx_b.z, yy_b.z, xy_b.z);
    put(at + 7u, left > 7u, x_b.w, y_b.w, xx_b.w, yy_b.w, xy_b.w);
}
