//@ import ssim, frame, window, light
//@ variant ssim_rows light=light_srgb
//@ variant ssim_rows_linear light=water+light_linear
// SSIM, step 1 of 4: smooths one channel of render and photograph, and their products, along rows.
//
//   moments [H*W]  vec4: x, y, xx + yy, xy; x the render, y the photograph, 0..1, both in the light of the
//                  loss; both 0 where masked. SSIM needs the squares only as their sum.
// One thread computes eight neighbouring pixels of a row. Twin: core/twins/src/loss.rs

@group(0) @binding(0) var<uniform> loss: LossParams;
@group(0) @binding(1) var<storage, read> image: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read> truth: array<u32>;
@group(0) @binding(3) var<storage, read_write> moments: array<vec4<f32>>;

var<private> x0: u32;
var<private> row_at: u32;

fn input(k: u32) -> vec4<f32> {
    let column = i32(x0 + k) - 5;
    let at = row_at + u32(clamp(column, 0, i32(loss.size.x) - 1));
    let pixel = truth[at];
    let inside = select(0.0, 1.0, column >= 0 && column < i32(loss.size.x));
    let keep = inside * select(1.0, mask_of(pixel), loss.masked != 0u);
    let x = keep * image[at][loss.channel];
    let y = keep * truth_channel(pixel, loss.channel);
    return vec4<f32>(x, y, x * x + y * y, x * y);
}

fn put(at: u32, inside: bool, value: vec4<f32>) {
    if inside {
        moments[at] = value;
    }
}

@compute @workgroup_size(32)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) lane: u32) {
    let runs = (loss.size.x + RUN - 1u) / RUN;
    let i = folded(group, groups) * 32u + lane;
    // Excess threads work on the last row and write nothing.
    let row = min(i / runs, loss.size.y - 1u);
    x0 = (i % runs) * RUN;
    row_at = row * loss.size.x;
    smooth_run();
    let at = row_at + x0;
    let left = select(0u, loss.size.x - x0, i < runs * loss.size.y);
    put(at, left > 0u, sums[0]);
    put(at + 1u, left > 1u, sums[1]);
    put(at + 2u, left > 2u, sums[2]);
    put(at + 3u, left > 3u, sums[3]);
    put(at + 4u, left > 4u, sums[4]);
    put(at + 5u, left > 5u, sums[5]);
    put(at + 6u, left > 6u, sums[6]);
    put(at + 7u, left > 7u, sums[7]);
}
