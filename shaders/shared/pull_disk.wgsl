// From the gradient of a disk to that of its 2D Gaussian (disk.wgsl), without the colour. Needs frame,
// gaussian, projection, outline, disk and centre_*.wgsl. Twin: core/twins/src/disks.rs

struct Pulled {
    v_mean: vec3<f32>,
    // W.r.t. the quaternion of unit length.
    v_quat: vec4<f32>,
    v_log_scale: vec3<f32>,
    v_logit: f32,
}

// Disks have no third scale. Its place holds the logit of the mask.
const HAS_SCALE: vec3<f32> = vec3<f32>(1.0, 1.0, 0.0);

// Whether no pixel that counts sees the disk.
fn is_untouched(sum: Splat) -> bool {
    return all(sum.e == vec4<f32>(0.0)) && all(sum.d == vec4<f32>(0.0)) && sum.a.z == 0.0;
}

fn colour_gradient(sum: Splat) -> vec3<f32> {
    return sum.e.xyz;
}

// Disks sum absolute values only.
fn centre_gradient(sum: Splat) -> vec2<f32> {
    return vec2<f32>(sum.d.w, 0.0);
}

fn gradient_on_image(sum: Splat) -> f32 {
    return sum.d.w;
}

// A direction of the camera's frame in world axes.
fn in_world(axis: vec3<f32>) -> vec3<f32> {
    return axis.x * frame.view_x.xyz + axis.y * frame.view_y.xyz + axis.z * frame.view_z.xyz;
}

fn pull(sum: Splat, mean: vec3<f32>, quat: vec4<f32>, rot: mat3x3<f32>, scales: vec3<f32>, log_scale: vec3<f32>,
        smoothing: f32, opacity: f32) -> Pulled {
    let u = turned(frame, rot[0]);
    let v = turned(frame, rot[1]);
    let m = to_camera(frame, mean);
    let a_u = u / scales.x;
    let a_v = v / scales.y;
    let h_u = u * scales.x;
    let h_v = v * scales.y;
    let normal = cross(a_u, a_v);

    // u = a_u.p with p = u h_u + v h_v; t = N.m / (N.d).
    let v_normal = -(sum.c.x * h_u + sum.c.y * h_v);
    let v_au = sum.b.x * h_u + sum.b.y * h_v + cross(a_v, v_normal);
    let v_av = sum.b.z * h_u + sum.b.w * h_v + cross(v_normal, a_u);
    let mask = sigmoid(log_scale.z);
    let v_log_scale = vec3<f32>(-dot(v_au, a_u), -dot(v_av, a_v), sum.e.w * mask * (1.0 - mask));

    // The blended normal is the third axis, turned towards the camera.
    let side = select(1.0, -1.0, dot(normal, m) > 0.0);
    let r0 = in_world(v_au) / scales.x;
    let r1 = in_world(v_av) / scales.y;
    let r2 = side * (sum.d.x * rot[0] + sum.d.y * rot[1]);
    // Columns r0, r1, r2 of dL/dR, as in pull_splat.wgsl.
    let w = quat.x; let x = quat.y; let y = quat.z; let z = quat.w;
    let v_unit = 2.0 * vec4<f32>(
        x * (r1.z - r2.y) + y * (r2.x - r0.z) + z * (r0.y - r1.x),
        -2.0 * x * (r1.y + r2.z) + y * (r0.y + r1.x) + z * (r0.z + r2.x) + w * (r1.z - r2.y),
        x * (r0.y + r1.x) - 2.0 * y * (r0.x + r2.z) + z * (r1.z + r2.y) + w * (r2.x - r0.z),
        x * (r0.z + r2.x) + y * (r1.z + r2.y) - 2.0 * z * (r0.x + r1.y) + w * (r0.y - r1.x),
    );

    // p = o + t d - m.
    var v_centre = sum.a.z * normal - sum.a.x * a_u - sum.a.y * a_v;
    v_centre += centre_pulled(m, sum.c.zw, sum.d.z);
    return Pulled(in_world(v_centre), v_unit - quat * dot(v_unit, quat), v_log_scale,
        sum.a.w * opacity * (1.0 - opacity));
}
