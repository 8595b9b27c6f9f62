// Adam's moments in f32, one pair per parameter: 96 bytes for the transform, and 32 bytes per vec4 of
// coefficients. Needs adam.wgsl.
//
//   moments     [N*6]  vec4: first, then second moments of the transform
//   sh_moments  [N*S*2] vec4: first and second moment of each vec4 of sh_coeffs, one after the other. They
//               share one array, since some adapters allow a kernel only 10 storage buffers

@group(0) @binding(10) var<storage, read_write> moments: array<vec4<f32>>;
@group(0) @binding(11) var<storage, read_write> sh_moments: array<vec4<f32>>;

// Whether raw gradients are stored instead of first moments, and no step is taken (tests).
fn keeps_gradients() -> bool {
    return veiled(step.gradients_only, arrayLength(&moments)) != 0u;
}

fn keep_gradients(i: u32, d0: vec4<f32>, d1: vec4<f32>, d2: vec4<f32>) {
    moments[6u * i] = d0;
    moments[6u * i + 1u] = d1;
    moments[6u * i + 2u] = d2;
}

fn keep_colour_gradient(n: u32, gradient: vec4<f32>) {
    sh_moments[2u * n] = gradient;
}

// Called before and after the coefficients of a Gaussian; nothing to do here.
fn begin_colour(i: u32, v_rgb: vec3<f32>, most: f32, pace: Pace) {}
fn end_colour(i: u32) {}

// The step to subtract from vec4 n of the coefficients; `part` (0, 1, 2) says which channels it holds.
fn colour_step(n: u32, part: u32, gradient: vec4<f32>, rate: vec4<f32>, pace: Pace) -> vec4<f32> {
    let m = moved(BETA1, old(sh_moments[2u * n], pace), gradient);
    let v = moved(BETA2, old(sh_moments[2u * n + 1u], pace), gradient * gradient);
    sh_moments[2u * n] = m;
    sh_moments[2u * n + 1u] = v;
    return rate * (m * pace.unbias.x) / (sqrt(v * pace.unbias.y) + EPSILON);
}

// The step to subtract from vec4 `part` of the transform.
fn transform_step(i: u32, part: u32, gradient: vec4<f32>, rate: vec4<f32>, pace: Pace) -> vec4<f32> {
    let n = 6u * i + part;
    let m = moved(BETA1, old(moments[n], pace), gradient);
    let v = moved(BETA2, old(moments[n + 3u], pace), gradient * gradient);
    moments[n] = m;
    moments[n + 3u] = v;
    return rate * (m * pace.unbias.x) / (sqrt(v * pace.unbias.y) + EPSILON);
}
