// Rays that begin at the eye. Needs frame.

struct Begin {
    on: vec4<f32>,
    starts: vec4<f32>,
}

fn begin_of(column: u32, row: u32) -> Begin {
    let rows = vec4<u32>(row) + vec4<u32>(0u, 1u, 2u, 3u);
    let inside = (rows < vec4<u32>(frame.size.y)) & vec4<bool>(column < frame.size.x);
    return Begin(select(vec4<f32>(0.0), vec4<f32>(1.0), inside), vec4<f32>(NEAR));
}
