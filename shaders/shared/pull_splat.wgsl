// From the gradient of a splat to that of its 3D Gaussian: the adjoint of the projection, without the colour.
// Needs frame, gaussian, projection, splat and the name flags. Twin: core/twins/src/project_backward.rs

struct Pulled {
    v_mean: vec3<f32>,
    // W.r.t. the quaternion of unit length.
    v_quat: vec4<f32>,
    v_log_scale: vec3<f32>,
    v_logit: f32,
}

// Which scales a Gaussian has.
const HAS_SCALE: vec3<f32> = vec3<f32>(1.0);

// Whether no pixel that counts sees the splat.
fn is_untouched(sum: Splat) -> bool {
    return all(sum.c.xyz == vec3<f32>(0.0)) && sum.b.z == 0.0 && sum.b.w == 0.0;
}

fn colour_gradient(sum: Splat) -> vec3<f32> {
    return sum.c.xyz;
}

// W.r.t. the centre on the image, per pixel; and the sum of its absolute values over pixels.
fn centre_gradient(sum: Splat) -> vec2<f32> {
    return sum.a.xy;
}

fn gradient_on_image(sum: Splat) -> f32 {
    return sum.b.w;
}

fn pull(sum: Splat, mean: vec3<f32>, quat: vec4<f32>, rot: mat3x3<f32>, bare_scales: vec3<f32>, log_scale: vec3<f32>,
        smoothing: f32, opacity: f32) -> Pulled {
    let g0 = sum.a;
    let g1 = sum.b;
    var scales = bare_scales;
    // Ratio of the scales before and after the 3D filter of Mip-Splatting.
    var shares = vec3<f32>(1.0);
    if smoothing > 0.0 {
        scales = widened(bare_scales, smoothing);
        shares = bare_scales / scales;
    }
    let p = project(frame, mean, rot, scales);
    let m = p.centre;
    let inv_z = 1.0 / m.z;

    // Opacity of the splat: opacity times the shares, and times r if the 2D filter is on.
    let share = shares.x * shares.y * shares.z;
    var v_logit = g1.y * share * opacity * (1.0 - opacity);
    // Gradient w.r.t. the logarithm of the factor on opacity.
    var v_log_factor = g1.y * share * opacity;

    // Conic to covariance: dL/dS = -C G C with C the conic and G its gradient as a symmetric matrix.
    let det = p.cov.x * p.cov.z - p.cov.y * p.cov.y;
    let a = p.cov.z / det;
    let b = -p.cov.y / det;
    let c = p.cov.x / det;
    let ga = g0.z;
    let gb = 0.5 * g0.w;
    let gc = g1.x;
    // Rows of G C, then of C (G C).
    let h00 = ga * a + gb * b;
    let h01 = ga * b + gb * c;
    let h10 = gb * a + gc * b;
    let h11 = gb * b + gc * c;
    let v_xx = -(a * h00 + b * h10);
    let v_xy = -(a * h01 + b * h11);
    let v_yy = -(b * h01 + c * h11);

    // cov2d = A A^T + blur: dL/dA = 2 V A.
    var v_ax = 2.0 * (v_xx * p.a_x + v_xy * p.a_y);
    var v_ay = 2.0 * (v_xy * p.a_x + v_yy * p.a_y);
    if veiled(frame.mip_filter, arrayLength(&flags)) != 0u {
        // Opacity times r = |n| / sqrt(det) with n = a_x x a_y: dr/dn = n / |n| / sqrt(det), dr/d cov2d =
        // -r/2 C.
        let normal = cross(p.a_x, p.a_y);
        let area = length(normal);
        let v_r = v_log_factor;
        let r = area / sqrt(det);
        let v_normal = (v_r / sqrt(det) / max(area, 1e-30)) * normal;
        v_ax += cross(p.a_y, v_normal) - (v_r * r) * (a * p.a_x + b * p.a_y);
        v_ay += cross(v_normal, p.a_x) - (v_r * r) * (b * p.a_x + c * p.a_y);
        v_logit *= r;
        v_log_factor *= r;
    }
    // A = T R S, rows. M = R S: dL/dM = T^T dL/dA (entry [row of world][column of axis]); dL/dT = dL/dA M^T.
    let v_tx = rot * (v_ax * scales);
    let v_ty = rot * (v_ay * scales);
    // Columns of dL/dM.
    let v_m0 = p.t_x * v_ax.x + p.t_y * v_ay.x;
    let v_m1 = p.t_x * v_ax.y + p.t_y * v_ay.y;
    let v_m2 = p.t_x * v_ax.z + p.t_y * v_ay.z;
    var v_log_scale = scales * vec3<f32>(dot(v_m0, rot[0]), dot(v_m1, rot[1]), dot(v_m2, rot[2]));
    if smoothing > 0.0 {
        let inner = shares * shares;
        v_log_scale = v_log_scale * inner + v_log_factor * (1.0 - inner);
    }
    let r0 = v_m0 * scales.x;
    let r1 = v_m1 * scales.y;
    let r2 = v_m2 * scales.z;
    // Columns r0, r1, r2 of dL/dR; entry R[row][col] = r_col[row].
    let w = quat.x; let x = quat.y; let y = quat.z; let z = quat.w;
    let v_unit = 2.0 * vec4<f32>(
        x * (r1.z - r2.y) + y * (r2.x - r0.z) + z * (r0.y - r1.x),
        -2.0 * x * (r1.y + r2.z) + y * (r0.y + r1.x) + z * (r0.z + r2.x) + w * (r1.z - r2.y),
        x * (r0.y + r1.x) - 2.0 * y * (r0.x + r2.z) + z * (r1.z + r2.y) + w * (r2.x - r0.z),
        x * (r0.z + r2.x) + y * (r1.z + r2.y) - 2.0 * z * (r0.x + r1.y) + w * (r0.y - r1.x),
    );
    let v_quat = v_unit - quat * dot(v_unit, quat);

    // T = J W: t_x = fx/z (W_x - u W_z), t_y = fy/z (W_y - v W_z).
    let v_u = -frame.focal.x * inv_z * dot(v_tx, frame.view_z.xyz);
    let v_v = -frame.focal.y * inv_z * dot(v_ty, frame.view_z.xyz);
    var v_centre = vec3<f32>(0.0);
    v_centre.z = -inv_z * (dot(v_tx, p.t_x) + dot(v_ty, p.t_y));
    // u = x/z unless clamped.
    let v_ratio = p.free * vec2<f32>(v_u, v_v);
    v_centre += inv_z * vec3<f32>(v_ratio, -dot(v_ratio, m.xy) * inv_z);
    // mean2d = f x/z + principal point.
    let v_mean2d = frame.focal * g0.xy;
    v_centre += inv_z * vec3<f32>(v_mean2d, -dot(v_mean2d, m.xy) * inv_z);
    // range = |centre|.
    v_centre += (g1.z / length(m)) * m;
    let v_mean = v_centre.x * frame.view_x.xyz + v_centre.y * frame.view_y.xyz + v_centre.z * frame.view_z.xyz;
    return Pulled(v_mean, v_quat, v_log_scale, v_logit);
}
