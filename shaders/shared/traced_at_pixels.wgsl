// Disks at the eight pixels of a thread, for rays that the water surface refracts. Needs frame, disk, met.
//
//     t = N.(m - o) / N.d,  p = o + t d - m,  u = a_u.p,  v = a_v.p,  N = a_u x a_v,  |d| = 1
//     sigma = min(u^2 + v^2, 2 |centre - pixel|^2) / 2, with the centre where it appears on the image

// [H*W*2] vec4 of surface_rays, in the camera's frame: (o, 1 or 0 for no ray), (d, -).
@group(0) @binding(10) var<storage, read> rays: array<vec4<f32>>;

// The rays of four rows of a column.
struct Rays {
    on: vec4<f32>,
    // As in disk_at_pixels.wgsl.
    starts: vec4<f32>,
    lengths: vec4<f32>,
    pixel_y: vec4<f32>,
    ox: vec4<f32>,
    oy: vec4<f32>,
    oz: vec4<f32>,
    dx: vec4<f32>,
    dy: vec4<f32>,
    dz: vec4<f32>,
}

var<private> pixel_x: f32;
// Rows 0 to 3 and 4 to 7 of the thread.
var<private> rays_a: Rays;
var<private> rays_b: Rays;

struct Ray {
    origin: vec4<f32>,
    direction: vec4<f32>,
}

fn ray_of(column: u32, row: u32) -> Ray {
    if column >= frame.size.x || row >= frame.size.y {
        return Ray(vec4<f32>(0.0), vec4<f32>(0.0, 0.0, 1.0, 0.0));
    }
    let at = 2u * (row * frame.size.x + column);
    return Ray(rays[at], rays[at + 1u]);
}

fn rays_of(column: u32, row: u32) -> Rays {
    let p = ray_of(column, row);
    let q = ray_of(column, row + 1u);
    let r = ray_of(column, row + 2u);
    let s = ray_of(column, row + 3u);
    return Rays(
        vec4<f32>(p.origin.w, q.origin.w, r.origin.w, s.origin.w),
        vec4<f32>(0.0),
        vec4<f32>(1.0),
        vec4<f32>(f32(row)) + vec4<f32>(0.5, 1.5, 2.5, 3.5),
        vec4<f32>(p.origin.x, q.origin.x, r.origin.x, s.origin.x),
        vec4<f32>(p.origin.y, q.origin.y, r.origin.y, s.origin.y),
        vec4<f32>(p.origin.z, q.origin.z, r.origin.z, s.origin.z),
        vec4<f32>(p.direction.x, q.direction.x, r.direction.x, s.direction.x),
        vec4<f32>(p.direction.y, q.direction.y, r.direction.y, s.direction.y),
        vec4<f32>(p.direction.z, q.direction.z, r.direction.z, s.direction.z),
    );
}

fn begin_rays(column: u32, row: u32) {
    pixel_x = f32(column) + 0.5;
    rays_a = rays_of(column, row);
    rays_b = rays_of(column, row + 4u);
}

struct Plane {
    normal: vec3<f32>,
}

fn plane_of(disk: Splat) -> Plane {
    return Plane(cross(disk.b.xyz, disk.c.xyz));
}

fn meet(disk: Splat, plane: Plane, rays: Rays) -> Met {
    let n = plane.normal;
    let slope = n.x * rays.dx + n.y * rays.dy + n.z * rays.dz;
    let per_slope = 1.0 / select(slope, vec4<f32>(1e-30), abs(slope) < vec4<f32>(1e-30));
    let ox = rays.ox - disk.a.x;
    let oy = rays.oy - disk.a.y;
    let oz = rays.oz - disk.a.z;
    let t = -(n.x * ox + n.y * oy + n.z * oz) * per_slope;
    let along_u = disk.b.x * rays.dx + disk.b.y * rays.dy + disk.b.z * rays.dz;
    let along_v = disk.c.x * rays.dx + disk.c.y * rays.dy + disk.c.z * rays.dz;
    let u = t * along_u + (disk.b.x * ox + disk.b.y * oy + disk.b.z * oz);
    let v = t * along_v + (disk.c.x * ox + disk.c.y * oy + disk.c.z * oz);
    return met_of(disk, u, v, t, t > rays.starts, per_slope, along_u, along_v, rays.oz + t * rays.dz, rays.lengths,
        rays.pixel_y);
}
