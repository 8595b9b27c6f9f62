// A Gaussian in memory and its covariance. Mirror: core/src/gpu/blocks.rs.
//
//   transforms [N*3]  vec4: (mean xyz, opacity logit), (quat wxyz), (log_scale xyz, step count as bits)
//   sh_coeffs  [N*S]  vec4: coefficients k of channel c at flat index 3*k + c, S = 3*ceil(K/4), padding is 0

struct Block {
    // Index of the first Gaussian of this block among all Gaussians.
    base: u32,
    count: u32,
    index: u32,
    // Number of vec4 per Gaussian in sh_coeffs.
    sh_stride: u32,
}

// Gaussians per culling bound. Mirror: core/src/gpu/bounds.rs.
const CHUNK: u32 = 4096u;
// Scales widened by the 3D filter of Mip-Splatting (Yu et al. 2024, eq. 8), of standard deviation
// `smoothing`. Opacity is multiplied by the product of old over new scales, which preserves the integral.
fn widened(scales: vec3<f32>, smoothing: f32) -> vec3<f32> {
    return sqrt(scales * scales + smoothing * smoothing);
}

fn sigmoid(x: f32) -> f32 {
    return 1.0 / (1.0 + exp(-x));
}

// Rotation matrix of a unit quaternion w x y z; columns.
fn rotation(q: vec4<f32>) -> mat3x3<f32> {
    let w = q.x; let x = q.y; let y = q.z; let z = q.w;
    return mat3x3<f32>(
        vec3<f32>(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3<f32>(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3<f32>(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
}
