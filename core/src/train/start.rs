//! The start of a run with water: its initial water parameters, and the colours of the sparse points without
//! the water.

use std::collections::HashMap;
use std::sync::Arc;

use glam::DVec3;

use super::{MediumRun, NetworkRun};
use crate::Result;
use crate::config::{NetworkStart, WaterConfig, WaterPrior};
use crate::picture::{linear_to_srgb, srgb_to_linear};
use crate::scene::Points;
use crate::views::{Mapped, TrainView, ViewSource};
use crate::water::{Water, four_digits, ray_maps, water_prior};

/// Smallest initial coefficient, in 1 / scene scale.
const LEAST_COEFFICIENT: f64 = 2e-3;
/// Smallest initial colour at infinity, linear light: a third of an 8-bit code, so that it is invisible. With
/// 2e-3, which is seven codes, no red of the far reef of reef-clip could be darker, which cost 0.002 of the
/// SSIM of red.
const LEAST_COLOUR: f64 = 1e-4;
/// J of a point, linear light: not black, because it would have no gradient, and not brighter than white.
const J_RANGE: [f64; 2] = [2e-3, 1.0];

/// The start of a run with water.
#[derive(Clone, Debug)]
pub struct StartingWater {
    /// The water, free to move.
    pub medium: MediumRun,
    /// The sparse points with their colours without the water.
    pub points: Points,
}

/// The views of a run with `medium`. If photographs were searched for open water, each view gets a map of
/// what its rays hit, and at which range.
///
/// `scene_views` as [`crate::water::observe`] takes them.
///
/// # Errors
/// When a photograph cannot be read.
pub fn with_ray_maps(
    medium: &MediumRun,
    points: &Points,
    views: &Arc<dyn ViewSource>,
    scene_views: &[u32],
) -> Result<Arc<dyn ViewSource>> {
    let open = match medium.shows_open_water {
        None => return Ok(Arc::clone(views)),
        Some(false) => None,
        Some(true) => Some((medium.water.b_inf, medium.by_direction.as_ref())),
    };
    let maps = ray_maps(points, views.as_ref(), scene_views, open)?;
    Ok(Arc::new(Mapped::new(Arc::clone(views), maps)?))
}

/// Finds the initial water of a run; `None` if the configuration has no medium.
///
/// `unit` is the scene scale, scene units; `scene_views` as [`crate::water::observe`] takes them. If the
/// sparse points give no estimate, a log message says so and the run starts from the values of the
/// configuration. A network is compared with the sparse points even if it does not start from them.
///
/// # Errors
/// When a photograph cannot be read.
pub fn starting_water(
    config: &WaterConfig,
    unit: f64,
    points: &Points,
    views: &dyn ViewSource,
    scene_views: &[u32],
) -> Result<Option<StartingWater>> {
    let Some(composition) = config.composition()? else { return Ok(None) };
    let unit = if unit > 0.0 && unit.is_finite() { unit } else { 1.0 };
    let mut medium = MediumRun::fixed(config, composition, unit);
    let mut clear = vec![None; points.len()];
    let by_network = config.prior == WaterPrior::Network;
    if by_network {
        medium.network = Some(NetworkRun::default());
        medium.source = "network";
    }
    if config.prior != WaterPrior::Fixed {
        let prior = water_prior(points, views, scene_views, config.looks_beyond_points())?;
        match &prior.sparse {
            Ok(sparse) => tracing::info!(
                points = sparse.points,
                observations = sparse.observations,
                water = ?sparse.water.in_short(),
                standard_error = ?sparse.standard_error.map(four_digits),
                "estimated the water from the sparse points"
            ),
            Err(error) => {
                tracing::warn!(%error, "the sparse points give no water; the run starts from water.start_* of the configuration")
            }
        }
        if let Some(open) = &prior.open {
            let (colour, error) = open.colour();
            tracing::info!(
                share = open.share,
                views = open.views,
                colour = ?colour.map(four_digits),
                error = ?error.map(four_digits),
                "photographs show open water"
            );
        }
        if prior.by_darkness.contains(&true) {
            let (water, errors) =
                (prior.water.as_ref().map(Water::in_short), prior.standard_error.map(four_digits));
            tracing::info!(?water, standard_error = ?errors, channels = ?prior.by_darkness, "estimated the backscatter from the darkest pixels");
        }
        if let Some(water) = prior.water {
            if let Some(network) = &mut medium.network {
                network.sparse = Some((water.to_array(), prior.standard_error));
            } else {
                medium.source = "sparse";
            }
            if !by_network || config.network.start == NetworkStart::Sparse {
                medium.standard_error = Some(prior.standard_error);
                medium.water = able_to_move(water, unit);
                medium.by_direction = prior.by_direction;
                let looked = config.looks_beyond_points();
                medium.shows_open_water = looked.then_some(prior.open.is_some());
                medium.stays = prior.by_darkness;
                for (at, found) in prior.clear {
                    clear[at as usize] = found;
                }
            }
        }
    }
    let colours = points
        .colours
        .iter()
        .zip(clear)
        .map(|(colour, clear)| as_code(clear.unwrap_or_else(|| without(&medium.water, *colour, unit))));
    let colours = colours.collect();
    let medium = medium.over_black_if_clear();
    Ok(Some(StartingWater { medium, points: Points { colours, ..points.clone() } }))
}

