//! Estimates the water from the photographs before a run: from sparse points at several ranges, open water,
//! and the darkest pixels at each range.
//!
//! Sparse points take precedence: a channel that they determine keeps their values. Open water gives its own
//! colour by direction. If the points determine neither growth nor limit of a channel's backscatter, the
//! darkest pixels do. The attenuation is then estimated from the points after removing that veil, and
//! reconciled with the hue that the scene loses with range.

use glam::DVec3;

use super::observe::{Observed, observe};
use super::open_water::{Lookout, OpenWater, look_around};
use super::sparse::{SparsePrior, SparsePriorError, attenuation_under, sparse_prior};
use super::veil::{Darkness, reconciled};
use super::{ByDirection, Water};
use crate::Result;
use crate::scene::Points;
use crate::views::ViewSource;

/// Alternating updates of veil and attenuation.
const ROUNDS: usize = 4;

/// The water estimate from the photographs.
#[derive(Clone, Debug)]
pub struct Prior {
    /// The estimate from sparse points alone, or why there is none.
    pub sparse: std::result::Result<SparsePrior, SparsePriorError>,
    /// Open water, if photographs show it.
    pub open: Option<OpenWater>,
    /// The water parameters from all evidence; `None` without any.
    pub water: Option<Water>,
    /// Their standard errors in the order of SMP-UWGS eq. 8; infinite for undetermined parameters.
    pub standard_error: [f64; 9],
    /// Change of the open-water colour with direction, if it was observed.
    pub by_direction: Option<ByDirection>,
    /// Channels whose veil comes from the darkest pixels.
    pub by_darkness: [bool; 3],
    /// For each point used, its index in the scene and, if known, its J, linear light, at least 0.
    pub clear: Vec<(u32, Option<[f64; 3]>)>,
}

/// Estimates the water from the photographs of `source`; `scene_views` as in [`observe`]. `beyond_points`
/// enables the use of pixels away from the sparse points.
///
/// # Errors
/// When a photograph cannot be read.
pub fn water_prior(
    points: &Points,
    source: &dyn ViewSource,
    scene_views: &[u32],
    beyond_points: bool,
) -> Result<Prior> {
    let observed = observe(points, source, scene_views)?;
    let Lookout { open, dark, axes } =
        if beyond_points { look_around(points, source, scene_views)? } else { Lookout::default() };
    let sparse = sparse_prior(&observed.observations, observed.points.len());
    let plain = Prior {
        open: open.clone(),
        water: sparse.as_ref().ok().map(|found| found.water),
        standard_error: sparse.as_ref().map_or([f64::INFINITY; 9], |found| found.standard_error),
        by_direction: None,
        by_darkness: [false; 3],
        clear: match &sparse {
            Ok(found) => observed.points.iter().copied().zip(found.clear.iter().copied()).collect(),
            Err(_) => Vec::new(),
        },
        sparse,
    };
    let Ok(sparse) = &plain.sparse else { return Ok(plain) };
    let middle = match &open {
        Some(open) => open.middle(),
        None => dark.iter().map(|cell| cell.direction).sum::<DVec3>().normalize_or(DVec3::Z),
    };
    let darkness = Darkness { dark: &dark, open: open.as_ref(), axes, middle, unit: sparse.ranges[1] };
    if open.is_none() && !darkness.grow() {
        return Ok(plain);
    }
    beyond(&plain, sparse, &darkness, observed)
}

/// The prior with open water and the darkest pixels.
fn beyond(
    plain: &Prior,
    sparse: &SparsePrior,
    darkness: &Darkness<'_>,
    mut observed: Observed,
) -> Result<Prior> {
    // The points determine a channel's veil if its growth and its limit have finite errors.
    let is_known =
        |c: usize| sparse.standard_error[3 + c].is_finite() && sparse.standard_error[6 + c].is_finite();
    let mut slopes = darkness.open.map_or([DVec3::ZERO; 3], OpenWater::slopes);
    let (mut water, mut errors) = (sparse.water, sparse.standard_error);
    let mut clear = None;
    if darkness.open.is_some() && (0..3).any(is_known) {
        // Repeats the estimate from points with a water that changes with direction.
        observed.tint(&darkness.by_direction(slopes));
        if let Ok(found) = sparse_prior(&observed.observations, observed.points.len()) {
            (water, errors) = (found.water, found.standard_error);
            clear = Some(found.clear);
        }
    }
    let by_darkness: [bool; 3] = std::array::from_fn(|c| !is_known(c) && !darkness.dark.is_empty());
    if !by_darkness.contains(&true) && darkness.open.is_none() {
        return Ok(plain.clone());
    }
    if by_darkness.contains(&true) {
        clear = None;
        for _ in 0..ROUNDS {
            for c in (0..3).filter(|&c| by_darkness[c]) {
                let Some(veil) = darkness.veil(c, water.beta_d[c]) else { continue };
                ([water.beta_b[c], errors[3 + c]], [water.b_inf[c], errors[6 + c]]) =
                    (veil.beta_b, veil.b_inf);
                slopes[c] = veil.slopes;
            }
            observed.tint(&darkness.by_direction(slopes));
            let under = attenuation_under(&observed.observations, observed.points.len(), &water);
            let Ok((beta_d, error)) = under else { break };
            let mut found: [[f64; 2]; 3] = std::array::from_fn(|c| match by_darkness[c] {
                true => [beta_d[c], error[c]],
                false => [water.beta_d[c], errors[c]],
            });
            if let Some(hues) = darkness.hues(&water, &darkness.by_direction(slopes)) {
                found = reconciled(found, hues);
            }
            for c in (0..3).filter(|&c| by_darkness[c]) {
                [water.beta_d[c], errors[c]] = found[c];
            }
        }
    }
    if let Some(open) = darkness.open {
        // No other observation of `b_inf` is as direct as one at infinite range.
        let (colour, error) = open.colour();
        for c in (0..3).filter(|&c| !by_darkness[c]) {
            (water.b_inf[c], errors[6 + c]) = (colour[c], error[c]);
        }
    }
    let has_directions = darkness.axes.is_some();
    let by_direction = has_directions.then(|| darkness.by_direction(slopes));
    if let Some(by_direction) = &by_direction {
        observed.tint(by_direction);
    }
    let clear = clear.unwrap_or_else(|| clear_of(&observed, &water));
    Ok(Prior {
        water: Some(water),
        standard_error: errors,
        by_direction,
        by_darkness,
        clear: observed.points.iter().copied().zip(clear).collect(),
        ..plain.clone()
    })
}

