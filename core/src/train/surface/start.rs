//! The starts of the sets of a scene with a water surface.

use std::collections::HashSet;

use glam::DVec3;

use super::SurfaceRun;
use crate::Result;
use crate::config::{SurfaceConfig, SurfaceJoin, SurfaceRefine, SurfaceStart, TrainConfig};
use crate::gaussians::{Gaussians, SH_C0};
use crate::rng::{Stream, random_bits, uniform};
use crate::scene::Points;
use crate::surface::{
    Surface, SurfaceError, SurfaceModel, SurfaceOptions, SurfaceRecord, SurfaceSource, surface_prior,
};
use crate::train::init::{gaussians_from_points, initial_gaussians, initial_gaussians_within, limit, turn};
use crate::views::TrainView;

/// Opacity of a new disk of the refracted and the reflected set. The paper has 0.1; see
/// `train::init::OPACITY`.
const OPACITY: f32 = 0.5;
/// Colour of a new disk of the reflected set, sRGB: dark, but with a gradient.
const DARK: f32 = 0.2;
/// Radius of the dome on which the reflected set starts, in mean distances of the cameras from the surface.
const NEAREST_DOME: f64 = 1.0;
const FARTHEST_DOME: f64 = 2.5;

/// The start of a run: the scene above water, then the water surface, found or given, with the starts of the
/// sets that it shows.
///
/// `views` are the training views, and `scene_views` their numbers in the tracks of `points`.
///
/// # Errors
/// When the surface is not given and cannot be found, or lies above a camera
/// ([`crate::surface::SurfaceError`]).
pub fn surface_run(
    points: &Points,
    views: &[TrainView],
    scene_views: &[u32],
    train: &TrainConfig,
    config: &SurfaceConfig,
) -> Result<(Gaussians, SurfaceRun)> {
    let options = SurfaceOptions {
        offset: config.offset,
        normal: config.normal.map(DVec3::from),
        ior: config.ior,
        up: None,
        start: config.start,
    };
    let cameras: Vec<_> = views.iter().map(|view| (view.camera, view.pose)).collect();
    let prior = surface_prior(points, &cameras, scene_views, &options)?;
    let surface = prior.surface;
    tracing::info!(
        normal = ?surface.normal.to_array(),
        offset = surface.offset,
        standard_error = ?prior.standard_error,
        wet = prior.wet.len(),
        dry = prior.dry.len(),
        "found the water surface"
    );
    let given = config.normal.is_some() && config.offset.is_some();
    let record = SurfaceRecord {
        reflectance: config.reflectance,
        light: config.light,
        join: config.join,
        source: match config.start {
            _ if given => SurfaceSource::Given,
            SurfaceStart::Tracks => SurfaceSource::Tracks,
            SurfaceStart::Paper => SurfaceSource::Paper,
        },
        offset_error: prior.standard_error.map(|error| error.offset),
        tilt_error_degrees: prior.standard_error.map(|error| error.tilt_degrees),
        ..SurfaceRecord::given(&surface)
    };
    let eyes: Vec<DVec3> = views.iter().map(|view| view.pose.centre()).collect();
    let [_, refracted, reflected] = super::caps(train.max_gaussians, config.shares);
    let wet = prior.wet_points();
    let refracted = if wet.is_empty() {
        sunken_start(points, &eyes, &surface, train, refracted)?
    } else {
        refracted_start(&wet, train, refracted)?
    };
    let straight = match config.join {
        SurfaceJoin::Over => {
            let is_above = |mean: [f32; 3]| surface.height(DVec3::from(mean.map(f64::from))) > 0.0;
            let mut dry = prior.dry_points(points);
            if config.start == SurfaceStart::Paper {
                // Nothing says which points are in the water.
                dry = dry.select(&above(&dry, is_above));
            }
            initial_gaussians_within(&dry, views, train, None, is_above)?
        }
        SurfaceJoin::Masked => initial_gaussians(points, views, train, None)?,
    };
    let none = || Gaussians::empty(train.sh_degree);
    let run = SurfaceRun {
        record,
        context: [none(), none()],
        pivot: prior.centre,
        reflected: dome_start(prior.centre, &eyes, &surface, train, reflected)?,
        refracted,
        config: config.clone(),
    };
    Ok((straight, run))
}

