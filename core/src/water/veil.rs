//! Backscatter from the darkest pixels, for scenes whose sparse points do not determine it.
//!
//! At each range, the darkest pixels show backscatter plus the little light that the darkest surfaces reflect
//! (SeaThru; Akkaynak & Treibitz, CVPR 2019, eq. 10): per channel `D(r, d) = b_inf(d) (1 - exp(-beta_b r)) +
//! J_dark exp(-beta_d r)`. This is an upper bound: a range class without dark surfaces lies above the model.
//! Residuals above the model therefore get less weight than those below it. Where photographs show open
//! water, its colours are observations at infinite range.

use glam::DVec3;

use super::dense::{Least, least_squares, solve};
use super::open_water::{DarkCell, OpenWater};
use super::{ByDirection, Water};

/// Standard deviation of the logarithm of a dark value.
const SPREAD: f64 = 0.15;
/// Factor on residuals above the model.
const ABOVE: f64 = 0.4;
/// Total weight of all dark values, in observations.
const DARKS: f64 = 60.0;
/// Total weight of all open-water observations, in observations with a standard deviation of [`OPEN_SPREAD`].
const OPENS: f64 = 20.0;
const OPEN_SPREAD: f64 = 0.05;
/// Share of the nearest dark value that is light from the scene: a tenth. Fits with [`OTHER_SHARES`] add the
/// uncertainty of this share to the standard errors.
const SHARE: f64 = 0.1;
const OTHER_SHARES: [f64; 2] = [0.0, 0.3];
const SHARE_SPREAD: f64 = 0.05;
/// Standard deviation of ln(beta_b / beta_d) as a prior, for when neither dark pixels nor open water
/// determine it. In real waters, the two are within a factor of five of each other.
const COUPLED: f64 = 1.5;
/// Standard deviation of the slopes, with open water in the photographs and without.
const SLOPES: [f64; 2] = [5.0, 0.5];
/// Linear light below which a photograph does not differ from black.
const BLACK: f64 = 5e-4;
/// Relative error at or above which a parameter is unknown.
const UNKNOWN: f64 = 1.0;
/// Under water, dark values grow with range. Minimum rank correlation, and minimum ratio of the median of the
/// farthest third to that of the nearest.
const LEAST_CORRELATION: f64 = 0.5;
const LEAST_GROWTH: f64 = 1.4;

/// Minimum linear light above the veil at which a class has a usable hue.
const LEAST_LIGHT: f64 = 2e-3;
/// Minimum number of classes for an estimate of hues.
const LEAST_CLASSES: usize = 24;
/// Part of a hue change that may belong to the scene itself: a share of the change, and a constant in 1/unit.
const HUE_ASTRAY: f64 = 0.3;
const LEAST_HUE: f64 = 0.05;

/// The veil of one channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Veil {
    /// 1/scene unit, and its standard error; infinite if undetermined.
    pub(super) beta_b: [f64; 2],
    /// Linear light in the middle direction, and its standard error; infinite if undetermined.
    pub(super) b_inf: [f64; 2],
    /// Change of the logarithm of the colour by direction, scene axes.
    pub(super) slopes: DVec3,
}

/// The data from which a veil is estimated.
pub(super) struct Darkness<'a> {
    pub(super) dark: &'a [DarkCell],
    pub(super) open: Option<&'a OpenWater>,
    /// Up, right and forward of the levelled frame. `None`: the colour is the same in all directions.
    pub(super) axes: Option<[DVec3; 3]>,
    /// Direction to which `b_inf` refers, unit length.
    pub(super) middle: DVec3,
    /// Scene scale, scene units.
    pub(super) unit: f64,
}

