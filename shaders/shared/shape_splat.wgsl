// The ellipse of a 3D Gaussian on the image. Needs frame, gaussian, projection and the names frame, flags.

// z: smoothing; frozen blocks have a single row of zeros.
@group(0) @binding(10) var<storage, read> density_sums: array<vec4<f32>>;

struct Shape {
    // Pixels, 1/pixel^2.
    mean2d: vec2<f32>,
    conic: vec3<f32>,
    // Of the centre, scene units: distance from the camera, and depth.
    range: f32,
    depth: f32,
    // With the effect of the filters of Mip-Splatting.
    opacity: f32,
    // Kept behind the colour; 0 for 3D Gaussians.
    mask: f32,
    // False for a covariance that overflowed, or cancelled to nothing: it touches no tile.
    is_sound: bool,
}

fn shape_of(i: u32, visible_id: u32, mean: vec3<f32>, solid_opacity: f32, quat: vec4<f32>, log_scale: vec3<f32>) -> Shape {
    var scales = exp(log_scale);
    var opacity = solid_opacity;
    let filtered = veiled(frame.mip_filter, arrayLength(&flags)) != 0u;
    if filtered {
        let smoothing = density_sums[min(i, arrayLength(&density_sums) - 1u)].z;
        if smoothing > 0.0 {
            let wide = widened(scales, smoothing);
            let shares = scales / wide;
            opacity *= shares.x * shares.y * shares.z;
            scales = wide;
        }
    }
    let p = project(frame, mean, rotation(quat), scales);
    let mean2d = frame.focal * p.centre.xy / p.centre.z + frame.principal;
    let det = p.cov.x * p.cov.z - p.cov.y * p.cov.y;
    let conic = vec3<f32>(p.cov.z, -p.cov.y, p.cov.x) / det;
    if filtered {
        opacity *= compensation(p, det);
    }
    let is_sound = det > 0.0 && is_finite(det) && is_finite(conic.x) && is_finite(conic.y) && is_finite(conic.z)
        && is_finite(mean2d.x) && is_finite(mean2d.y);
    return Shape(mean2d, conic, length(p.centre), p.centre.z, opacity, 0.0, is_sound);
}