/// Disks at the sparse points that a view sees, as at the start of a whole run: above water, and in it.
///
/// A coarse model has few disks, and its photographs were small. From them alone, a pool of 4 m in one
/// partition reached 29.66 dB; with the points beside them 29.83 dB, and 29.89 dB without a coarse model.
///
/// Where no view sees the surface, all points are above water.
///
/// # Errors
/// When the surface of `record` lies above a camera.
pub fn disks_at_points(
    points: &Points,
    views: &[TrainView],
    scene_views: &[u32],
    train: &TrainConfig,
    record: &SurfaceRecord,
) -> Result<[Gaussians; 2]> {
    let views_here: HashSet<u32> = scene_views.iter().copied().collect();
    // The straight place of a point that no view sees may be one in the water.
    let is_seen =
        |&index: &u32| points.tracks.of(index as usize).iter().any(|view| views_here.contains(view));
    let seen = if points.tracks.is_empty() {
        points
    } else {
        &points.select(&(0..points.len() as u32).filter(is_seen).collect::<Vec<_>>())
    };
    let surface = record.surface();
    let options = SurfaceOptions {
        offset: Some(surface.offset),
        normal: Some(surface.normal),
        ior: surface.ior,
        up: None,
        start: SurfaceStart::Tracks,
    };
    let cameras: Vec<_> = views.iter().map(|view| (view.camera, view.pose)).collect();
    let [dry, wet] = match surface_prior(seen, &cameras, scene_views, &options) {
        Ok(prior) => [prior.dry_points(seen), prior.wet_points()],
        Err(SurfaceError::NotSeen { .. }) => [seen.clone(), Points::default()],
        Err(error) => return Err(error.into()),
    };
    // Few views cannot say of all points in the water that they are.
    let dry = dry.select(&above(&dry, |mean| surface.height(DVec3::from(mean.map(f64::from))) > 0.0));
    let at = |points: &Points| -> Result<Gaussians> {
        if points.is_empty() {
            return Ok(Gaussians::empty(train.sh_degree));
        }
        let mut model = gaussians_from_points(points, OPACITY, train.sh_degree)?;
        turn(&mut model, train.seed);
        Ok(model)
    };
    Ok([at(&dry)?, at(&wet)?])
}

/// The start of a run that trains a part of a model beside the rest of it: its straight focus and context,
/// and the surface, which stays where it is.
///
/// Each set gets the share of the cap that it has of the part. As many of the disks of `more`, straight and
/// refracted, as fit under its cap are trained too. A set of which the part has nothing takes a disk of the
/// context: it is trained, but lies elsewhere, so a merge drops it.
pub fn surface_part(
    mut part: SurfaceModel,
    mut rest: SurfaceModel,
    more: [Gaussians; 2],
    train: &TrainConfig,
    config: &SurfaceConfig,
) -> ([Gaussians; 2], SurfaceRun) {
    for (own, others) in [
        (&mut part.straight, &mut rest.straight),
        (&mut part.reflected, &mut rest.reflected),
        (&mut part.refracted, &mut rest.refracted),
    ] {
        if own.is_empty() && !others.is_empty() {
            (*own, *others) = others.split_where(|index| index == 0);
        }
    }
    let sets = [&part.straight, &part.refracted, &part.reflected];
    let shares = sets.map(|set| set.len().max(1) as f32);
    let [straight, refracted, _] = super::caps(train.max_gaussians, shares);
    let [more_straight, more_refracted] = more;
    for (set, cap, more) in
        [(&mut part.straight, straight, more_straight), (&mut part.refracted, refracted, more_refracted)]
    {
        let more = limit(more, cap.saturating_sub(set.len() as u32), train.seed);
        (0..more.len()).for_each(|index| set.push_from(&more, index));
    }
    let config = SurfaceConfig { shares, refine: SurfaceRefine::Fixed, from: Some(0.0), ..config.clone() };
    let run = SurfaceRun {
        // The plane does not turn.
        pivot: DVec3::ZERO,
        record: part.record,
        reflected: part.reflected,
        refracted: part.refracted,
        context: [rest.reflected, rest.refracted],
        config,
    };
    ([part.straight, rest.straight], run)
}

/// The numbers of the points for which `is_above` holds.
fn above(points: &Points, is_above: impl Fn([f32; 3]) -> bool) -> Vec<u32> {
    let numbers = (0..points.len() as u32).filter(|&index| is_above(points.positions[index as usize]));
    numbers.collect()
}

/// The start of the refracted set: disks at the points in the water, where refraction puts them.
///
/// # Errors
/// When there are no points.
fn refracted_start(points: &Points, config: &TrainConfig, cap: u32) -> Result<Gaussians> {
    let mut model = limit(gaussians_from_points(points, OPACITY, config.sh_degree)?, cap, config.seed);
    turn(&mut model, config.seed);
    Ok(model)
}

