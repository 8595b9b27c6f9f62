// Whether a view may see Gaussians of a chunk. Needs the name frame.

// The maximum of a . m + c over the box, with slack for rounding.
fn greatest(a: vec3<f32>, c: f32, centre: vec3<f32>, half_sides: vec3<f32>) -> f32 {
    let size = dot(abs(a), abs(centre) + half_sides) + abs(c);
    return dot(a, centre) + c + dot(abs(a), half_sides) + 1e-5 * size;
}

fn may_hold_seen(centre: vec3<f32>, half_sides: vec3<f32>, reach: f32) -> bool {
    let most = max(abs(frame.ratio_min), abs(frame.ratio_max));
    let spread = 1.02 * sqrt(1.0 + dot(most, most)) * reach;
    // sqrt(2 ln 255) standard deviations of the low-pass.
    let pad = 3.4 * sqrt(BLUR) + 0.6;
    let x = frame.view_x;
    let y = frame.view_y;
    let z = frame.view_z;
    // Distance of the principal point from the edges, pixels.
    let before = frame.principal - frame.rect_min + pad;
    let behind = frame.rect_max - frame.principal + pad;
    let f = frame.focal;
    return greatest(z.xyz, z.w - NEAR, centre, half_sides) > 0.0
        && greatest(f.x * x.xyz + before.x * z.xyz, f.x * (x.w + spread) + before.x * z.w, centre, half_sides) > 0.0
        && greatest(f.y * y.xyz + before.y * z.xyz, f.y * (y.w + spread) + before.y * z.w, centre, half_sides) > 0.0
        && greatest(behind.x * z.xyz - f.x * x.xyz, f.x * (spread - x.w) + behind.x * z.w, centre, half_sides) > 0.0
        && greatest(behind.y * z.xyz - f.y * y.xyz, f.y * (spread - y.w) + behind.y * z.w, centre, half_sides) > 0.0;
}
