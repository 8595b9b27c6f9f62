// What the backward pass of disks adds up for each ray: the gradients of its origin and its direction. Needs
// disk, met and rays.
//
// p = o + t d - m and t = N.(m - o) / N.d, so that the gradient of o is v_u a_u + v_v a_v - turn N, with turn
// = (v_u a_u + v_v a_v).d / N.d, and that of d is t times as much, with t from o
// on along the unit ray d. The low-pass has no part in it.

// [H*W*2] vec4: gradient of the origin, gradient of the direction.
@group(0) @binding(9) var<storage, read_write> v_rays: array<vec4<f32>>;

struct Noted {
    ox: vec4<f32>,
    oy: vec4<f32>,
    oz: vec4<f32>,
    dx: vec4<f32>,
    dy: vec4<f32>,
    dz: vec4<f32>,
}

fn note(noted: ptr<private, Noted>, disk: Splat, plane: Plane, met: Met, rays: Rays, v_u: vec4<f32>,
        v_v: vec4<f32>, turn: vec4<f32>) {
    let x = v_u * disk.b.x + v_v * disk.c.x - turn * plane.normal.x;
    let y = v_u * disk.b.y + v_v * disk.c.y - turn * plane.normal.y;
    let z = v_u * disk.b.z + v_v * disk.c.z - turn * plane.normal.z;
    let t = (met.t - rays.starts) * rays.lengths;
    (*noted).ox += x;
    (*noted).oy += y;
    (*noted).oz += z;
    (*noted).dx += t * x;
    (*noted).dy += t * y;
    (*noted).dz += t * z;
}

fn store_ray(column: u32, row: u32, origin: vec3<f32>, direction: vec3<f32>) {
    if column < frame.size.x && row < frame.size.y {
        let at = 2u * (row * frame.size.x + column);
        v_rays[at] = vec4<f32>(origin, 0.0);
        v_rays[at + 1u] = vec4<f32>(direction, 0.0);
    }
}

fn store_noted(column: u32, row: u32, v: Noted) {
    store_ray(column, row, vec3<f32>(v.ox.x, v.oy.x, v.oz.x), vec3<f32>(v.dx.x, v.dy.x, v.dz.x));
    store_ray(column, row + 1u, vec3<f32>(v.ox.y, v.oy.y, v.oz.y), vec3<f32>(v.dx.y, v.dy.y, v.dz.y));
    store_ray(column, row + 2u, vec3<f32>(v.ox.z, v.oy.z, v.oz.z), vec3<f32>(v.dx.z, v.dy.z, v.dz.z));
    store_ray(column, row + 3u, vec3<f32>(v.ox.w, v.oy.w, v.oz.w), vec3<f32>(v.dx.w, v.dy.w, v.dz.w));
}
