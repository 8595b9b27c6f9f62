//! Seams: whether the borders of partitions are visible in a model.
//!
//! Partitions are trained separately, so a merged model can be worse along the borders of their cells, and
//! its surface can have a step there. Both are measured on held-out views. The position of a pixel's surface
//! on the x-z plane of the aligned frame decides which zones the pixel belongs to:
//!
//! - the *border*, if the surface is within the band of a border between two cells, otherwise the *interior*;
//! - the *flank* of the border, if it is in the interior and within three bands of a border;
//! - the *control* and its flank, if the same holds for a control line through the middle of a cell;
//! - no zone, in open water, in sky and where the mask of the photograph leaves a pixel out.
//!
//! Borders and interior show different content, which the partitioning does not cause: a wreck on a border is
//! harder to learn than sand. The flank shows the same content as the border, but lies outside the region
//! that partitioning affects. The loss of the border's band against its flank is therefore the seam
//! ([`SeamReport::seam_db`]). The same difference along control lines, where nothing was cut, shows the
//! effect of content alone. `steps` does the same for the surface, `picture` shows both.
//!
//! Surfaces are those of the measured model itself: its expected range, range / alpha, where alpha is at
//! least [`SURFACE_ALPHA`], rendered from [`Gaussians::surfaces`](crate::gaussians::Gaussians::surfaces).
//! That excludes haze, which would move surfaces towards the camera. The water plays no part: it changes
//! colours but not alpha or range, whether it acts on Gaussians or on pixels.
//!
//! No GPU here: a caller renders. Sums run in the order of pixels and views, so results do not depend on
//! threads.

mod picture;
mod report;
mod steps;
mod surfaces;

use glam::{DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::config::SeamsConfig;
use crate::metrics::SsimMap;
use crate::scene::{PinholeCamera, Pose};
use crate::views::PackedImage;

pub use report::{BandReport, InteriorReport, RangeSteps, SeamReport, SeamSums, Steps, ViewSeams, put_into};
use report::{StepList, Sums};
use steps::{StepsOf, steps};
pub use surfaces::SURFACE_ALPHA;
use surfaces::{BESIDE, Surfaces, Zones};

/// The description of these measures in `metrics.json`.
pub const PROTOCOL: &str = "border: pixels whose surface (expected range of the model without haze, alpha 0.5 and more, not \
     masked) lies on the horizontal plane within seams.band of a border between cells; interior: surfaces further away; flank: interior within \
     three bands; control and its flank: the same at lines through the middle of cells, where nothing was cut, within the interior. \
     border_psnr, border_ssim, control_psnr, control_ssim: means over the views whose band and flank each have \
     seams.least_share of the picture; interior_psnr, interior_ssim: the interior in the views of border_psnr; SSIM is the \
     mean of its map. seam_db: mean of flank - border. range_step: median \
     over neighbouring pixels on two sides of a line of |difference| / mean of the depths that lines through 4 pixels \
     of inverse depth on either side, 2 pixels from the line on, predict for it; beside: the same 2 bands from the line";

/// A straight piece of a border on the aligned x-z plane, along one axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// The axis whose coordinate is constant along the line.
    pub axis: Axis,
    /// That coordinate, scene units.
    pub at: f64,
    /// Start on the other axis; minus infinity for unbounded cells.
    pub from: f64,
    /// End on the other axis, above `from`.
    pub to: f64,
}

/// A horizontal axis of the aligned frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Axis {
    /// Aligned x.
    X,
    /// Aligned z.
    Z,
}

impl Axis {
    /// The other horizontal axis.
    pub fn across(self) -> Self {
        match self {
            Self::X => Self::Z,
            Self::Z => Self::X,
        }
    }

    /// Coordinate of an aligned point.
    pub fn of(self, aligned: DVec3) -> f64 {
        match self {
            Self::X => aligned.x,
            Self::Z => aligned.z,
        }
    }
}

impl Line {
    /// The coordinates of a point across the line and along it.
    fn split(&self, point: DVec2) -> (f64, f64) {
        match self.axis {
            Axis::X => (point.x, point.y),
            Axis::Z => (point.y, point.x),
        }
    }

    /// Distance to a point (x, z), scene units; NaN for NaN.
    pub fn distance(&self, point: DVec2) -> f64 {
        let (across, along) = self.split(point);
        (across - self.at).hypot((self.from - along).max(along - self.to).max(0.0))
    }

