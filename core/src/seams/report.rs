//! The report: sums over the zones of a view, means over views, and the share of the loss that partitioning
//! causes.

use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::surfaces::Zones;
use crate::metrics::SsimMap;
use crate::views::PackedImage;

/// Fewer steps than this have no median.
const LEAST_STEPS: usize = 30;

/// The results at the borders of a model's cells. PSNR in dB; `None` if there is too little to measure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeamReport {
    /// Width of a band on either side of a line, scene units.
    pub band: f64,
    /// The bands of borders.
    pub border: BandReport,
    /// The bands of control lines, where nothing was cut.
    pub control: BandReport,
    /// Surfaces outside the bands of borders.
    pub interior: InteriorReport,
    /// Loss of the bands of borders against their flanks: `loss_db` of the border.
    pub seam_db: Option<f64>,
    /// Its standard error.
    pub seam_db_error: Option<f64>,
    /// SSIM of the flanks of borders minus that of their bands.
    pub seam_ssim: Option<f64>,
    /// Steps of the surface across lines.
    pub range_step: RangeSteps,
    /// Each view, in the order of measuring.
    pub views: Vec<ViewSeams>,
}

/// Results along one kind of lines.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BandReport {
    /// Views that count: band and flank each have at least the least share of the picture, and some error.
    pub views: u32,
    /// Mean over these.
    pub psnr: Option<f64>,
    /// Mean over these.
    pub ssim: Option<f64>,
    /// Mean of the flank over these.
    pub flank_psnr: Option<f64>,
    /// Mean of the flank over these.
    pub flank_ssim: Option<f64>,
    /// PSNR of the flank minus that of the band, mean over these; above 0 is a loss.
    pub loss_db: Option<f64>,
    /// Its standard error, estimated from the differences between views; `None` below two views.
    pub loss_db_error: Option<f64>,
    /// Mean of the interior over these: the same photographs.
    pub interior_psnr: Option<f64>,
    /// Mean of the interior over these.
    pub interior_ssim: Option<f64>,
    /// Pixels of the band in all views, also in those that do not count.
    pub pixels: u64,
    /// By the mean squared error over all these pixels.
    pub pooled_psnr: Option<f64>,
    /// Mean of the map over all these pixels.
    pub pooled_ssim: Option<f64>,
}

/// The interior of all views.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InteriorReport {
    /// Pixels.
    pub pixels: u64,
    /// By the mean squared error over all these pixels.
    pub pooled_psnr: Option<f64>,
    /// Mean of the map over all these pixels.
    pub pooled_ssim: Option<f64>,
}

/// Steps of the surface across lines. If the ratio of borders is above that of control lines, partitioning
/// has left steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RangeSteps {
    /// Across borders.
    pub border: Steps,
    /// Across control lines.
    pub control: Steps,
}

/// Steps across one kind of lines.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Steps {
    /// Pairs of pixels.
    pub pairs: u64,
    /// Median step, as a share of the depth; `None` below 30 pairs.
    pub median: Option<f64>,
    /// Pairs across the same lines moved by two bands to either side.
    pub beside_pairs: u64,
    /// Median of them.
    pub beside_median: Option<f64>,
    /// Median across the lines over that beside them.
    pub ratio: Option<f64>,
}

/// One view. Values of a zone with less than the least share of the picture are `None`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewSeams {
    /// Pixels in the band of borders.
    pub border_pixels: u64,
    /// Of them; `None` also if there is no error at all.
    pub border_psnr: Option<f64>,
    /// Of them.
    pub border_ssim: Option<f64>,
    /// Of surfaces outside that band.
    pub interior_psnr: Option<f64>,
    /// Of them.
    pub interior_ssim: Option<f64>,
    /// Of the bands of control lines.
    pub control_psnr: Option<f64>,
    /// Of them.
    pub control_ssim: Option<f64>,
}

/// Sums over the pixels of one zone. They may come from a worker, so no value is trusted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Sum {
    pixels: u64,
    /// Squared differences of 8-bit values, all channels.
    squares: u64,
    ssim: f64,
}

impl Sum {
    fn plus(self, other: Self) -> Self {
        Self {
            pixels: self.pixels.saturating_add(other.pixels),
            squares: self.squares.saturating_add(other.squares),
            ssim: self.ssim + other.ssim,
        }
    }

    fn psnr(&self) -> Option<f64> {
        let mse = self.squares as f64 / (3.0 * self.pixels as f64) / (255.0 * 255.0);
        finite(-10.0 * mse.log10())
    }

    fn mean_ssim(&self) -> Option<f64> {
        finite(self.ssim / self.pixels as f64)
    }
}

/// The zones of one view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Sums {
    border: Sum,
    border_flank: Sum,
    control: Sum,
    control_flank: Sum,
    interior: Sum,
    /// Least pixels of a zone that counts.
    least: f64,
}

