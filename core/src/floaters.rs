//! Floaters: Gaussians in the water in front of the scene, away from any surface.
//!
//! The loss cannot distinguish a veil from a haze of Gaussians in front of the camera. Sparse points can,
//! since they lie on surfaces.

use std::collections::HashMap;

use glam::DVec3;
use rayon::prelude::*;

use crate::gaussians::Gaussians;
use crate::scene::{PinholeCamera, Points, Pose};

/// Minimum number of sparse points of a view, so that their 2nd percentile shows where its scene begins.
const LEAST_POINTS: usize = 20;
/// Quantile of a view's sparse ranges at which its scene begins.
const BEGINS: f64 = 0.02;
/// Share of that range up to which a view is clear.
const NEAR: f32 = 0.5;

/// The result of [`floaters`]. Both numbers weight a Gaussian by its opacity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Floaters {
    /// Number of floaters.
    pub count: f64,
    /// Floaters as a share of all Gaussians.
    pub share: f64,
    /// Number of views with enough sparse points to know where their scene begins.
    pub views: usize,
}

/// The range up to which each view is clear: half of the 2nd percentile of the ranges of its sparse points,
/// scene units. No part of the scene is nearer. 0 for a view with fewer than 20 points, where it is unknown.
///
/// `views` are (index in the scene by name, camera, world to camera), each index once. The points of a view
/// are those whose track contains it. Without tracks, they are all points that project into its picture,
/// thinned evenly to at most 32,768.
/// evenly to at most 32,768.
pub fn clear_ranges(views: &[(u32, PinholeCamera, Pose)], points: &Points) -> Vec<f32> {
    const UNTRACKED: usize = 32_768;
    let position = |point: usize| DVec3::from(points.positions[point].map(f64::from));
    if points.tracks.is_empty() {
        let thinned = points.len().div_ceil(UNTRACKED).max(1);
        let of_view = |(_, camera, pose): &(u32, PinholeCamera, Pose)| {
            let ranges = (0..points.len()).step_by(thinned);
            clear_range(ranges.filter_map(|point| range_in(camera, pose, position(point))).collect())
        };
        return views.par_iter().map(of_view).collect();
    }
    let places: HashMap<u32, usize> = views.iter().enumerate().map(|(i, (index, ..))| (*index, i)).collect();
    let mut ranges = vec![Vec::new(); views.len()];
    for point in 0..points.len() {
        for &place in points.tracks.of(point).iter().filter_map(|index| places.get(index)) {
            let (_, camera, pose) = &views[place];
            ranges[place].extend(range_in(camera, pose, position(point)));
        }
    }
    ranges.into_par_iter().map(clear_range).collect()
}

fn clear_range(mut ranges: Vec<f32>) -> f32 {
    if ranges.len() < LEAST_POINTS {
        return 0.0;
    }
    let at = (BEGINS * ranges.len() as f64) as usize;
    NEAR * *ranges.select_nth_unstable_by(at, f32::total_cmp).1
}

/// Counts the Gaussians of `model` whose centre is in the clear range of any view ([`clear_ranges`]),
/// weighted by their opacity. `None` if no view has a clear range.
pub fn floaters(
    model: &Gaussians,
    views: &[(u32, PinholeCamera, Pose)],
    points: &Points,
) -> Option<Floaters> {
    let clear = clear_ranges(views, points);
    let near: Vec<_> = views.iter().zip(clear).filter(|(_, range)| *range > 0.0).collect();
    if near.is_empty() {
        return None;
    }
    let opacity = |logit: f32| 1.0 / (1.0 + (-f64::from(logit)).exp());
    let floats: Vec<bool> = model
        .means
        .par_iter()
        .map(|mean| {
            let mean = DVec3::from(mean.map(f64::from));
            near.iter().any(|((_, camera, pose), clear)| {
                range_in(camera, pose, mean).is_some_and(|range| range < *clear)
            })
        })
        .collect();
    let (mut count, mut all) = (0.0, 0.0);
    for (floats, logit) in floats.into_iter().zip(&model.opacity_logits) {
        let weight = opacity(*logit);
        all += weight;
        count += if floats { weight } else { 0.0 };
    }
    Some(Floaters { count, share: if all > 0.0 { count / all } else { 0.0 }, views: near.len() })
}

