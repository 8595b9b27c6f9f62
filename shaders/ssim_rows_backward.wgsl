//@ import frame, ssim
// SSIM, step 3 of 4: the derivatives smoothed along rows. The window is symmetric, so its adjoint is itself.
//
//   partials [3*H*W] in, smoothed [3*H*W] out. One thread makes eight neighbouring pixels of a row.

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> partials: array<f32>;
@group(0) @binding(2) var<storage, read_write> smoothed: array<f32>;

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
    let plane = loss.size.x * loss.size.y;
    var m_a = vec4<f32>(0.0); var m_b = vec4<f32>(0.0);
    var s_a = vec4<f32>(0.0); var s_b = vec4<f32>(0.0);
    var c_a = vec4<f32>(0.0); var c_b = vec4<f32>(0.0);
    for (var k = 0u; k < TAPS; k++) {
        let column = i32(x0 + k) - 5;
        if column >= 0 && column < i32(loss.size.x) {
            let at = row * loss.size.x + u32(column);
            let a = loss.weights_a[k];
            let b = loss.weights_b[k];
            let m = partials[at];
            let s = partials[plane + at];
            let c = partials[2u * plane + at];
            m_a += a * m; m_b += b * m;
            s_a += a * s; s_b += b * s;
            c_a += a * c; c_b += b * c;
        }
    }
    for (var j = 0u; j < RUN; j++) {
        if x0 + j < loss.size.x {
            let at = row * loss.size.x + x0 + j;
            let q = j & 3u;
            let low = j < 4u;
            smoothed[at] = select(m_b[q], m_a[q], low);
            smoothed[plane + at] = select(s_b[q], s_a[q], low);
            smoothed[2u * plane + at] = select(c_b[q], c_a[q], low);
        }
    }
}
