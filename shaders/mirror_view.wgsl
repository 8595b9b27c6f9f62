//@ import frame, surface
// Turns the view of a camera into that of its mirror image behind the water surface: reflected rays are those
// of the mirrored eye (WSGS, eq. 8).
//
//   view  Frame, in place: x -> R (x - 2 (n.x - o) n) + t in place of x -> R x + t
// One thread. The plane is known to the device only. Twin: core/twins/src/surface.rs

@group(0) @binding(0) var<uniform> surface: Surface;
@group(0) @binding(1) var<storage, read_write> view: Frame;

fn mirrored(row: vec4<f32>) -> vec4<f32> {
    let along = dot(row.xyz, surface.normal);
    return vec4<f32>(row.xyz - 2.0 * along * surface.normal, row.w + 2.0 * along * surface.offset);
}

@compute @workgroup_size(1)
fn main() {
    view.view_x = mirrored(view.view_x);
    view.view_y = mirrored(view.view_y);
    view.view_z = mirrored(view.view_z);
    view.eye -= 2.0 * (dot(surface.normal, view.eye) - surface.offset) * surface.normal;
}
