// Disks at the eight pixels of a thread (Huang et al. 2024), for rays along lines through the eye.
// Needs frame, disk, met, and where the rays begin (from_eye.wgsl, from_mirror.wgsl).
//
//     t = N.m / N.d,  p = t d - m,  u = a_u.p,  v = a_v.p,  N = a_u x a_v,  d the ray of the pixel with z = 1
//     sigma = min(u^2 + v^2, |centre - pixel|^2 / DISK_BLUR) / 2
// A ray that meets the plane before it begins, or not at all, sees only the second term: the low-pass.

// The rays of four rows of a column.
struct Rays {
    // 1 or 0 for no ray.
    on: vec4<f32>,
    // A ray meets nothing before this t.
    starts: vec4<f32>,
    pixel_y: vec4<f32>,
    y: vec4<f32>,
    lengths: vec4<f32>,
}

var<private> pixel_x: f32;
var<private> ray_x: f32;
// Rows 0 to 3 and 4 to 7 of the thread.
var<private> rays_a: Rays;
var<private> rays_b: Rays;

fn rays_of(column: u32, row: u32) -> Rays {
    let pixel_y = vec4<f32>(f32(row)) + vec4<f32>(0.5, 1.5, 2.5, 3.5);
    let y = (pixel_y - frame.principal.y) / frame.focal.y;
    let begin = begin_of(column, row);
    return Rays(begin.on, begin.starts, pixel_y, y, sqrt(1.0 + ray_x * ray_x + y * y));
}

fn begin_rays(column: u32, row: u32) {
    pixel_x = f32(column) + 0.5;
    ray_x = (pixel_x - frame.principal.x) / frame.focal.x;
    rays_a = rays_of(column, row);
    rays_b = rays_of(column, row + 4u);
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

fn meet(disk: Splat, plane: Plane, rays: Rays) -> Met {
    let slope = plane.along.x + plane.normal.y * rays.y;
    let per_slope = 1.0 / select(slope, vec4<f32>(1e-30), abs(slope) < vec4<f32>(1e-30));
    let t = plane.at_centre.x * per_slope;
    let along_u = plane.along.y + disk.b.y * rays.y;
    let along_v = plane.along.z + disk.c.y * rays.y;
    let u = t * along_u - plane.at_centre.y;
    let v = t * along_v - plane.at_centre.z;
    return met_of(disk, u, v, t, t > rays.starts, per_slope, along_u, along_v, t, rays.lengths, rays.pixel_y);
}
