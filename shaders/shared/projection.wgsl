// The projection of one Gaussian (Zwicker et al. 2002, eq. 29 and 31), shared by the stages that need it.
// Needs frame.wgsl and gaussian.wgsl.

struct Projection {
    // Camera space, scene units.
    centre: vec3<f32>,
    // x/z and y/z inside the Jacobian, and 1 where they were not clamped.
    ratio: vec2<f32>,
    free: vec2<f32>,
    // Rows of A = J W R S: cov2d = A A^T.
    a_x: vec3<f32>,
    a_y: vec3<f32>,
    // Rows of T = J W.
    t_x: vec3<f32>,
    t_y: vec3<f32>,
    // cov2d with the low-pass, pixel^2: xx, xy, yy.
    cov: vec3<f32>,
}

fn to_camera(frame: Frame, mean: vec3<f32>) -> vec3<f32> {
    return vec3<f32>(
        dot(frame.view_x.xyz, mean) + frame.view_x.w,
        dot(frame.view_y.xyz, mean) + frame.view_y.w,
        dot(frame.view_z.xyz, mean) + frame.view_z.w,
    );
}

fn project(frame: Frame, mean: vec3<f32>, rot: mat3x3<f32>, scales: vec3<f32>) -> Projection {
    var p: Projection;
    p.centre = to_camera(frame, mean);
    let inv_z = 1.0 / p.centre.z;
    let raw = p.centre.xy * inv_z;
    p.ratio = clamp(raw, frame.ratio_min, frame.ratio_max);
    p.free = select(vec2<f32>(0.0), vec2<f32>(1.0), p.ratio == raw);
    // T = J W, J = [fx/z, 0, -fx u/z; 0, fy/z, -fy v/z].
    p.t_x = (frame.focal.x * inv_z) * (frame.view_x.xyz - p.ratio.x * frame.view_z.xyz);
    p.t_y = (frame.focal.y * inv_z) * (frame.view_y.xyz - p.ratio.y * frame.view_z.xyz);
    // v * M is M^T v for a column matrix: the row vector times R, then S.
    p.a_x = (p.t_x * rot) * scales;
    p.a_y = (p.t_y * rot) * scales;
    p.cov = vec3<f32>(dot(p.a_x, p.a_x) + BLUR, dot(p.a_x, p.a_y), dot(p.a_y, p.a_y) + BLUR);
    return p;
}

// The 2D filter of Mip-Splatting (Yu et al. 2024, eq. 9): the factor on opacity that keeps the low-pass from
// adding to a splat, sqrt(det(cov2d without low-pass) / det(cov2d)). The first determinant, of A A^T, is the
// square of |a_x x a_y|. This form avoids the difference of large numbers that would lose needles. The
// paper's variance is 0.1 px^2. Here it is BLUR, as in the antialiased modes of gsplat and of viewers, so
// that they show what was trained.
fn compensation(p: Projection, det: f32) -> f32 {
    return length(cross(p.a_x, p.a_y)) / sqrt(det);
}
