// A disk at four pixels of a column. Needs disk; the rays are those of *_at_pixels.wgsl.

struct Met {
    // Zeros where the low-pass decides.
    u: vec4<f32>,
    v: vec4<f32>,
    t: vec4<f32>,
    // 1 / N.d, finite; a_u.d and a_v.d.
    per_slope: vec4<f32>,
    along_u: vec4<f32>,
    along_v: vec4<f32>,
    // Twice sigma.
    spread: vec4<f32>,
    is_hit: vec4<bool>,
    // Distance along the axis of the camera, for gradients on the image.
    far: vec4<f32>,
    // Of the rays' directions.
    lengths: vec4<f32>,
    // From the pixel to the projected centre.
    dx: f32,
    dy: vec4<f32>,
}

fn met_of(disk: Splat, u: vec4<f32>, v: vec4<f32>, t: vec4<f32>, is_ahead: vec4<bool>, per_slope: vec4<f32>,
        along_u: vec4<f32>, along_v: vec4<f32>, far: vec4<f32>, lengths: vec4<f32>, pixel_y: vec4<f32>) -> Met {
    let solid = u * u + v * v;
    let dx = disk.a.w - pixel_x;
    let dy = disk.b.w - pixel_y;
    let thin = (1.0 / DISK_BLUR) * (dx * dx + dy * dy);
    // False for numbers that are not finite.
    let is_hit = is_ahead & (solid <= thin);
    let zero = vec4<f32>(0.0);
    return Met(select(zero, u, is_hit), select(zero, v, is_hit), select(zero, t, is_hit), per_slope, along_u, along_v,
        select(thin, solid, is_hit), is_hit, select(zero, far, is_hit), lengths, dx, dy);
}
