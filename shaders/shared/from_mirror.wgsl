// Rays that begin where the water surface reflects them, on lines through the eye of the mirrored camera.
// Needs frame.

// [H*W*2] vec4 of surface_rays, in the frame of the mirrored camera: (o, 1 or 0 for no ray), (d, -).
@group(0) @binding(10) var<storage, read> rays: array<vec4<f32>>;

struct Begin {
    on: vec4<f32>,
    starts: vec4<f32>,
}

// The ray has z = 1, so that its t at the origin is the origin's depth.
fn depth_and_on(column: u32, row: u32) -> vec2<f32> {
    if column >= frame.size.x || row >= frame.size.y {
        return vec2<f32>(0.0);
    }
    return rays[2u * (row * frame.size.x + column)].zw;
}

fn begin_of(column: u32, row: u32) -> Begin {
    let p = depth_and_on(column, row);
    let q = depth_and_on(column, row + 1u);
    let r = depth_and_on(column, row + 2u);
    let s = depth_and_on(column, row + 3u);
    return Begin(vec4<f32>(p.y, q.y, r.y, s.y), vec4<f32>(p.x, q.x, r.x, s.x));
}
