//! Steps of the surface across a line.
//!
//! Two neighbouring pixels whose surfaces lie on two sides of a line are a pair. On each side the surface is
//! extrapolated to the line: a straight line is fitted to the inverse depth of four pixels. Inverse depth is
//! linear over the pixels of any plane, so a slope gives no step. The difference of the two depths, as a
//! share of their mean, is the step. The pixels beside the line are left out: Gaussians blend over it, and
//! would smear a step into a slope.

use glam::DVec2;

use super::Line;
use super::surfaces::{Surfaces, Zones};

/// Pixels beside the line that are left out on each side: about the reach of a Gaussian that is one pixel
/// wide.
const SKIPPED: usize = 2;
/// Weights of the following four pixels in the extrapolation. They give the intercept at 0 of a least-squares
/// line through distances d of 2.5, 3.5, 4.5 and 5.5 pixels: 1/4 - (d - 4) 4 / 5.
const WEIGHTS: [f64; 4] = [1.45, 0.65, -0.15, -0.95];

/// The crossings and steps of a view.
pub struct StepsOf {
    /// Pixels beside which the surface crosses a line, ascending; may repeat.
    pub on: Vec<usize>,
    /// The step of each pair that has enough pixels on both sides, as a share of its depth, at least 0.
    pub steps: Vec<f32>,
}

/// The pairs across `lines` moved by each of `shifts`. Both pixels must be in `zone`, the zone around these
/// lines: a surface outside it does not continue across the line.
pub fn steps(surfaces: &Surfaces, zones: &[Zones], lines: &[Line], shifts: &[f64], zone: Zones) -> StepsOf {
    let farthest = shifts.iter().fold(0.0, |farthest: f64, shift| farthest.max(shift.abs()));
    let moved = |line: Line| shifts.iter().map(move |shift| [Line { at: line.at + shift, ..line }, line]);
    // The moved line, across which pairs are found, and the line itself, which an extrapolation beside it
    // must not cross.
    let lines: Vec<[Line; 2]> = surfaces.near(lines, farthest).into_iter().flat_map(moved).collect();
    let mut found = StepsOf { on: Vec::new(), steps: Vec::new() };
    if lines.is_empty() {
        return found;
    }
    let width = surfaces.width;
    for first in 0..zones.len() {
        let (column, row) = (first % width, first / width);
        // To the right and down: the stride to the next pixel, and the number of pixels before and after.
        let ways = [(1, column, width - 1 - column), (width, row, zones.len() / width - 1 - row)];
        for (stride, before, after) in ways {
            if after == 0 || !zones[first].are(zone) || !zones[first + stride].are(zone) {
                continue;
            }
            let (a, b) = (surfaces.plane[first], surfaces.plane[first + stride]);
            let Some(lines) = lines.iter().find(|[moved, _]| moved.is_crossed(a, b)) else { continue };
            found.on.push(first);
            let reach = SKIPPED + WEIGHTS.len() - 1;
            if before < reach || after < reach + 1 {
                continue;
            }
            let near = extrapolated(surfaces, lines, a, |distance| first - distance * stride);
            let far = extrapolated(surfaces, lines, b, |distance| first + (distance + 1) * stride);
            if let (Some(near), Some(far)) = (near, far) {
                // |z - z'| / mean of both, of the inverses.
                found.steps.push((2.0 * (near - far).abs() / (near + far)) as f32);
            }
        }
    }
    found
}

/// The inverse depth at a line, extrapolated from the pixels on the side of `end`. `None` if a pixel has no
/// surface or lies on the other side of one of `lines`.
fn extrapolated(
    surfaces: &Surfaces,
    lines: &[Line; 2],
    end: DVec2,
    pixel: impl Fn(usize) -> usize,
) -> Option<f64> {
    let mut sum = 0.0;
    for (distance, weight) in (SKIPPED..).zip(WEIGHTS) {
        let index = pixel(distance);
        let point = surfaces.plane[index];
        let strays = lines.iter().any(|line| line.is_beyond(point) != line.is_beyond(end));
        if !point.is_finite() || strays {
            return None;
        }
        sum += weight * surfaces.inverse_depth[index];
    }
    (sum > 0.0).then_some(sum)
}