/// Distance of a point from the camera; `None` outside the picture.
fn range_in(camera: &PinholeCamera, pose: &Pose, point: DVec3) -> Option<f32> {
    let p = pose.transform(point);
    let (x, y) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
    let inside = p.z > 0.0
        && (0.0..f64::from(camera.width)).contains(&x)
        && (0.0..f64::from(camera.height)).contains(&y);
    inside.then(|| p.length() as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera at the origin looking along z, and points on a wall 10 away, plus one at 1.
    fn scene() -> (Vec<(u32, PinholeCamera, Pose)>, Points) {
        let camera = PinholeCamera { width: 100, height: 100, fx: 100.0, fy: 100.0, cx: 50.0, cy: 50.0 };
        let pose = Pose::from_wxyz([1.0, 0.0, 0.0, 0.0], [0.0; 3]);
        let mut points = Points::default();
        for i in 0..100 {
            assert!(points.push([f64::from(i % 10) * 0.1, f64::from(i / 10) * 0.1, 10.0], [0; 3]));
        }
        assert!(points.push([0.0, 0.0, 1.0], [0; 3]));
        (vec![(0, camera, pose)], points)
    }

    fn model(means: &[[f32; 3]], logit: f32) -> Gaussians {
        let mut model = Gaussians::empty(0);
        for mean in means {
            model.means.push(*mean);
            model.quats.push([1.0, 0.0, 0.0, 0.0]);
            model.log_scales.push([0.0; 3]);
            model.opacity_logits.push(logit);
            model.sh_coeffs.push([0.0; 3]);
        }
        model
    }

    #[test]
    fn view_is_clear_up_to_half_of_its_nearest_ranges() {
        let (views, points) = scene();
        let [clear] = clear_ranges(&views, &points)[..] else { panic!("one view") };
        assert!((5.0..5.01).contains(&clear), "{clear}");
        let few = points.select(&(0..19).collect::<Vec<u32>>());
        assert_eq!(clear_ranges(&views, &few), [0.0]);
        assert!(clear_ranges(&[], &points).is_empty());
    }

    #[test]
    fn floaters_are_weighted_by_opacity() {
        let (views, points) = scene();
        let at = |z: f32| [0.0, 0.0, z];
        // On the wall, just beyond the clear range, just within it, outside the picture, behind the camera.
        let model = model(&[at(10.0), at(5.1), at(4.9), [4.0, 0.0, 4.0], at(-1.0)], 0.0);
        let found = floaters(&model, &views, &points).expect("enough points");
        assert!((found.count - 0.5).abs() < 1e-9, "{found:?}");
        assert!((found.share - 0.2).abs() < 1e-9 && found.views == 1, "{found:?}");
    }

    #[test]
    fn floaters_are_found_despite_a_wrong_point() {
        let (views, points) = scene();
        let model = model(&[[0.0, 0.0, 2.0]], 9.0);
        assert!(floaters(&model, &views, &points).expect("enough points").count > 0.99);
        let few = points.select(&(0..19).collect::<Vec<u32>>());
        assert_eq!(floaters(&model, &views, &few), None);
    }

    #[test]
    fn point_counts_only_in_the_views_of_its_track() {
        let (mut views, untracked) = scene();
        let mut points = Points::default();
        for position in &untracked.positions {
            assert!(points.push_seen(position.map(f64::from), [0; 3], &mut vec![3]));
        }
        let model = model(&[[0.0, 0.0, 2.0]], 0.0);
        assert_eq!(floaters(&model, &views, &points), None);
        assert_eq!(clear_ranges(&views, &points), [0.0]);
        views.push((3, views[0].1, views[0].2));
        let clear = clear_ranges(&views, &points);
        assert!(clear[0] == 0.0 && clear[1] > 4.9, "{clear:?}");
        assert!(floaters(&model, &views, &points).is_some());
    }
}
