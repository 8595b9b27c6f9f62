// Which tiles a splat touches: first its bounding box, then the exact test of ellipse against tile. Needs
// frame.wgsl.

struct Splat2d {
    mean: vec2<f32>,
    // a, b, c: sigma(d) = 0.5 (a dx^2 + c dy^2) + b dx dy.
    conic: vec3<f32>,
    extent: f32,
}

// Tiles [x0, y0, x1, y1) of the bounding box of sigma <= extent, clamped to the rectangle of the band. Empty
// for extent < 0.
fn tile_box(frame: Frame, s: Splat2d) -> vec4<u32> {
    if !(s.extent >= 0.0) {
        return vec4<u32>(0u);
    }
    // The covariance from the conic: xx = c / det, yy = a / det.
    let det = s.conic.x * s.conic.z - s.conic.y * s.conic.y;
    let half_size = sqrt(2.0 * s.extent * vec2<f32>(s.conic.z, s.conic.x) / det);
    // Pixel i has its centre at i + 0.5. A slack of 1e-3 pixels keeps rounding from dropping a tile.
    let lo = floor((s.mean - half_size - 0.501) / f32(TILE));
    let hi = floor((s.mean + half_size - 0.499) / f32(TILE)) + 1.0;
    let least = floor(frame.rect_min / f32(TILE));
    let most = ceil(frame.rect_max / f32(TILE));
    return vec4<u32>(vec2<u32>(clamp(lo, least, most)), vec2<u32>(clamp(hi, least, most)));
}

// Whether a tile belongs to the band of this pass.
fn in_band(frame: Frame, tile: vec2<u32>) -> bool {
    let t = tile.y * frame.tiles.x + tile.x;
    return t >= frame.first_tile && t < frame.end_tile;
}

fn sigma_at(s: Splat2d, d: vec2<f32>) -> f32 {
    return 0.5 * (s.conic.x * d.x * d.x + s.conic.z * d.y * d.y) + s.conic.y * d.x * d.y;
}

// Whether sigma <= extent anywhere on the rectangle of the tile's pixel centres.
//
// sigma is convex: its minimum is at the splat's centre if that lies inside, else on an edge facing the
// centre.
fn touches(s: Splat2d, tile: vec2<u32>) -> bool {
    let lo = vec2<f32>(tile * TILE) + 0.5 - s.mean;
    let hi = lo + f32(TILE - 1u);
    let near = clamp(vec2<f32>(0.0), lo, hi);
    if all(near == vec2<f32>(0.0)) {
        return true;
    }
    var least = 3.4e38;
    if near.x != 0.0 {
        let y = clamp(-s.conic.y / s.conic.z * near.x, lo.y, hi.y);
        least = sigma_at(s, vec2<f32>(near.x, y));
    }
    if near.y != 0.0 {
        let x = clamp(-s.conic.y / s.conic.x * near.y, lo.x, hi.x);
        least = min(least, sigma_at(s, vec2<f32>(x, near.y)));
    }
    // A relative slack of 1e-4: the rasteriser applies the cutoff itself.
    return least <= s.extent * 1.0001 + 1e-4;
}