impl Darkness<'_> {
    /// Whether dark values grow with range in any channel, as they do under water but not in air.
    pub(super) fn grow(&self) -> bool {
        (0..3).any(|c| {
            let mut by_range: Vec<(f64, f64)> =
                self.dark.iter().map(|cell| (cell.range, cell.dark[c])).collect();
            by_range.sort_by(|a, b| a.0.total_cmp(&b.0));
            let third = by_range.len() / 3;
            if third < 3 {
                return false;
            }
            let middle = |cells: &[(f64, f64)]| {
                let mut darks: Vec<f64> = cells.iter().map(|cell| cell.1).collect();
                darks.sort_by(f64::total_cmp);
                darks[darks.len() / 2]
            };
            let (near, far) = (middle(&by_range[..third]), middle(&by_range[by_range.len() - third..]));
            far > LEAST_GROWTH * near.max(BLACK) && correlation(&by_range) > LEAST_CORRELATION
        })
    }

    /// The veil of channel `c`, whose light is attenuated by `beta_d`, 1/scene unit. `None` without dark
    /// cells.
    pub(super) fn veil(&self, c: usize, beta_d: f64) -> Option<Veil> {
        let found = self.fit(c, beta_d, SHARE)?;
        let others: Vec<Least<6>> =
            OTHER_SHARES.into_iter().filter_map(|share| self.fit(c, beta_d, share)).collect();
        let error = |k: usize| {
            let variance = found.covariance.map_or(f64::INFINITY, |variances| variances[k].max(0.0));
            let moved = others.iter().map(|other| (other.at[k] - found.at[k]).abs()).fold(0.0, f64::max);
            let error = variance.sqrt().hypot(moved);
            if error < UNKNOWN { error } else { f64::INFINITY }
        };
        let (b_inf, beta_b) = (found.at[0].exp(), found.at[1].exp() / self.unit);
        let axes = self.axes.unwrap_or([DVec3::ZERO; 3]);
        Some(Veil {
            beta_b: [beta_b, beta_b * error(1)],
            b_inf: [b_inf, b_inf * error(0)],
            slopes: axes[0] * found.at[3] + axes[1] * found.at[4] + axes[2] * found.at[5],
        })
    }

    /// Unknowns: logarithms of `b_inf` and of `beta_b` in 1/unit, the share of the nearest dark value that is
    /// light from the scene, and slopes along up, right and forward.
    fn fit(&self, c: usize, beta_d: f64, share: f64) -> Option<Least<6>> {
        let nearest = self.nearest(c)?;
        let (unit, axes) = (self.unit, self.axes.unwrap_or([DVec3::ZERO; 3]));
        let offset = |direction: DVec3| axes.map(|axis| axis.dot(direction - self.middle));
        let slope = |x: &[f64; 6], by: [f64; 3]| x[3] * by[0] + x[4] * by[1] + x[5] * by[2];
        let of_slopes = SLOPES[usize::from(self.open.is_none())];
        let weight_dark = (DARKS / self.dark.len() as f64).sqrt();
        let residuals = |x: &[f64; 6], out: &mut Vec<f64>| {
            for cell in self.dark {
                let limit = (x[0] + slope(x, offset(cell.direction))).exp();
                let veil = limit * -(-x[1].exp() * cell.range / unit).exp_m1();
                let model = veil + x[2] * nearest * (-beta_d * cell.range).exp();
                let off = ((cell.dark[c] + BLACK) / (model + BLACK)).ln() / SPREAD;
                out.push(weight_dark * huber(if off > 0.0 { ABOVE * off } else { off }));
            }
            out.push(((x[1].exp() + 0.01) / (beta_d * unit + 0.1)).ln() / COUPLED);
            out.push((x[2] - share) / SHARE_SPREAD);
            out.extend((3..6).map(|k| x[k] / of_slopes));
            if let Some(open) = self.open {
                let weight = (OPENS / open.seen.len().max(1) as f64).sqrt() / OPEN_SPREAD;
                for (direction, colour) in &open.seen {
                    let off = colour[c].max(1e-4).ln() - x[0] - slope(x, offset(*direction));
                    out.push(weight * off);
                }
            }
        };
        let brightest = self.dark.iter().map(|cell| cell.dark[c]).fold(0.01, f64::max);
        // Without open water, the limit is at most the median colour far away, or the largest dark value if
        // that is larger.
        let far = self.far(c).max(brightest).min(1.0).ln();
        let limit = if self.open.is_some() { 0.0 } else { far };
        let bounds = [
            [-9.0, limit],
            [0.01_f64.ln(), 20.0_f64.ln()],
            [0.0, 1.5],
            [-6.0, 6.0],
            [-6.0, 6.0],
            [-6.0, 6.0],
        ];
        let starts = [0.1_f64, 0.5, 2.0];
        let found = starts.map(|growth| {
            least_squares([brightest.ln(), growth.ln(), share, 0.0, 0.0, 0.0], bounds, residuals)
        });
        found.into_iter().min_by(|a, b| a.cost.total_cmp(&b.cost))
    }

    /// How much faster red and blue are attenuated than green, 1/scene unit, each with its standard error. It
    /// is the change of the median hue with range after the veil is removed. A scene may well be darker far
    /// away, such as sand near the camera with corals behind it; a different hue there is less likely. `None`
    /// if too few classes show light above the veil.
    pub(super) fn hues(&self, water: &Water, by_direction: &ByDirection) -> Option<[[f64; 2]; 2]> {
        let direct = |cell: &DarkCell| -> Option<(f64, [f64; 3])> {
            let here = by_direction.along(water, cell.direction.normalize_or(DVec3::Z));
            let light: [f64; 3] = std::array::from_fn(|c| {
                cell.middle[c] - here.b_inf[c] * -(-here.beta_b[c] * cell.range).exp_m1()
            });
            light.iter().all(|light| *light > LEAST_LIGHT).then(|| (cell.range, light.map(f64::ln)))
        };
        let lights: Vec<(f64, [f64; 3])> = self.dark.iter().filter_map(direct).collect();
        if lights.len() < LEAST_CLASSES {
            return None;
        }
        let n = lights.len() as f64;
        let mean_range = lights.iter().map(|(range, _)| range).sum::<f64>() / n;
        let spread: f64 = lights.iter().map(|(range, _)| (range - mean_range).powi(2)).sum();
        let slope = |c: usize| {
            let hue = |light: &[f64; 3]| light[c] - light[1];
            let mean = lights.iter().map(|(_, light)| hue(light)).sum::<f64>() / n;
            let by = |(range, light): &(f64, [f64; 3])| (range - mean_range) * (hue(light) - mean);
            let fades = -lights.iter().map(by).sum::<f64>() / spread;
            let off = |(range, light): &(f64, [f64; 3])| hue(light) - mean + fades * (range - mean_range);
            let variance = lights.iter().map(|light| off(light).powi(2)).sum::<f64>() / (n - 2.0);
            [fades, (variance / spread).sqrt().hypot(HUE_ASTRAY * fades.abs() + LEAST_HUE / self.unit)]
        };
        (spread > 0.0).then(|| [slope(0), slope(2)])
    }

    /// The 20 % quantile of the dark values of the nearest cells.
    fn nearest(&self, c: usize) -> Option<f64> {
        let mut ranges: Vec<f64> = self.dark.iter().map(|cell| cell.range).collect();
        ranges.sort_by(f64::total_cmp);
        let near = *ranges.get(ranges.len() * 15 / 100)?;
        let of_near = self.dark.iter().filter(|cell| cell.range <= near);
        let mut darks: Vec<f64> = of_near.map(|cell| cell.dark[c]).collect();
        darks.sort_by(f64::total_cmp);
        darks.get(darks.len() / 5).copied()
    }

    /// The median colour of the farthest cells.
    fn far(&self, c: usize) -> f64 {
        let mut by_range: Vec<(f64, f64)> =
            self.dark.iter().map(|cell| (cell.range, cell.middle[c])).collect();
        by_range.sort_by(|a, b| b.0.total_cmp(&a.0));
        let mut far: Vec<f64> = by_range.iter().take(by_range.len() / 8 + 1).map(|cell| cell.1).collect();
        far.sort_by(f64::total_cmp);
        far.get(far.len() / 2).copied().unwrap_or(1.0)
    }

    /// One function of direction with these slopes, limited to the range of observed directions.
    pub(super) fn by_direction(&self, slopes: [DVec3; 3]) -> ByDirection {
        let dark = self.dark.iter().map(|cell| cell.direction);
        let open = self.open.iter().flat_map(|open| open.seen.iter().map(|(direction, _)| *direction));
        let most = dark
            .chain(open)
            .flat_map(|direction| slopes.map(|slope| slope.dot(direction - self.middle).abs()))
            .fold(1e-3, f64::max);
        ByDirection {
            middle: self.middle.to_array(),
            slopes: slopes.map(|slope| slope.to_array()),
            most: most.min(ByDirection::MOST),
        }
    }
}

