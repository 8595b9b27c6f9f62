//! The position of each pixel's surface on the plane, and the zones that follow from it.

use glam::{DQuat, DVec2};
use rayon::prelude::*;

use super::{Line, SeamLines, SeenView};
use crate::views::PackedImage;

/// Pixels with less alpha have no surface.
pub const SURFACE_ALPHA: f32 = 0.5;

/// Distance in bands that a flank reaches from a line. Along a straight line it has twice the area of the
/// band.
const FLANK: f64 = 3.0;
/// The middle of a flank, in bands.
pub const BESIDE: f64 = 2.0;

/// The zones of a pixel: any of the sets below, or none if it shows no surface or the mask leaves it out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Zones(u8);

impl Zones {
    /// The pixel shows no surface, or the mask leaves it out.
    pub const NOTHING: Self = Self(0);
    /// Within the band of a border; excludes all other zones.
    pub const BORDER: Self = Self(1);
    /// Outside the bands of all borders.
    pub const INTERIOR: Self = Self(2);
    /// In the interior, up to three bands from a border.
    pub const BORDER_FLANK: Self = Self(4);
    /// In the interior, within the band of a control line.
    pub const CONTROL: Self = Self(8);
    /// In the interior, outside that band and up to three bands from a control line.
    pub const CONTROL_FLANK: Self = Self(16);

    /// Whether the pixel is in the zone `one`.
    pub fn are(self, one: Self) -> bool {
        self.0 & one.0 != 0
    }

    fn with(self, one: Self, holds: bool) -> Self {
        if holds { Self(self.0 | one.0) } else { self }
    }
}

/// The surfaces of a view, `[H*W]`; NaN for pixels without one.
pub struct Surfaces {
    pub width: usize,
    /// Aligned x and z.
    pub plane: Vec<DVec2>,
    /// 1 / depth along the camera's axis, 1/scene unit; linear over the pixels of any plane.
    pub inverse_depth: Vec<f64>,
}

impl Surfaces {
    /// The surfaces of the pixels that `truth`'s mask counts.
    pub fn of(view: &SeenView<'_>, truth: &PackedImage, world_to_aligned: DQuat) -> Self {
        let (camera, width) = (view.camera, view.camera.width as usize);
        let to_aligned = world_to_aligned * view.pose.rotation.inverse();
        let centre = world_to_aligned * view.pose.centre();
        let surface = |index: usize| {
            let (alpha, range) = (view.alpha[index], view.range[index]);
            if !(alpha >= SURFACE_ALPHA && range > 0.0) || truth.pixels[index].to_le_bytes()[3] != 255 {
                return (DVec2::NAN, f64::NAN);
            }
            let ray = camera.direction(index);
            let range = f64::from(range / alpha);
            let point = centre + to_aligned * ray * range;
            (DVec2::new(point.x, point.z), (range * ray.z).recip())
        };
        let (plane, inverse_depth) = (0..view.alpha.len()).into_par_iter().map(surface).unzip();
        Self { width, plane, inverse_depth }
    }

    /// The zones of each pixel.
    pub fn zones(&self, lines: &SeamLines) -> Vec<Zones> {
        let (band, flank) = (lines.band, FLANK * lines.band);
        let (borders, controls) = (self.near(&lines.borders, flank), self.near(&lines.controls, flank));
        let distance = |lines: &[Line], point: DVec2| {
            lines.iter().map(|line| line.distance(point)).fold(f64::INFINITY, f64::min)
        };
        let zones = |&point: &DVec2| {
            if !point.is_finite() {
                return Zones::NOTHING;
            }
            let to_border = distance(&borders, point);
            if to_border <= band {
                return Zones::BORDER;
            }
            let to_control = distance(&controls, point);
            Zones::INTERIOR
                .with(Zones::BORDER_FLANK, to_border <= flank)
                .with(Zones::CONTROL, to_control <= band)
                .with(Zones::CONTROL_FLANK, to_control > band && to_control <= flank)
        };
        self.plane.par_iter().map(zones).collect()
    }

    /// The lines that can be within `band` of a surface. A view sees only few of the hundreds in a large
    /// plan.
    pub fn near(&self, lines: &[Line], band: f64) -> Vec<Line> {
        let seen = self.plane.iter().filter(|point| point.is_finite());
        let (low, high) =
            seen.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), &p| (low.min(p), high.max(p)));
        let reaches = |line: &&Line| {
            let ((low_across, low_along), (high_across, high_along)) = (line.split(low), line.split(high));
            (low_across - band..=high_across + band).contains(&line.at)
                && line.from <= high_along + band
                && line.to >= low_along - band
        };
        lines.iter().filter(reaches).copied().collect()
    }
}
