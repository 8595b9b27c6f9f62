//! Initial Gaussians.

use kiddo::{ImmutableKdTree, SquaredEuclidean};

use super::MediumRun;
use super::background::background_gaussians;
use crate::config::{Strategy, TrainConfig};
use crate::gaussians::{Gaussians, MAX_SH_COEFFS, SH_C0};
use crate::rng::{Stream, permutation, random_bits, uniform};
use crate::scene::Points;
use crate::views::TrainView;
use crate::{CoreError, Result};

/// Opacity of a new Gaussian (3DGS-MCMC). 3DGS uses 0.1. With that, and the few steps that a Gaussian of a
/// large scene gets, the trained model stays a fog: half of sesa-wreck's Gaussians ended below 0.03.
const OPACITY: f32 = 0.5;
/// The same for classic density control (3DGS).
const OPACITY_CLASSIC: f32 = 0.1;

/// The background Gaussians take at most one in this many of the cap: a small model needs its Gaussians for
/// what is near.
const FAR_SHARE: u32 = 50;

/// Initial Gaussians of a run without a coarse model: Gaussians at the sparse points, as many as the cap
/// leaves room for. Around them lies a shell of background Gaussians ([`TrainConfig::background_gaussians`]),
/// unless the water of `medium` hides it, or photographs show open water there.
///
/// # Errors
/// When there are no points.
pub fn initial_gaussians(
    points: &Points,
    views: &[TrainView],
    config: &TrainConfig,
    medium: Option<&MediumRun>,
) -> Result<Gaussians> {
    initial_gaussians_within(points, views, config, medium, |_| true)
}

/// The same with the background Gaussians whose centres are `within`.
pub(super) fn initial_gaussians_within(
    points: &Points,
    views: &[TrainView],
    config: &TrainConfig,
    medium: Option<&MediumRun>,
    within: impl FnMut([f32; 3]) -> bool,
) -> Result<Gaussians> {
    let opacity = match config.strategy {
        Strategy::Mcmc => OPACITY,
        Strategy::Classic => OPACITY_CLASSIC,
    };
    let shows_open_water = medium.is_some_and(|medium| medium.shows_open_water == Some(true));
    let shell =
        if shows_open_water { 0 } else { config.background_gaussians.min(config.max_gaussians / FAR_SHARE) };
    let far =
        background_gaussians(points, views, config.sh_degree, shell, medium.map(|medium| &medium.water));
    let far = far.split_by(within).0;
    let room = config.max_gaussians - far.len() as u32;
    let mut model = limit(gaussians_from_points(points, opacity, config.sh_degree)?, room, config.seed);
    (0..far.len()).for_each(|index| model.push_from(&far, index));
    if config.disks {
        turn(&mut model, config.seed);
    }
    Ok(model)
}

/// Turns disks at random, as 2DGS does: no direction is preferred.
pub(super) fn turn(model: &mut Gaussians, seed: u32) {
    let number = |index: u32, k: u32| random_bits(seed, Stream::Turn, index, k).map(uniform);
    for (quat, index) in model.quats.iter_mut().zip(0..) {
        // Uniform over all rotations (Shoemake 1992).
        let [share, first, second] = number(index, 0);
        let (first, second) = (std::f32::consts::TAU * first, std::f32::consts::TAU * second);
        let (a, b) = ((1.0 - share).sqrt(), share.sqrt());
        *quat = [a * first.sin(), a * first.cos(), b * second.sin(), b * second.cos()];
    }
}

/// Gaussians at sparse points: scale from the three nearest neighbours, colour in SH degree 0 (3DGS).
pub(super) fn gaussians_from_points(points: &Points, opacity: f32, sh_degree: u8) -> Result<Gaussians> {
    let n = points.positions.len();
    if n == 0 {
        return Err(CoreError::Scene(
            "the scene has no sparse points to start from; repeat the structure-from-motion and export its points"
                .into(),
        ));
    }
    let coeffs = (usize::from(sh_degree) + 1).pow(2).min(MAX_SH_COEFFS);
    let spacing = spacing(&points.positions)?;
    let mut model = Gaussians::empty(sh_degree);
    let logit = (opacity / (1.0 - opacity)).ln();
    for ((position, colour), spacing) in points.positions.iter().zip(&points.colours).zip(spacing) {
        model.means.push(*position);
        model.quats.push([1.0, 0.0, 0.0, 0.0]);
        model.log_scales.push([spacing.ln(); 3]);
        model.opacity_logits.push(logit);
        model.sh_coeffs.push(colour.map(|value| (f32::from(value) / 255.0 - 0.5) / SH_C0));
        model.sh_coeffs.extend(std::iter::repeat_n([0.0; 3], coeffs - 1));
    }
    Ok(model)
}

