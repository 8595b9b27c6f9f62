//! Where cells meet: the border segments of a plan, and the task that trains the Gaussians near them after
//! the merge.
//!
//! Cells may be of any sizes as long as they tile the plane: nothing here knows of columns and rows.

use fathom_core::config::{JobConfig, TrainConfig};
use glam::DVec3;
use rayon::prelude::*;

use crate::budget::{self, Content};
use crate::geometry::{Rect, Segment};
use crate::plan::{BorderStage, Extent};
use crate::region::AlignedPoints;
use crate::seam_lines::borders;
use crate::selection::Candidate;

/// Maximum number of band points tested per view. Any view that shows more than a sliver sees one of these,
/// and planning a large scene stays a matter of seconds.
const ASKED_POINTS: usize = 4096;

/// Plans the task for a job with these cells; `None` where the job has none.
pub(super) fn stage(
    config: &JobConfig,
    cells: &[Rect],
    candidates: &[Candidate],
    points: &AlignedPoints,
    extent: &Extent,
) -> Option<BorderStage> {
    if !config.borders.is_enabled_for(cells.len()) {
        return None;
    }
    let width = config.borders.width * extent.viewing_distance.unwrap_or(extent.radius);
    let segments: Vec<Segment> = borders(cells).into_iter().map(Segment::from).collect();
    let band: Vec<Rect> = segments.iter().map(|segment| segment.band(width)).collect();
    let (inside, outside): (Vec<DVec3>, Vec<DVec3>) =
        points.all().iter().partition(|point| band.iter().any(|rect| rect.contains(**point)));
    let seeing = views_showing(&inside, candidates);
    let iterations = config.borders.iterations_of(config.train.iterations);
    let share = inside.len() as f64 / points.all().len().max(1) as f64;
    let cap = u64::from(config.train.max_gaussians);
    let trained = (share * cap as f64).round() as u64;
    let run = TrainConfig { iterations, max_gaussians: trained as u32, ..config.train.clone() };
    let views: Vec<_> =
        seeing.iter().map(|c| (c.camera.fitted(config.data.max_resolution), c.pose)).collect();
    let content = Content {
        views: &views,
        trained: (&inside, trained),
        frozen: (&outside, cap.saturating_sub(trained)),
    };
    Some(BorderStage {
        segments,
        width,
        margin: config.borders.margin * width,
        views: seeing.iter().map(|candidate| candidate.view).collect(),
        iterations,
        forecast: budget::forecast(&config.borders.of_run(run), &config.water, &content, false),
    })
}

/// The views in whose images some of `points` lie, hidden or not; all views if there are no points.
fn views_showing(points: &[DVec3], candidates: &[Candidate]) -> Vec<Candidate> {
    let every = points.len().div_ceil(ASKED_POINTS).max(1);
    let sees = |candidate: &&Candidate| {
        let camera = &candidate.camera;
        points.iter().step_by(every).any(|point| {
            let p = candidate.pose.transform(*point);
            let (x, y) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
            p.z > 0.0
                && (0.0..f64::from(camera.width)).contains(&x)
                && (0.0..f64::from(camera.height)).contains(&y)
        })
    };
    let seeing: Vec<Candidate> = candidates.par_iter().filter(sees).copied().collect();
    if points.is_empty() { candidates.to_vec() } else { seeing }
}

#[cfg(test)]
mod tests {
    use fathom_core::seams::{Axis, Line};

    use super::*;
    use crate::geometry::Interval;

    #[test]
    fn a_band_reaches_as_far_beyond_the_ends_as_to_the_sides() {
        let interval = |lo, hi| Interval { lo, hi };
        let open_before = Segment { axis: Axis::X, at: 2.0, lo: None, hi: Some(5.0) };
        let expected = Rect { x: interval(Some(1.5), Some(2.5)), z: interval(None, Some(5.5)) };
        assert_eq!(open_before.band(0.5), expected);
        let open_after = Line { axis: Axis::Z, at: 2.0, from: 1.0, to: f64::INFINITY };
        let expected = Rect { x: interval(Some(0.5), None), z: interval(Some(1.5), Some(2.5)) };
        assert_eq!(Segment::from(open_after).band(0.5), expected);
    }
}
