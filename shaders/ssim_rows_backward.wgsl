//@ import frame, ssim
// SSIM, step 3 of 4: the derivatives smoothed along rows. The window is symmetric, so its adjoint is itself.
//
//   partials [3*H*W] in, smoothed [3*H*W] out. One thread makes eight neighbouring pixels of a row.

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> partials: array<f32>;
@group(0) @binding(2) var<storage, read_write> smoothed: array<f32>;

fn put(at: u32, inside: bool, m: f32, s: f32, c: f32) {
    if inside {
        let plane = loss.size.x * loss.size.y;
        smoothed[at] = m;
        smoothed[plane + at] = s;
        smoothed[2u * plane + at] = c;
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
    let at = row * loss.size.x + x0;
    let left = loss.size.x - x0;
    put(at + 0u, left > 0u, m_a.x, s_a.x, c_a.x);
    put(at + 1u, left > 1u, m_a.y, s_a.y, c_a.y);
    put(at + 2u, left > 2u, m_a.z, s_a.z, c_a.z);
    put(at + 3u, left > 3u, m_a.w, s_a.w, c_a.w);
    put(at + 4u, left > 4u, m_b.x, s_b.x, c_b.x);
    put(at + 5u, left > 5u, m_b.y, s_b.y, c_b.y);
    put(at + 6u, left > 6u, m_b.z, s_b.z, c_b.z);
    put(at + 7u, left > 7u, m_b.w, s_b.w, c_b.w);
}