/// A search tree of sparse points.
pub(super) fn searchable(positions: &[[f32; 3]]) -> Result<ImmutableKdTree<f32, 3>> {
    ImmutableKdTree::new_from_slice(positions)
        .map_err(|error| CoreError::Scene(format!("the sparse points cannot be searched: {error}")))
}

/// Root mean square distance to the three nearest other points; at least 1e-7 (simple-knn of 3DGS).
fn spacing(positions: &[[f32; 3]]) -> Result<Vec<f32>> {
    use rayon::prelude::*;
    let Some(count) = std::num::NonZeroUsize::new(4.min(positions.len())) else { return Ok(Vec::new()) };
    let tree = searchable(positions)?;
    Ok(positions
        .par_iter()
        .map(|position| {
            let near = tree.query(position).nearest_n::<SquaredEuclidean<f32>>(count).execute();
            // The nearest is the point itself.
            let squares: Vec<f32> = near.iter().skip(1).map(|found| found.distance).collect();
            let mean = squares.iter().sum::<f32>() / squares.len().max(1) as f32;
            mean.max(1e-7).sqrt()
        })
        .collect())
}

/// At most `cap` Gaussians: a random subset that depends only on the seed, in the given order.
pub(super) fn limit(model: Gaussians, cap: u32, seed: u32) -> Gaussians {
    let n = model.len();
    if n <= cap as usize {
        return model;
    }
    tracing::warn!(
        have = n,
        cap,
        "there are more initial Gaussians than the cap allows; a random subset is used"
    );
    let mut keep = vec![false; n];
    for index in &permutation(seed, Stream::Densify, u32::MAX, n)[..cap as usize] {
        keep[*index as usize] = true;
    }
    let mut limited = Gaussians::empty(model.sh_degree);
    for index in (0..n).filter(|&index| keep[index]) {
        limited.push_from(&model, index);
    }
    limited
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::scene::{PinholeCamera, Pose};

    /// A wall of `side` x `side` points and a camera in front of it.
    fn wall(side: i32) -> (Points, [TrainView; 1]) {
        let positions: Vec<[f32; 3]> =
            (0..side * side).map(|i| [(i % side) as f32, (i / side) as f32, 0.0]).collect();
        let points = Points { colours: vec![[128; 3]; positions.len()], positions, ..Points::default() };
        let camera = PinholeCamera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        let pose = Pose::looking_at(DVec3::new(5.0, 5.0, -9.0), DVec3::new(5.0, 5.0, 0.0), DVec3::Y);
        (points, [TrainView { name: String::new(), camera, pose, clear_range: 0.0 }])
    }

    #[test]
    fn the_cap_includes_the_background_and_leaves_it_whole() {
        let (points, views) = wall(40);
        for cap in [16, 500, 1000, 1600, 5000] {
            let config = TrainConfig { max_gaussians: cap, sh_degree: 1, ..TrainConfig::default() };
            let model = initial_gaussians(&points, &views, &config, None).unwrap();
            let far = background_gaussians(&points, &views, 1, cap / FAR_SHARE, None);
            assert!(!far.is_empty() || cap < 100, "a cap of {cap} has no background");
            assert_eq!(model.len(), (cap as usize).min(1600 + far.len()), "at a cap of {cap}");
            assert!(model.means.ends_with(&far.means));
            assert_eq!(model.sh_coeffs.len(), 4 * model.len());
        }
    }

    #[test]
    fn the_background_is_optional_and_no_larger_than_configured() {
        let (points, views) = wall(20);
        let config = |background_gaussians| TrainConfig {
            background_gaussians,
            sh_degree: 0,
            ..TrainConfig::default()
        };
        assert_eq!(initial_gaussians(&points, &views, &config(0), None).unwrap().len(), 400);
        let model = initial_gaussians(&points, &views, &config(64), None).unwrap();
        assert!((401..=464).contains(&model.len()), "{}", model.len());
        assert!(initial_gaussians(&Points::default(), &views, &config(64), None).is_err());
    }

    #[test]
    fn a_gaussian_at_a_point_is_as_wide_as_the_point_spacing() {
        let model = gaussians_from_points(&wall(5).0, 0.5, 0).unwrap();
        // In the middle, the three nearest points are at a distance of 1.
        assert_eq!(model.log_scales[12], [0.0; 3]);
        let corner = (4.0_f32 / 3.0).sqrt().ln();
        assert!((model.log_scales[0][0] - corner).abs() < 1e-6, "1, 1 and the diagonal");
    }
}