/// `count` dark disks at random in a box below the surface (WSGS: in the box of the points). It is as wide as
/// points and cameras, and as deep as the highest camera is high.
fn sunken_start(
    points: &Points,
    eyes: &[DVec3],
    surface: &Surface,
    config: &TrainConfig,
    count: u32,
) -> Result<Gaussians> {
    let positions = points.positions.iter().map(|position| DVec3::from(position.map(f64::from)));
    let (right, forward) = surface.normal.any_orthonormal_pair();
    let place = |at: DVec3| [right.dot(at), forward.dot(at)];
    let (mut low, mut high) = ([f64::MAX; 2], [f64::MIN; 2]);
    for at in positions.chain(eyes.iter().copied()).filter(|at| at.is_finite()).map(place) {
        for k in 0..2 {
            low[k] = low[k].min(at[k]);
            high[k] = high[k].max(at[k]);
        }
    }
    let deepest = eyes.iter().map(|eye| surface.height(*eye)).fold(0.0, f64::max);
    let at = |index: u32| {
        let share = random_bits(config.seed, Stream::Sets, index, 1).map(|bits| f64::from(uniform(bits)));
        let across = [0, 1].map(|k| low[k] + share[k] * (high[k] - low[k]));
        across[0] * right + across[1] * forward + (surface.offset - share[2] * deepest) * surface.normal
    };
    let mut model = dark_disks((0..count).map(at), config)?;
    turn(&mut model, config.seed);
    Ok(model)
}

/// The start of the reflected set: `count` dark disks on a dome over the surface, facing its middle. The
/// paper has them at random in the box of the points, most of which is air between surface and cameras. A
/// pool with masks came out the same from both (29.8 and 30.0 dB in its water, one seed).
fn dome_start(
    pivot: DVec3,
    eyes: &[DVec3],
    surface: &Surface,
    config: &TrainConfig,
    count: u32,
) -> Result<Gaussians> {
    let (right, forward) = surface.normal.any_orthonormal_pair();
    let away = eyes.iter().map(|eye| eye.distance(pivot)).sum::<f64>() / eyes.len().max(1) as f64;
    let direction = |index: u32| {
        let share = random_bits(config.seed, Stream::Sets, index, 0).map(|bits| f64::from(uniform(bits)));
        // Uniform over the half sphere.
        let (up, turn) = (share[0], std::f64::consts::TAU * share[1]);
        let level = (1.0 - up * up).sqrt();
        let out = up * surface.normal + level * (turn.cos() * right + turn.sin() * forward);
        (out, NEAREST_DOME + (FARTHEST_DOME - NEAREST_DOME) * share[2])
    };
    let places = (0..count).map(|index| {
        let (out, far) = direction(index);
        pivot + far * away * out
    });
    let mut model = dark_disks(places, config)?;
    for (quat, index) in model.quats.iter_mut().zip(0..) {
        let facing = glam::DQuat::from_rotation_arc(DVec3::Z, -direction(index).0);
        *quat = [facing.w, facing.x, facing.y, facing.z].map(|value| value as f32);
    }
    Ok(model)
}

fn dark_disks(places: impl Iterator<Item = DVec3>, config: &TrainConfig) -> Result<Gaussians> {
    let mut points = Points::default();
    for place in places {
        points.push(place.to_array(), [0; 3]);
    }
    let mut model = gaussians_from_points(&points, OPACITY, config.sh_degree)?;
    let coefficients = (usize::from(config.sh_degree) + 1).pow(2);
    model.sh_coeffs.iter_mut().step_by(coefficients).for_each(|colour| *colour = [(DARK - 0.5) / SH_C0; 3]);
    Ok(model)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn disks(count: u32) -> Gaussians {
        let mut points = Points::default();
        for index in 0..count {
            points.push([f64::from(index), 0.0, 0.0], [128; 3]);
        }
        if count == 0 { Gaussians::empty(0) } else { gaussians_from_points(&points, OPACITY, 0).unwrap() }
    }

    #[test]
    fn a_part_takes_more_disks_up_to_the_cap_of_each_set() {
        let surface = Surface { normal: DVec3::Y, offset: 0.0, ior: crate::surface::WATER };
        let model = |[straight, reflected, refracted]: [u32; 3]| SurfaceModel {
            straight: disks(straight),
            masks: Vec::new(),
            reflected: disks(reflected),
            refracted: disks(refracted),
            record: SurfaceRecord::given(&surface),
        };
        let train = TrainConfig { max_gaussians: 100, ..TrainConfig::default() };
        let started = |more: [u32; 2]| {
            let (part, rest) = (model([20, 0, 20]), model([5, 3, 7]));
            let config = SurfaceConfig::default();
            let ([focus, context], run) = surface_part(part, rest, more.map(disks), &train, &config);
            assert_eq!([context.len(), run.context[0].len(), run.context[1].len()], [5, 2, 7]);
            assert_eq!(run.config.shares, [20.0, 20.0, 1.0]);
            [focus.len(), run.refracted.len(), run.reflected.len()]
        };
        assert_eq!(started([0, 0]), [20, 20, 1]);
        assert_eq!(started([4, 9]), [24, 29, 1]);
        // 100 disks in shares of 20, 20 and 1: 49, 49 and 2.
        assert_eq!(started([500, 500]), [49, 49, 1]);
    }
}
