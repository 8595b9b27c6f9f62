// A disk at the eight pixels of a thread (Huang et al. 2024). Needs frame, disk.
//
//     t = N.m / N.d,  p = t d - m,  u = a_u.p,  v = a_v.p,  N = a_u x a_v,  d the ray of the pixel with z = 1
//     sigma = min(u^2 + v^2, 2 |centre - pixel|^2) / 2
// A ray that meets the plane nearer than NEAR, or not at all, sees only the second term: the low-pass.

// The rays of the thread's pixels: x of one column, y and lengths of rows 0 to 3 in _a, of 4 to 7 in _b.
var<private> pixel_x: f32;
var<private> pixel_y_a: vec4<f32>;
var<private> pixel_y_b: vec4<f32>;
var<private> ray_x: f32;
var<private> ray_y_a: vec4<f32>;
var<private> ray_y_b: vec4<f32>;
var<private> ray_length_a: vec4<f32>;
var<private> ray_length_b: vec4<f32>;

fn begin_rays(column: u32, row: u32) {
    pixel_x = f32(column) + 0.5;
    pixel_y_a = vec4<f32>(f32(row)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    pixel_y_b = pixel_y_a + 4.0;
    ray_x = (pixel_x - frame.principal.x) / frame.focal.x;
    ray_y_a = (pixel_y_a - frame.principal.y) / frame.focal.y;
    ray_y_b = (pixel_y_b - frame.principal.y) / frame.focal.y;
    let flat = 1.0 + ray_x * ray_x;
    ray_length_a = sqrt(flat + ray_y_a * ray_y_a);
    ray_length_b = sqrt(flat + ray_y_b * ray_y_b);
}

// What is the same at all pixels of a column.
struct Plane {
    normal: vec3<f32>,
    // N.m, a_u.m, a_v.m
    at_centre: vec3<f32>,
    // N.d, a_u.d, a_v.d without the part of the row.
    along: vec3<f32>,
}

fn plane_of(disk: Splat) -> Plane {
    let normal = cross(disk.b.xyz, disk.c.xyz);
    let m = disk.a.xyz;
    let column = vec3<f32>(ray_x, 0.0, 1.0);
    return Plane(
        normal,
        vec3<f32>(dot(normal, m), dot(disk.b.xyz, m), dot(disk.c.xyz, m)),
        vec3<f32>(dot(normal, column), dot(disk.b.xyz, column), dot(disk.c.xyz, column)),
    );
}

// A disk at four pixels.
struct Met {
    // Zeros where the low-pass decides.
    u: vec4<f32>,
    v: vec4<f32>,
    t: vec4<f32>,
    // N.d, never 0.
    steep: vec4<f32>,
    // Twice sigma.
    spread: vec4<f32>,
    is_hit: vec4<bool>,
    // From the pixel to the projected centre.
    dx: f32,
    dy: vec4<f32>,
}

fn meet(disk: Splat, plane: Plane, ray_y: vec4<f32>, pixel_y: vec4<f32>) -> Met {
    let slope = plane.along.x + plane.normal.y * ray_y;
    let steep = select(slope, vec4<f32>(1e-30), abs(slope) < vec4<f32>(1e-30));
    let t = plane.at_centre.x / steep;
    let u = t * (plane.along.y + disk.b.y * ray_y) - plane.at_centre.y;
    let v = t * (plane.along.z + disk.c.y * ray_y) - plane.at_centre.z;
    let solid = u * u + v * v;
    let dx = disk.a.w - pixel_x;
    let dy = disk.b.w - pixel_y;
    let thin = 2.0 * (dx * dx + dy * dy);
    // False for numbers that are not finite.
    let is_hit = (t > vec4<f32>(NEAR)) & (solid <= thin);
    let zero = vec4<f32>(0.0);
    return Met(select(zero, u, is_hit), select(zero, v, is_hit), select(zero, t, is_hit), steep,
        select(thin, solid, is_hit), is_hit, dx, dy);
}
