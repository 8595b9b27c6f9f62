// Real spherical harmonics to degree 3 and their gradient, as in 3DGS (Ramamoorthi and Hanrahan 2001).

const SH_C0: f32 = 0.28209479177387814;
const SH_C1: f32 = 0.4886025119029199;
const SH_C2_0: f32 = 1.0925484305920792;
const SH_C2_2: f32 = 0.31539156525252005;
const SH_C2_4: f32 = 0.5462742152960396;
const SH_C3_0: f32 = 0.5900435899266435;
const SH_C3_1: f32 = 2.890611442640554;
const SH_C3_2: f32 = 0.4570457994644658;
const SH_C3_3: f32 = 0.3731763325901154;
const SH_C3_5: f32 = 1.445305721320277;

// Sixteen values in four vectors; those above `degree` are 0.
struct Basis {
    b0: vec4<f32>,
    b1: vec4<f32>,
    b2: vec4<f32>,
    b3: vec4<f32>,
}

fn basis(degree: u32, d: vec3<f32>) -> Basis {
    var b = Basis(vec4<f32>(SH_C0, 0.0, 0.0, 0.0), vec4<f32>(0.0), vec4<f32>(0.0), vec4<f32>(0.0));
    if degree < 1u { return b; }
    let x = d.x; let y = d.y; let z = d.z;
    b.b0 = vec4<f32>(SH_C0, -SH_C1 * y, SH_C1 * z, -SH_C1 * x);
    if degree < 2u { return b; }
    let xx = x * x; let yy = y * y; let zz = z * z;
    b.b1 = vec4<f32>(SH_C2_0 * x * y, -SH_C2_0 * y * z, SH_C2_2 * (2.0 * zz - xx - yy), -SH_C2_0 * x * z);
    b.b2.x = SH_C2_4 * (xx - yy);
    if degree < 3u { return b; }
    b.b2.y = -SH_C3_0 * y * (3.0 * xx - yy);
    b.b2.z = SH_C3_1 * x * y * z;
    b.b2.w = -SH_C3_2 * y * (4.0 * zz - xx - yy);
    b.b3 = vec4<f32>(
        SH_C3_3 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -SH_C3_2 * x * (4.0 * zz - xx - yy),
        SH_C3_5 * z * (xx - yy),
        -SH_C3_0 * x * (xx - 3.0 * yy),
    );
    return b;
}

// Sum over k of weight_k * gradient of basis k with respect to the direction.
fn basis_gradient(degree: u32, d: vec3<f32>, w: Basis) -> vec3<f32> {
    var g = vec3<f32>(0.0);
    if degree < 1u { return g; }
    let x = d.x; let y = d.y; let z = d.z;
    g = SH_C1 * vec3<f32>(-w.b0.w, -w.b0.y, w.b0.z);
    if degree < 2u { return g; }
    g += (SH_C2_0 * w.b1.x) * vec3<f32>(y, x, 0.0);
    g += (-SH_C2_0 * w.b1.y) * vec3<f32>(0.0, z, y);
    g += (SH_C2_2 * w.b1.z) * vec3<f32>(-2.0 * x, -2.0 * y, 4.0 * z);
    g += (-SH_C2_0 * w.b1.w) * vec3<f32>(z, 0.0, x);
    g += (SH_C2_4 * w.b2.x) * vec3<f32>(2.0 * x, -2.0 * y, 0.0);
    if degree < 3u { return g; }
    let xx = x * x; let yy = y * y; let zz = z * z;
    g += (-SH_C3_0 * w.b2.y) * vec3<f32>(6.0 * x * y, 3.0 * (xx - yy), 0.0);
    g += (SH_C3_1 * w.b2.z) * vec3<f32>(y * z, x * z, x * y);
    g += (-SH_C3_2 * w.b2.w) * vec3<f32>(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z);
    g += (SH_C3_3 * w.b3.x) * vec3<f32>(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy);
    g += (-SH_C3_2 * w.b3.y) * vec3<f32>(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z);
    g += (SH_C3_5 * w.b3.z) * vec3<f32>(2.0 * x * z, -2.0 * y * z, xx - yy);
    g += (-SH_C3_0 * w.b3.w) * vec3<f32>(3.0 * (xx - yy), -6.0 * x * y, 0.0);
    return g;
}

fn basis_vec(b: Basis, i: u32) -> vec4<f32> {
    switch i {
        case 0u: { return b.b0; }
        case 1u: { return b.b1; }
        case 2u: { return b.b2; }
        default: { return b.b3; }
    }
}

// Groups of four coefficients (three vec4 of memory) that a degree uses: 1, 1, 3, 4.
fn coefficient_groups(degree: u32) -> u32 {
    return select(select(4u, 3u, degree == 2u), 1u, degree < 2u);
}