/// J of each point as the mean over its observations under `water`, weighted by transmitted light.
fn clear_of(observed: &Observed, water: &Water) -> Vec<Option<[f64; 3]>> {
    let mut sums = vec![([0.0; 3], [0.0; 3]); observed.points.len()];
    for seen in &observed.observations {
        let (above, below) = &mut sums[seen.point as usize];
        for c in (0..3).filter(|&c| seen.finer[c].is_finite()) {
            let through = (-water.beta_d[c] * seen.range).exp();
            let veil = seen.tint[c] * water.b_inf[c] * (1.0 - (-water.beta_b[c] * seen.range).exp());
            above[c] += through * (seen.finer[c] - veil);
            below[c] += through * through;
        }
    }
    let clear = |(above, below): ([f64; 3], [f64; 3])| {
        let is_known = below.iter().all(|below| *below > 1e-12);
        is_known.then(|| std::array::from_fn(|c| (above[c] / below[c]).max(0.0)))
    };
    sums.into_iter().map(clear).collect()
}

#[cfg(test)]
mod tests {

    use super::super::open_water::fixture::{ALL, WATER, ahead, brighter_upwards, dive};
    use super::*;

    #[test]
    fn points_and_open_water_give_a_water_by_direction() {
        let truth = brighter_upwards();
        let dive = dive(ahead, |ray| truth.along(&WATER, ray).b_inf);
        let prior = water_prior(&dive.points, &dive.photographs, &ALL, true).unwrap();
        let (water, by_direction) = (prior.water.unwrap(), prior.by_direction.unwrap());
        let middle = DVec3::from(by_direction.middle);
        for direction in
            [middle, DVec3::new(0.1, -0.1, 1.0).normalize(), DVec3::new(-0.1, 0.1, 1.0).normalize()]
        {
            let (found, expected) =
                (by_direction.along(&water, direction).b_inf, truth.along(&WATER, direction).b_inf);
            for c in 0..3 {
                let off = (found[c] / expected[c]).ln().abs();
                assert!(off < 0.05, "channel {c} along {direction}: {found:?} for {expected:?}");
            }
        }
        assert!(prior.standard_error[6..].iter().all(|error| error.is_finite()));
        let clear = prior.clear.iter().filter(|(_, clear)| clear.is_some()).count();
        assert!(clear * 10 > 9 * prior.clear.len(), "{clear} of {} points have a colour", prior.clear.len());
    }

    #[test]
    fn darkest_pixels_give_the_veil_if_views_share_one_place() {
        let beside = |k: f64| (DVec3::new(0.15 * k, 0.0, -6.0), DVec3::new(0.15 * k, 0.9, 6.0));
        let dive = dive(beside, |_| WATER.b_inf);
        let prior = water_prior(&dive.points, &dive.photographs, &ALL, true).unwrap();
        assert_eq!(prior.by_darkness, [true; 3], "{:?}", prior.sparse.map(|found| found.standard_error));
        let water = prior.water.unwrap();
        let factors = |c: usize| {
            prior.by_direction.map_or(1.0, |d| d.factors(DVec3::new(0.0, 0.15, 1.0).normalize())[c])
        };
        for (c, range) in [(0, 10.0), (1, 10.0), (2, 10.0), (1, 20.0), (2, 20.0)] {
            let veil = |water: &Water, factor: f64| {
                factor * water.b_inf[c] * (1.0 - (-water.beta_b[c] * range).exp())
            };
            let off = (veil(&water, factors(c)) / veil(&WATER, 1.0)).ln().abs();
            assert!(off < 0.2, "channel {c} at {range}: {off:.3}");
        }
    }

    #[test]
    fn prior_of_points_alone_is_the_sparse_estimate() {
        let dive = dive(ahead, |_| WATER.b_inf);
        let prior = water_prior(&dive.points, &dive.photographs, &ALL, false).unwrap();
        assert_eq!(prior.water, prior.sparse.as_ref().ok().map(|found| found.water));
        assert!(prior.open.is_none() && prior.by_direction.is_none() && prior.by_darkness == [false; 3]);
    }
}
