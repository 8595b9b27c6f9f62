//! Blending, front to back (3DGS eq. 3), tile by tile and pixel by pixel.
//!
//! Per pixel, over the splats of its tile by depth:
//!
//! ```text
//! sigma = 0.5 (a dx^2 + c dy^2) + b dx dy,   d = mean2d - pixel centre
//! alpha = min(max_alpha, opacity exp(-sigma))
//! C += alpha T c,   R += alpha T range,   T <- T (1 - alpha)
//! ```
//!
//! A splat with alpha < min_alpha is skipped. The pixel stops before a splat that would leave less than
//! `min_transmittance`. Outputs: rgb = C + T background, alpha = 1 - T, range = R.

use super::{RasterRules, Splat, TILE, TileLists};

/// A rendered view. Arrays are row-major from the top left, `width * height` entries.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Raster {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Colour over the background, unclamped.
    pub rgb: Vec<[f64; 3]>,
    /// 1 - T.
    pub alpha: Vec<f64>,
    /// Sum of alpha T range, scene units.
    pub range: Vec<f64>,
    /// T behind the last splat.
    pub transmittance: Vec<f64>,
    /// One past the entry of the tile's list that the pixel blended last; later entries add nothing. 0 where
    /// nothing was blended.
    pub last: Vec<u32>,
}

/// One splat at one pixel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Contribution {
    /// mean2d - pixel centre.
    pub delta: [f64; 2],
    /// exp(-sigma).
    pub falloff: f64,
    /// opacity * falloff, at most `max_alpha`.
    pub alpha: f64,
    /// Whether the cap acts.
    pub capped: bool,
}

/// Blends the splats of `lists` over `background`.
pub fn rasterize_forward(
    splats: &[Option<Splat>],
    lists: &TileLists,
    width: u32,
    height: u32,
    background: [f64; 3],
    rules: &RasterRules,
) -> Raster {
    let pixels = (width * height) as usize;
    let mut raster = Raster {
        width,
        height,
        rgb: vec![[0.0; 3]; pixels],
        alpha: vec![0.0; pixels],
        range: vec![0.0; pixels],
        transmittance: vec![1.0; pixels],
        last: vec![0; pixels],
    };
    for y in 0..height {
        for x in 0..width {
            let (mut rgb, mut range, mut transmittance, mut last) = ([0.0; 3], 0.0, 1.0, 0);
            for (&id, seen) in lists.of_tile(x / TILE, y / TILE).iter().zip(1..) {
                let Some(splat) = &splats[id as usize] else { continue };
                let Some(at) = contribution(splat, x, y, rules) else { continue };
                let next = transmittance * (1.0 - at.alpha);
                if next < rules.min_transmittance {
                    break;
                }
                let weight = at.alpha * transmittance;
                for c in 0..3 {
                    rgb[c] += weight * splat.rgb[c];
                }
                range += weight * splat.range;
                transmittance = next;
                last = seen;
            }
            let pixel = (y * width + x) as usize;
            raster.rgb[pixel] = std::array::from_fn(|c| rgb[c] + transmittance * background[c]);
            raster.alpha[pixel] = 1.0 - transmittance;
            raster.range[pixel] = range;
            raster.transmittance[pixel] = transmittance;
            raster.last[pixel] = last;
        }
    }
    raster
}

/// Contribution of `splat` to pixel (x, y), or `None` where it is skipped.
pub(super) fn contribution(splat: &Splat, x: u32, y: u32, rules: &RasterRules) -> Option<Contribution> {
    let [a, b, c] = splat.conic;
    let delta = [splat.mean2d[0] - (f64::from(x) + 0.5), splat.mean2d[1] - (f64::from(y) + 0.5)];
    let sigma = 0.5 * (a * delta[0] * delta[0] + c * delta[1] * delta[1]) + b * delta[0] * delta[1];
    let falloff = (-sigma).exp();
    let full = splat.opacity * falloff;
    let alpha = full.min(rules.max_alpha);
    (sigma >= 0.0 && alpha >= rules.min_alpha).then_some(Contribution {
        delta,
        falloff,
        alpha,
        capped: full > rules.max_alpha,
    })
}
