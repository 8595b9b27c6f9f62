//@ import frame, ssim
// SSIM, step 2 of 4: smooths along columns, evaluates SSIM (Wang et al. 2004, eq. 13) and its derivatives, sums the loss.
//
//     SSIM = (2 m_x m_y + C1)(2 s_xy + C2) / ((m_x^2 + m_y^2 + C1)(s_xx + s_yy + C2)),  C1 = .01^2, C2 = .03^2
//   partials [3*H*W]  planes of dSSIM/d m_x, d s_xx, d s_xy at each window's centre (times the mask)
//   sums     [groups] loss of this channel by workgroup: (1-w) keep |x - y| + w (1 - keep SSIM), before the division by 3HW
// One thread makes eight pixels of a column. Twin: core/src/reference/loss.rs

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read> moments: array<f32>;
@group(0) @binding(4) var<storage, read_write> partials: array<f32>;
@group(0) @binding(5) var<storage, read_write> sums: array<f32>;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;
var<workgroup> sh_sums: array<f32, 32>;

// SSIM and its derivatives at one pixel, from the window's moments; gives the pixel's loss.
fn finish(at: u32, inside: bool, mx: f32, my: f32, exx: f32, eyy: f32, exy: f32) -> f32 {
    if !inside {
        return 0.0;
    }
    let plane = loss.size.x * loss.size.y;
    let sxx = exx - mx * mx;
    let syy = eyy - my * my;
    let sxy = exy - mx * my;
    let n1 = 2.0 * mx * my + C1;
    let n2 = 2.0 * sxy + C2;
    let d1 = mx * mx + my * my + C1;
    let d2 = sxx + syy + C2;
    let inv = 1.0 / (d1 * d2);
    let ssim = n1 * n2 * inv;
    let pixel = truth[at];
    let keep = select(1.0, mask_of(pixel), loss.masked != 0u);
    let by_sxy = 2.0 * n1 * inv;
    let by_sxx = -ssim / d2;
    // s_xx and s_xy hold m_x too: s_xx = E[xx] - m_x^2, s_xy = E[xy] - m_x m_y.
    let by_mx = 2.0 * my * n2 * inv - 2.0 * mx * ssim / d1 - 2.0 * mx * by_sxx - my * by_sxy;
    partials[at] = keep * by_mx;
    partials[plane + at] = keep * by_sxx;
    partials[2u * plane + at] = keep * by_sxy;
    let l1 = abs(image[at][loss.channel] - truth_channel(pixel, loss.channel));
    return (1.0 - loss.ssim_weight) * keep * l1 + loss.ssim_weight * (1.0 - keep * ssim);
}

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let runs = (loss.size.y + RUN - 1u) / RUN;
    let id = folded(group, groups);
    let i = id * 32u + lane;
    var sum = 0.0;
    if i < runs * loss.size.x {
        let column = i % loss.size.x;
        let y0 = (i / loss.size.x) * RUN;
        let plane = loss.size.x * loss.size.y;
        var x_a = vec4<f32>(0.0); var x_b = vec4<f32>(0.0);
        var y_a = vec4<f32>(0.0); var y_b = vec4<f32>(0.0);
        var xx_a = vec4<f32>(0.0); var xx_b = vec4<f32>(0.0);
        var yy_a = vec4<f32>(0.0); var yy_b = vec4<f32>(0.0);
        var xy_a = vec4<f32>(0.0); var xy_b = vec4<f32>(0.0);
        for (var k = 0u; k < TAPS; k++) {
            let row = i32(y0 + k) - 5;
            if row >= 0 && row < i32(loss.size.y) {
                let at = u32(row) * loss.size.x + column;
                let a = loss.weights_a[k];
                let b = loss.weights_b[k];
                let x = moments[at];
                let y = moments[plane + at];
                let xx = moments[2u * plane + at];
                let yy = moments[3u * plane + at];
                let xy = moments[4u * plane + at];
                x_a += a * x; x_b += b * x;
                y_a += a * y; y_b += b * y;
                xx_a += a * xx; xx_b += b * xx;
                yy_a += a * yy; yy_b += b * yy;
                xy_a += a * xy; xy_b += b * xy;
            }
        }
        let at = y0 * loss.size.x + column;
        let left = loss.size.y - y0;
        sum += finish(at + 0u * loss.size.x, left > 0u, x_a.x, y_a.x, xx_a.x, yy_a.x, xy_a.x);
        sum += finish(at + 1u * loss.size.x, left > 1u, x_a.y, y_a.y, xx_a.y, yy_a.y, xy_a.y);
        sum += finish(at + 2u * loss.size.x, left > 2u, x_a.z, y_a.z, xx_a.z, yy_a.z, xy_a.z);
        sum += finish(at + 3u * loss.size.x, left > 3u, x_a.w, y_a.w, xx_a.w, yy_a.w, xy_a.w);
        sum += finish(at + 4u * loss.size.x, left > 4u, x_b.x, y_b.x, xx_b.x, yy_b.x, xy_b.x);
        sum += finish(at + 5u * loss.size.x, left > 5u, x_b.y, y_b.y, xx_b.y, yy_b.y, xy_b.y);
        sum += finish(at + 6u * loss.size.x, left > 6u, x_b.z, y_b.z, xx_b.z, yy_b.z, xy_b.z);
        sum += finish(at + 7u * loss.size.x, left > 7u, x_b.w, y_b.w, xx_b.w, yy_b.w, xy_b.w);
    }
    sh_sums[lane] = sum;
    workgroupBarrier();
    if lane == 0u {
        var total = 0.0;
        for (var k = 0u; k < 32u; k++) {
            total += sh_sums[k];
        }
        sums[id] = total;
    }
}