impl Sums {
    pub fn of(
        zones: &[Zones],
        render: &PackedImage,
        truth: &PackedImage,
        ssim: Option<&SsimMap>,
        least: f64,
    ) -> Self {
        let mut sums = Self { least, ..Self::default() };
        for (index, zones) in zones.iter().enumerate().filter(|(_, zones)| **zones != Zones::NOTHING) {
            let (a, b) = (render.pixels[index].to_le_bytes(), truth.pixels[index].to_le_bytes());
            let pixel = Sum {
                pixels: 1,
                squares: (0..3).map(|c| u64::from(a[c].abs_diff(b[c])).pow(2)).sum(),
                ssim: ssim.map_or(0.0, |map| map.at(index)),
            };
            for (zone, sum) in [
                (Zones::BORDER, &mut sums.border),
                (Zones::BORDER_FLANK, &mut sums.border_flank),
                (Zones::CONTROL, &mut sums.control),
                (Zones::CONTROL_FLANK, &mut sums.control_flank),
                (Zones::INTERIOR, &mut sums.interior),
            ] {
                if zones.are(zone) {
                    *sum = sum.plus(pixel);
                }
            }
        }
        sums
    }

    /// PSNR and SSIM of a zone; `None` if it is too small.
    fn of_zone(&self, sum: &Sum) -> (Option<f64>, Option<f64>) {
        let is_enough = sum.pixels as f64 >= self.least;
        (sum.psnr().filter(|_| is_enough), sum.mean_ssim().filter(|_| is_enough))
    }

    /// Whether the view counts in the means of the border.
    pub fn border_counts(&self) -> bool {
        self.beside([&self.border, &self.border_flank]).is_some()
    }

    /// (PSNR, SSIM) of a band, of its flank and of the interior; `None` unless all are large enough and have
    /// errors.
    fn beside(&self, [band, flank]: [&Sum; 2]) -> Option<[(f64, f64); 3]> {
        let both = |sum| {
            let (psnr, ssim) = self.of_zone(sum);
            Some((psnr?, ssim?))
        };
        Some([both(band)?, both(flank)?, both(&self.interior)?])
    }

    fn view(&self) -> ViewSeams {
        let [(border_psnr, border_ssim), (interior_psnr, interior_ssim), (control_psnr, control_ssim)] =
            [&self.border, &self.interior, &self.control].map(|sum| self.of_zone(sum));
        ViewSeams {
            border_pixels: self.border.pixels,
            border_psnr,
            border_ssim,
            interior_psnr,
            interior_ssim,
            control_psnr,
            control_ssim,
        }
    }
}

/// All that was measured at the borders of cells, from which a [`SeamReport`] follows. Several workers
/// measure a part of the views each; appended in the order of the views, their sums give the report of all
/// views.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SeamSums {
    /// Width of a band on either side of a line, scene units.
    pub(super) band: f64,
    /// Each view, in the order of measuring.
    pub(super) views: Vec<Sums>,
    /// Steps across the lines, and beside them.
    pub(super) border_steps: [StepList; 2],
    pub(super) control_steps: [StepList; 2],
}

/// Steps of one kind.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepList {
    /// How many were measured.
    pairs: u64,
    /// All of them, or as many as are kept.
    steps: Vec<f32>,
}

impl StepList {
    pub fn extend(&mut self, steps: Vec<f32>) {
        self.pairs = self.pairs.saturating_add(steps.len() as u64);
        self.steps.extend(steps);
    }
}

impl SeamSums {
    /// Most steps of each kind that a part of an evaluation keeps: their medians change little, and all parts
    /// of a large scene fit the coordinator's memory.
    const MOST_STEPS: usize = 1 << 12;

    /// Number of measured views.
    pub fn views(&self) -> usize {
        self.views.len()
    }

    /// Adds what was measured on later views.
    pub fn append(&mut self, later: Self) {
        self.band = later.band;
        self.views.extend(later.views);
        let lists = self.border_steps.iter_mut().chain(&mut self.control_steps);
        for (mine, theirs) in lists.zip(later.border_steps.into_iter().chain(later.control_steps)) {
            mine.pairs = mine.pairs.saturating_add(theirs.pairs);
            mine.steps.extend(theirs.steps);
        }
    }

    /// Keeps at most 4096 steps of each kind, evenly spaced in the order of measuring. Their number stays
    /// known.
    pub fn thin(&mut self) {
        let most = Self::MOST_STEPS;
        for StepList { steps, .. } in self.border_steps.iter_mut().chain(&mut self.control_steps) {
            let all = steps.len();
            if all > most {
                *steps = (0..most).map(|kept| steps[kept * all / most]).collect();
            }
        }
    }

    /// The results.
    pub fn report(self) -> SeamReport {
        SeamReport::of(self.band, &self.views, self.border_steps, self.control_steps)
    }
}

