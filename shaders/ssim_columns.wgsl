//@ import ssim, frame, window, light
//@ variant ssim_columns light=light_srgb
//@ variant ssim_columns_linear light=water+light_linear
// SSIM, step 2 of 4: smooths along columns, evaluates SSIM (Wang et al. 2004, eq. 13) and its derivatives,
// and sums the loss.
//
//     SSIM = (2 m_x m_y + C1)(2 s_xy + C2) / ((m_x^2 + m_y^2 + C1)(s_xx + s_yy + C2))
//     C1 = .01^2, C2 = .03^2
//   partials [H*W]    vec4: dSSIM/d m_x, d s_xx, d s_xy at each window's centre (times the mask), 0
//   sums_out [groups] loss of this channel by workgroup, before the division by 3HW:
//                     (1-w) keep |x - y| + w (1 - keep SSIM)
// One thread computes eight pixels of a column. Twin: core/twins/src/loss.rs

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read> moments: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> partials: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read_write> sums_out: array<f32>;

const C1: f32 = 0.0001;
const C2: f32 = 0.0009;
var<workgroup> sh_sums: array<f32, 32>;
var<private> y0: u32;
var<private> column: u32;

fn input(k: u32) -> vec4<f32> {
    let row = i32(y0 + k) - 5;
    let inside = select(0.0, 1.0, row >= 0 && row < i32(loss.size.y));
    return inside * moments[u32(clamp(row, 0, i32(loss.size.y) - 1)) * loss.size.x + column];
}

// Writes the derivatives of SSIM at one pixel, from the window's moments; returns the pixel's loss.
fn finish(j: u32, inside: bool, moment: vec4<f32>) -> f32 {
    if !inside {
        return 0.0;
    }
    let at = (y0 + j) * loss.size.x + column;
    let mx = moment.x;
    let my = moment.y;
    let squares = mx * mx + my * my;
    let n1 = 2.0 * mx * my + C1;
    let n2 = 2.0 * (moment.w - mx * my) + C2;
    let d1 = squares + C1;
    let d2 = (moment.z - squares) + C2;
    let inv = 1.0 / (d1 * d2);
    let ssim = n1 * n2 * inv;
    let pixel = truth[at];
    let keep = select(1.0, mask_of(pixel), loss.masked != 0u);
    let by_sxy = 2.0 * n1 * inv;
    let by_sxx = -ssim / d2;
    // s_xx and s_xy also contain m_x: s_xx = E[xx] - m_x^2, s_xy = E[xy] - m_x m_y.
    let by_mx = 2.0 * my * n2 * inv - 2.0 * mx * ssim / d1 - 2.0 * mx * by_sxx - my * by_sxy;
    partials[at] = vec4<f32>(keep * by_mx, keep * by_sxx, keep * by_sxy, 0.0);
    let l1 = abs(image[at][loss.channel] - truth_channel(pixel, loss.channel));
    return (1.0 - loss.ssim_weight) * keep * l1 + loss.ssim_weight * (1.0 - keep * ssim);
}

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let runs = (loss.size.y + RUN - 1u) / RUN;
    let id = folded(group, groups);
    let i = id * 32u + lane;
    column = i % loss.size.x;
    // Excess threads work on the last run and add nothing.
    y0 = min(i / loss.size.x, runs - 1u) * RUN;
    smooth_run();
    let left = select(0u, loss.size.y - y0, i < runs * loss.size.x);
    var sum = finish(0u, left > 0u, sums[0]);
    sum += finish(1u, left > 1u, sums[1]);
    sum += finish(2u, left > 2u, sums[2]);
    sum += finish(3u, left > 3u, sums[3]);
    sum += finish(4u, left > 4u, sums[4]);
    sum += finish(5u, left > 5u, sums[5]);
    sum += finish(6u, left > 6u, sums[6]);
    sum += finish(7u, left > 7u, sums[7]);
    sh_sums[lane] = sum;
    workgroupBarrier();
    if lane == 0u {
        var total = 0.0;
        for (var k = 0u; k < 32u; k++) {
            total += sh_sums[k];
        }
        sums_out[id] = total;
    }
}