/// The attenuations that best fit both `tracks`, `[value, standard error]` by channel, and `hues`; none is
/// negative.
pub(super) fn reconciled(tracks: [[f64; 2]; 3], hues: [[f64; 2]; 2]) -> [[f64; 2]; 3] {
    let weight = |error: f64| if error.is_finite() { error.max(1e-9).powi(-2) } else { 0.0 };
    let own = tracks.map(|[_, error]| weight(error));
    let [red, blue] = hues.map(|[_, error]| weight(error));
    let matrix = [[own[0] + red, -red, 0.0], [-red, own[1] + red + blue, -blue], [0.0, -blue, own[2] + blue]];
    let mut beta: [f64; 3] = tracks.map(|[value, _]| value);
    // Coordinate descent, so that each value can stop at 0.
    for _ in 0..200 {
        beta[0] = ((own[0] * tracks[0][0] + red * (beta[1] + hues[0][0])) / matrix[0][0]).max(0.0);
        beta[2] = ((own[2] * tracks[2][0] + blue * (beta[1] + hues[1][0])) / matrix[2][2]).max(0.0);
        let by_hues = red * (beta[0] - hues[0][0]) + blue * (beta[2] - hues[1][0]);
        beta[1] = ((own[1] * tracks[1][0] + by_hues) / matrix[1][1]).max(0.0);
    }
    let variance = |c: usize| {
        let column = solve(matrix, std::array::from_fn(|j| if j == c { 1.0 } else { 0.0 }));
        column.map_or(f64::INFINITY, |column| column[c].max(0.0))
    };
    std::array::from_fn(|c| [beta[c], variance(c).sqrt()])
}