/// Sparse points with their colours without the water of `medium`. The range of a point is its mean range
/// from the views that saw it, or the scene scale if that is unknown. `scene_views` as
/// [`crate::water::observe`] takes them.
pub fn clear_points(medium: &MediumRun, points: &Points, views: &[TrainView], scene_views: &[u32]) -> Points {
    let centres: HashMap<u32, DVec3> =
        scene_views.iter().zip(views).map(|(index, view)| (*index, view.pose.centre())).collect();
    let clear = |point: usize| {
        let position = DVec3::from(points.positions[point].map(f64::from));
        let ranges: Vec<f64> = points
            .tracks
            .of(point)
            .iter()
            .filter_map(|view| centres.get(view).map(|centre| centre.distance(position)))
            .collect();
        let range = ranges.iter().sum::<f64>() / ranges.len() as f64;
        let range = if range.is_finite() { range } else { medium.unit };
        as_code(without(&medium.water, points.colours[point], range))
    };
    Points { colours: (0..points.len()).map(clear).collect(), ..points.clone() }
}

/// J as the 8-bit sRGB colour of a point.
fn as_code(clear: [f64; 3]) -> [u8; 3] {
    clear.map(|light| (linear_to_srgb(light.clamp(J_RANGE[0], J_RANGE[1])) * 255.0).round() as u8)
}

/// J of an 8-bit sRGB colour seen at `range`, linear light.
fn without(water: &Water, colour: [u8; 3], range: f64) -> [f64; 3] {
    let seen = DVec3::from(colour.map(|code| srgb_to_linear(f64::from(code) / 255.0)));
    water.remove(seen, range).to_array()
}

/// `water` with values of at least [`LEAST_COEFFICIENT`] and [`LEAST_COLOUR`]: at 0 the unconstrained
/// parameters have no gradient, so they could not grow.
pub(super) fn able_to_move(water: Water, unit: f64) -> Water {
    let least = |beta: [f64; 3]| beta.map(|value| value.max(LEAST_COEFFICIENT / unit));
    Water {
        beta_d: least(water.beta_d),
        beta_b: least(water.beta_b),
        b_inf: water.b_inf.map(|value| value.max(LEAST_COLOUR)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_water_without_evidence_starts_invisible_and_can_grow() {
        let unit = 10.0;
        let nothing = Water { beta_d: [0.0; 3], beta_b: [0.0; 3], b_inf: [0.0; 3] };
        let start = able_to_move(nothing, unit);
        assert!(start.slopes(unit).iter().all(|slope| *slope > 5e-5), "{start:?} does not move");
        for code in start.b_inf.map(|light| 255.0 * linear_to_srgb(light)) {
            assert!(code < 0.5, "open water is {code} codes bright, not black");
        }
        let weakened = start.remove(DVec3::ONE, unit).to_array();
        assert!(weakened.iter().all(|light| (light - 1.0).abs() < 0.005), "{weakened:?} at the scene scale");
        assert_eq!(able_to_move(Water::COASTAL, unit), Water::COASTAL, "known values stay");
    }
}
