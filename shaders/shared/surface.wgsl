// A calm water surface: a plane with air and cameras above, water below (WSGS, eq. 7 to 10). Needs frame.
// Mirror: core/src/gpu/layout.rs, `SurfaceUniform`. Twin: core/twins/src/surface.rs

struct Surface {
    // Unit normal towards the air, world axes. A point x lies on the plane if normal.x = offset.
    normal: vec3<f32>,
    offset: f32,
    // Refractive index of air over that of the water.
    eta: f32,
    // 1: Schlick's approximation in place of Fresnel's equations.
    schlick: u32,
    // 1: reflected and refracted light add in sRGB, in place of linear light.
    as_shown: u32,
    // 1: the straight picture lies over that of the water. 0: its masks join them.
    over: u32,
}

// By how much the scene above water covers the water.
fn cover_of(surface: Surface, alpha: f32, mask: f32) -> f32 {
    return select(mask, alpha, surface.over != 0u);
}

// The plane in the camera's frame: normal.x = -height.
struct Level {
    normal: vec3<f32>,
    height: f32,
}

fn level_of(frame: Frame, surface: Surface) -> Level {
    let n = surface.normal;
    return Level(
        vec3<f32>(dot(frame.view_x.xyz, n), dot(frame.view_y.xyz, n), dot(frame.view_z.xyz, n)),
        dot(n, frame.eye) - surface.offset,
    );
}

// Where light from a point below the surface leaves the water on its way to the eye.
struct Crossing {
    // Camera axes.
    at: vec3<f32>,
    // d at = along (slope . d point) + share across (across . d point).
    along: vec3<f32>,
    slope: vec3<f32>,
    across: vec3<f32>,
    share: f32,
    // Below the surface, scene units.
    depth: f32,
}

// Snell's law at the distance r from the foot of the eye, with the point at distance R and depth z:
// r / sqrt(r^2 + h^2) = (1 / eta) (R - r) / sqrt((R - r)^2 + z^2). Eight steps of Newton with a bracket give
// f32 accuracy up to 88 degrees.
fn crossing_of(level: Level, eta: f32, m: vec3<f32>) -> Crossing {
    let n = level.normal;
    let h = level.height;
    let z = -h - dot(n, m);
    let lateral = m - dot(n, m) * n;
    let R = length(lateral);
    let nu = 1.0 / eta;
    let is_below_eye = R < 1e-6 * (h + z);
    // Any direction along the surface serves for a point straight below.
    let any = select(vec3<f32>(1.0, 0.0, 0.0), vec3<f32>(0.0, 1.0, 0.0), abs(n.x) > 0.7);
    let along = select(lateral / R, normalize(any - dot(any, n) * n), is_below_eye);
    let share = nu * h / (z + nu * h);
    var r = share * R;
    var low = 0.0;
    var high = R;
    for (var k = 0u; k < 8u; k++) {
        let left = R - r;
        let air = inverseSqrt(r * r + h * h);
        let water = inverseSqrt(left * left + z * z);
        let f = r * air - nu * left * water;
        low = select(low, r, f < 0.0);
        high = select(high, r, f > 0.0);
        let next = r - f / (h * h * air * air * air + nu * z * z * water * water * water);
        r = select(0.5 * (low + high), next, next >= low && next <= high);
    }
    let left = R - r;
    let air = inverseSqrt(r * r + h * h);
    let water = inverseSqrt(left * left + z * z);
    let by_point = nu * z * water * water * water;
    let by_r = h * h * air * air * air + by_point * z;
    let towards = by_point * z / by_r;
    let by_depth = -by_point * left / by_r;
    return Crossing(r * along - h * n, along, towards * along - by_depth * n, cross(n, along),
        select(r / R, share, is_below_eye), z);
}

// How a crossing moves with its point.
fn moved_crossing(c: Crossing, by: vec3<f32>) -> vec3<f32> {
    return dot(c.slope, by) * c.along + (c.share * dot(c.across, by)) * c.across;
}

// The gradient of the point from that of the crossing.
fn pulled_crossing(c: Crossing, v: vec3<f32>) -> vec3<f32> {
    return dot(c.along, v) * c.slope + (c.share * dot(c.across, v)) * c.across;
}

// Cosine of the refracted ray from that of the ray in air, both with the normal; positive.
fn refracted_cosine(eta: f32, cos_i: f32) -> f32 {
    return sqrt(max(1.0 - eta * eta * (1.0 - cos_i * cos_i), 0.0));
}

// Share of unpolarised light that the surface reflects.
fn fresnel(surface: Surface, cos_i: f32) -> f32 {
    let eta = surface.eta;
    let cos_t = refracted_cosine(eta, cos_i);
    let s = (eta * cos_i - cos_t) / (eta * cos_i + cos_t);
    let p = (eta * cos_t - cos_i) / (eta * cos_t + cos_i);
    let f0 = (eta - 1.0) / (eta + 1.0);
    let grazing = 1.0 - cos_i;
    let two = grazing * grazing;
    let schlick = f0 * f0 + (1.0 - f0 * f0) * two * two * grazing;
    return select(0.5 * (s * s + p * p), schlick, surface.schlick != 0u);
}

// d F / d cos_i.
fn fresnel_slope(surface: Surface, cos_i: f32) -> f32 {
    let eta = surface.eta;
    let cos_t = max(refracted_cosine(eta, cos_i), 1e-6);
    let turn = eta * eta * cos_i / cos_t;
    let s_below = eta * cos_i + cos_t;
    let s = (eta * cos_i - cos_t) / s_below;
    let s_slope = 2.0 * eta * (cos_t - cos_i * turn) / (s_below * s_below);
    let p_below = eta * cos_t + cos_i;
    let p = (eta * cos_t - cos_i) / p_below;
    let p_slope = 2.0 * eta * (turn * cos_i - cos_t) / (p_below * p_below);
    let f0 = (eta - 1.0) / (eta + 1.0);
    let grazing = 1.0 - cos_i;
    let two = grazing * grazing;
    return select(s * s_slope + p * p_slope, -5.0 * (1.0 - f0 * f0) * two * two, surface.schlick != 0u);
}