/// Square root of Huber's loss, with the sign: linear beyond one standard deviation.
fn huber(x: f64) -> f64 {
    if x.abs() <= 1.0 { x } else { x.signum() * (2.0 * x.abs() - 1.0).sqrt() }
}

/// Spearman's rank correlation of pairs sorted by their first element.
fn correlation(pairs: &[(f64, f64)]) -> f64 {
    let n = pairs.len() as f64;
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    order.sort_by(|&a, &b| pairs[a].1.total_cmp(&pairs[b].1));
    let off =
        order.iter().enumerate().map(|(rank, &index)| (rank as f64 - index as f64).powi(2)).sum::<f64>();
    1.0 - 6.0 * off / (n * (n * n - 1.0)).max(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Dark values of a water by range. Every seventh class contains nothing dark.
    fn cells(beta_b: f64, b_inf: f64, slope: f64, black: f64) -> Vec<DarkCell> {
        let of = |k: u32| {
            let range = 4.0 + 26.0 * f64::from(k / 4) / 15.0;
            let direction = DVec3::new(0.0, 0.2 - 0.1 * f64::from(k % 4), 1.0).normalize();
            let limit = b_inf * (slope * -direction.y).exp();
            let bright = if k % 7 == 3 { 3.0 } else { 1.0 };
            let dark = bright * (limit * (1.0 - (-beta_b * range).exp()) + black * (-0.08 * range).exp());
            DarkCell { range, direction, dark: [dark; 3], middle: [3.0 * dark; 3] }
        };
        (0..64).map(of).collect()
    }

    fn darkness(dark: &[DarkCell]) -> Darkness<'_> {
        let axes = Some([DVec3::NEG_Y, DVec3::X, DVec3::Z]);
        Darkness { dark, open: None, axes, middle: DVec3::Z, unit: 12.0 }
    }

    #[test]
    fn growing_veil_is_recovered_from_darks_within_its_errors() {
        let cells = cells(0.09, 0.12, 0.8, 0.002);
        let darkness = darkness(&cells);
        assert!(darkness.grow());
        let found = darkness.veil(1, 0.08).expect("darks");
        let veil = |b_inf: f64, beta_b: f64, range: f64| b_inf * (1.0 - (-beta_b * range).exp());
        for range in [8.0, 15.0, 30.0] {
            let (truth, fitted) = (veil(0.12, 0.09, range), veil(found.b_inf[0], found.beta_b[0], range));
            assert!((fitted / truth - 1.0).abs() < 0.1, "at {range}: {fitted} for {truth}");
        }
        assert!((found.b_inf[0] / 0.12).ln().abs() < 2.0 * found.b_inf[1] / found.b_inf[0], "{found:?}");
        assert!((found.beta_b[0] / 0.09).ln().abs() < 2.0 * found.beta_b[1] / found.beta_b[0], "{found:?}");
        assert!((found.slopes.y + 0.8).abs() < 0.3, "{found:?}");
    }

    #[test]
    fn hue_change_with_range_gives_the_attenuation() {
        let water = Water { beta_d: [0.08, 0.03, 0.02], beta_b: [0.1; 3], b_inf: [0.03, 0.07, 0.12] };
        let mut cells = cells(0.1, 0.1, 0.0, 0.0);
        for (k, cell) in (0_u32..).zip(&mut cells) {
            // Darker far away, but of constant hue.
            let own = 0.4 * (-0.03 * cell.range).exp() * (1.0 + 0.1 * f64::from(k % 3));
            let light = water.apply(DVec3::new(own, 0.8 * own, 0.7 * own), cell.range);
            cell.middle = light.to_array();
        }
        let darkness = darkness(&cells);
        let plain = darkness.by_direction([DVec3::ZERO; 3]);
        let [red, blue] = darkness.hues(&water, &plain).expect("light beside the veil");
        assert!((red[0] - 0.05).abs() < 1e-3 && (blue[0] + 0.01).abs() < 1e-3, "{red:?} {blue:?}");
        // Tracks that overestimate the attenuation of red and find none in green.
        let found = reconciled([[0.11, 0.03], [0.0, 0.02], [0.0, f64::INFINITY]], [red, blue]);
        assert!((0.05..0.085).contains(&found[0][0]) && found[1][0] < 0.04, "{found:?}");
        assert!(found[0][1] < 0.03 && found.iter().all(|[beta, error]| *beta >= 0.0 && error.is_finite()));
    }

    #[test]
    fn dark_values_do_not_grow_in_air() {
        let mut cells = cells(0.0, 0.0, 0.0, 0.0);
        for (k, cell) in (0_u32..).zip(&mut cells) {
            cell.dark = [0.01 + 0.005 * f64::from(k * 7 % 5); 3];
        }
        assert!(!darkness(&cells).grow());
        assert!(!darkness(&[]).grow() && darkness(&[]).veil(0, 0.1).is_none());
    }

    #[test]
    fn limit_of_a_nearly_linear_veil_is_unknown() {
        let cells = cells(0.002, 0.8, 0.0, 0.0);
        let found = darkness(&cells).veil(2, 0.0).expect("darks");
        assert!(found.b_inf[1] > 0.25 * found.b_inf[0], "{found:?}");
    }

    #[test]
    fn directional_colours_are_limited_to_observed_directions() {
        let cells = cells(0.09, 0.12, 0.8, 0.0);
        let by_direction = darkness(&cells).by_direction([DVec3::NEG_Y * 0.8; 3]);
        assert!(by_direction.is_sound());
        let [up, ..] = by_direction.factors(DVec3::NEG_Y);
        assert!((1.05..1.3).contains(&up), "{up}: nothing looked further up than 0.1");
    }
}