impl SeamReport {
    fn of(band: f64, views: &[Sums], border_steps: [StepList; 2], control_steps: [StepList; 2]) -> Self {
        let border = BandReport::of(views, |view| [&view.border, &view.border_flank]);
        let control = BandReport::of(views, |view| [&view.control, &view.control_flank]);
        let interior = views.iter().fold(Sum::default(), |sum, view| sum.plus(view.interior));
        let (seam_db, seam_db_error) = (border.loss_db, border.loss_db_error);
        let seam_ssim = border.flank_ssim.zip(border.ssim).map(|(flank, band)| flank - band);
        Self {
            band,
            border,
            control,
            interior: InteriorReport {
                pixels: interior.pixels,
                pooled_psnr: interior.psnr(),
                pooled_ssim: interior.mean_ssim(),
            },
            seam_db,
            seam_db_error,
            seam_ssim,
            range_step: RangeSteps { border: Steps::of(border_steps), control: Steps::of(control_steps) },
            views: views.iter().map(Sums::view).collect(),
        }
    }
}

impl BandReport {
    /// Over the band and the flank that `zones` selects in a view.
    fn of(views: &[Sums], zones: impl Fn(&Sums) -> [&Sum; 2]) -> Self {
        let counted: Vec<[(f64, f64); 3]> =
            views.iter().filter_map(|view| view.beside(zones(view))).collect();
        let pooled = views.iter().fold(Sum::default(), |sum, view| sum.plus(*zones(view)[0]));
        let losses: Vec<f64> = counted.iter().map(|[band, flank, _]| flank.0 - band.0).collect();
        let of_views = |of: fn(&[(f64, f64); 3]) -> f64| mean(&counted.iter().map(of).collect::<Vec<_>>());
        Self {
            views: counted.len() as u32,
            psnr: of_views(|[band, ..]| band.0),
            ssim: of_views(|[band, ..]| band.1),
            flank_psnr: of_views(|[_, flank, _]| flank.0),
            flank_ssim: of_views(|[_, flank, _]| flank.1),
            loss_db: mean(&losses),
            loss_db_error: variance_of_mean(&losses).map(f64::sqrt),
            interior_psnr: of_views(|[.., interior]| interior.0),
            interior_ssim: of_views(|[.., interior]| interior.1),
            pixels: pooled.pixels,
            pooled_psnr: pooled.psnr(),
            pooled_ssim: pooled.mean_ssim(),
        }
    }
}

impl Steps {
    fn of([across, beside]: [StepList; 2]) -> Self {
        let (pairs, beside_pairs) = (across.pairs, beside.pairs);
        let (median, beside_median) = (median(across.steps), median(beside.steps));
        let ratio = median.zip(beside_median).and_then(|(across, beside)| finite(across / beside));
        Self { pairs, median, beside_pairs, beside_median, ratio }
    }
}

fn median(mut steps: Vec<f32>) -> Option<f64> {
    let middle = steps.len() / 2;
    let is_enough = steps.len() >= LEAST_STEPS;
    is_enough.then(|| f64::from(*steps.select_nth_unstable_by(middle, f32::total_cmp).1))
}

/// Puts a report into a `metrics.json` whose `views` are those that were measured; nulls without a report,
/// for a scene with a single partition.
pub fn put_into(metrics: &mut Value, report: Option<&SeamReport>) {
    metrics["border_psnr"] = json!(report.and_then(|report| report.border.psnr));
    metrics["border_ssim"] = json!(report.and_then(|report| report.border.ssim));
    metrics["interior_psnr"] = json!(report.and_then(|report| report.border.interior_psnr));
    metrics["interior_ssim"] = json!(report.and_then(|report| report.border.interior_ssim));
    metrics["control_psnr"] = json!(report.and_then(|report| report.control.psnr));
    metrics["control_ssim"] = json!(report.and_then(|report| report.control.ssim));
    metrics["seam_db"] = json!(report.and_then(|report| report.seam_db));
    metrics["seams"] = json!(report);
    let of_views = metrics["seams"].as_object_mut().and_then(|seams| seams.remove("views"));
    let (Some(views), Some(Value::Array(of_views))) = (metrics["views"].as_array_mut(), of_views) else {
        return;
    };
    for (view, seams) in views.iter_mut().zip(of_views) {
        if let (Value::Object(view), Value::Object(seams)) = (view, seams) {
            view.extend(seams);
        }
    }
}

fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

fn mean(values: &[f64]) -> Option<f64> {
    finite(values.iter().sum::<f64>() / values.len() as f64)
}

/// For independent values; `None` below two.
fn variance_of_mean(values: &[f64]) -> Option<f64> {
    let mean = mean(values).filter(|_| values.len() > 1)?;
    let count = values.len() as f64;
    Some(values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (count * (count - 1.0)))
}
