// Eight neighbouring outputs of the SSIM window at once. Needs ssim.wgsl and a function
// `input(k) -> vec4<f32>` of the stage. That function gives the k-th of the 18 inputs, or zeros outside the
// image.
//
// Each input is fetched once, not eleven times. The calls are unrolled, because in a loop a CPU adapter pays
// for a masked store of every running sum.

var<private> sums: array<vec4<f32>, 8>;

fn weigh(k: u32) {
    let v = input(k);
    let a = loss.weights_a[k];
    let b = loss.weights_b[k];
    sums[0] += a.x * v;
    sums[1] += a.y * v;
    sums[2] += a.z * v;
    sums[3] += a.w * v;
    sums[4] += b.x * v;
    sums[5] += b.y * v;
    sums[6] += b.z * v;
    sums[7] += b.w * v;
}

fn smooth_run() {
    sums[0] = vec4<f32>(0.0);
    sums[1] = vec4<f32>(0.0);
    sums[2] = vec4<f32>(0.0);
    sums[3] = vec4<f32>(0.0);
    sums[4] = vec4<f32>(0.0);
    sums[5] = vec4<f32>(0.0);
    sums[6] = vec4<f32>(0.0);
    sums[7] = vec4<f32>(0.0);
    weigh(0u);
    weigh(1u);
    weigh(2u);
    weigh(3u);
    weigh(4u);
    weigh(5u);
    weigh(6u);
    weigh(7u);
    weigh(8u);
    weigh(9u);
    weigh(10u);
    weigh(11u);
    weigh(12u);
    weigh(13u);
    weigh(14u);
    weigh(15u);
    weigh(16u);
    weigh(17u);
}