    /// Whether a point lies beyond the line. A point on the line belongs to the lower side, because cells are
    /// (lo, hi].
    pub fn is_beyond(&self, point: DVec2) -> bool {
        self.split(point).0 > self.at
    }

    /// Whether the segment between two finite points crosses the line.
    pub fn is_crossed(&self, a: DVec2, b: DVec2) -> bool {
        if self.is_beyond(a) == self.is_beyond(b) {
            return false;
        }
        let ((across_a, along_a), (across_b, along_b)) = (self.split(a), self.split(b));
        let along = along_a + (along_b - along_a) * (self.at - across_a) / (across_b - across_a);
        along > self.from && along <= self.to
    }
}

/// The borders of a scene's partitions.
#[derive(Clone, Debug, PartialEq)]
pub struct SeamLines {
    /// From world axes to the aligned frame.
    pub world_to_aligned: DQuat,
    /// Borders between cells; at least one.
    pub borders: Vec<Line>,
    /// Lines through the middle of cells; may be none.
    pub controls: Vec<Line>,
    /// Width of a band on either side, scene units.
    pub band: f64,
}

/// The geometry of a rendered held-out view.
#[derive(Clone, Copy, Debug)]
pub struct SeenView<'a> {
    /// Its camera, of the size of the pictures.
    pub camera: &'a PinholeCamera,
    /// World to camera.
    pub pose: &'a Pose,
    /// Alpha of the surfaces, `[H*W]`.
    pub alpha: &'a [f32],
    /// Sum of weight times distance along the ray of the surfaces, `[H*W]`, scene units.
    pub range: &'a [f32],
}

/// Measures view after view.
pub struct SeamMeter {
    lines: SeamLines,
    config: SeamsConfig,
    sums: SeamSums,
}

/// The zones of a view, to draw a picture of them.
pub struct ViewZones {
    width: usize,
    zones: Vec<Zones>,
    /// Pixels beside which the surface crosses a border, and a control line.
    on_border: Vec<usize>,
    on_control: Vec<usize>,
    /// Whether the view counts in the means of the border.
    counts: bool,
}

impl ViewZones {
    /// Whether the view shows enough of a border, and of the interior, to count.
    pub fn counts(&self) -> bool {
        self.counts
    }
}

impl SeamMeter {
    /// A meter without measurements.
    pub fn new(lines: SeamLines, config: SeamsConfig) -> Self {
        let sums = SeamSums { band: lines.band, ..SeamSums::default() };
        Self { lines, config, sums }
    }

    /// Measures `render` against `truth`, whose mask counts. All pictures have the size of the camera; `ssim`
    /// is the map of the two, `None` if the mask leaves nothing.
    pub fn add(
        &mut self,
        view: &SeenView<'_>,
        render: &PackedImage,
        truth: &PackedImage,
        ssim: Option<&SsimMap>,
    ) -> ViewZones {
        let surfaces = Surfaces::of(view, truth, self.lines.world_to_aligned);
        let zones = surfaces.zones(&self.lines);
        let least = self.config.least_share * zones.len() as f64;
        let sums = Sums::of(&zones, render, truth, ssim, least);
        let counts = sums.border_counts();
        self.sums.views.push(sums);
        let beside = BESIDE * self.lines.band;
        let find = |lines: &[Line], [band, flank]: [Zones; 2], found: &mut [StepList; 2]| {
            let StepsOf { on, steps: across } = steps(&surfaces, &zones, lines, &[0.0], band);
            found[0].extend(across);
            found[1].extend(steps(&surfaces, &zones, lines, &[-beside, beside], flank).steps);
            on
        };
        let on_border =
            find(&self.lines.borders, [Zones::BORDER, Zones::BORDER_FLANK], &mut self.sums.border_steps);
        let on_control =
            find(&self.lines.controls, [Zones::CONTROL, Zones::CONTROL_FLANK], &mut self.sums.control_steps);
        ViewZones { width: surfaces.width, zones, on_border, on_control, counts }
    }

    /// All that was measured.
    pub fn sums(self) -> SeamSums {
        self.sums
    }

    /// The results.
    pub fn report(self) -> SeamReport {
        self.sums.report()
    }
}

#[cfg(test)]
mod tests;
