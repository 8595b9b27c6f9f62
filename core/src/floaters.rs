//! Floaters: Gaussians that hang in the water before the scene, where no surface is.
//!
//! The loss cannot tell veil from a haze of Gaussians before the camera; sparse points can, since they lie on surfaces.

use glam::DVec3;
use rayon::prelude::*;

use crate::gaussians::Gaussians;
use crate::scene::{PinholeCamera, Points, Pose};

/// Sparse points that a view needs, so that their 2nd percentile says where its scene begins.
const LEAST_POINTS: usize = 20;
/// Percentile of a view's sparse ranges from which its scene begins.
const BEGINS: f64 = 0.02;
/// A Gaussian nearer than this share of it is a floater.
const NEAR: f64 = 0.5;

/// What [`floaters`] counts. Both numbers weigh a Gaussian by its opacity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Floaters {
    /// Floaters.
    pub count: f64,
    /// Floaters as a share of all Gaussians.
    pub share: f64,
    /// Views that had enough sparse points to say where their scene begins.
    pub views: usize,
}

/// Counts the Gaussians of `model` whose centre lies, in some view's picture, nearer than half of the 2nd percentile of
/// the ranges of that view's sparse points, weighted by their opacity.
///
/// `views` are (index in the scene by name, camera, world to camera). A view's points are those whose track names it;
/// of points without tracks, all that project into its picture. `None` where no view has 20 of them.
pub fn floaters(
    model: &Gaussians,
    views: &[(u32, PinholeCamera, Pose)],
    points: &Points,
) -> Option<Floaters> {
    let positions: Vec<DVec3> = points.positions.iter().map(|p| DVec3::from(p.map(f64::from))).collect();
    let near: Vec<(f64, PinholeCamera, Pose)> = views
        .par_iter()
        .filter_map(|(index, camera, pose)| {
            let sees = |point: usize| {
                points.tracks.is_empty() || points.tracks.of(point).binary_search(index).is_ok()
            };
            let ranges = (0..positions.len()).filter(|point| sees(*point));
            let begin = begin_of_scene(ranges.filter_map(|point| range_in(camera, pose, positions[point])));
            begin.map(|begin| (NEAR * begin, *camera, *pose))
        })
        .collect();
    if near.is_empty() {
        return None;
    }
    let opacity = |logit: f32| 1.0 / (1.0 + (-f64::from(logit)).exp());
    let floats: Vec<bool> = model
        .means
        .par_iter()
        .map(|mean| {
            let mean = DVec3::from(mean.map(f64::from));
            let is_near = |(near, camera, pose): &(f64, PinholeCamera, Pose)| {
                range_in(camera, pose, mean).is_some_and(|range| range < *near)
            };
            near.iter().any(is_near)
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

fn begin_of_scene(ranges: impl Iterator<Item = f64>) -> Option<f64> {
    let mut ranges: Vec<f64> = ranges.collect();
    if ranges.len() < LEAST_POINTS {
        return None;
    }
    let at = (BEGINS * ranges.len() as f64) as usize;
    Some(*ranges.select_nth_unstable_by(at, f64::total_cmp).1)
}

/// Distance of a point from the camera where it projects into the picture.
fn range_in(camera: &PinholeCamera, pose: &Pose, point: DVec3) -> Option<f64> {
    let p = pose.transform(point);
    let (x, y) = (camera.fx * p.x / p.z + camera.cx, camera.fy * p.y / p.z + camera.cy);
    let inside = p.z > 0.0
        && (0.0..f64::from(camera.width)).contains(&x)
        && (0.0..f64::from(camera.height)).contains(&y);
    inside.then(|| p.length())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera at the origin that looks along z, and points on a wall 10 away of which one lies at 1.
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
    fn what_hangs_before_the_scene_counts_by_its_opacity() {
        let (views, points) = scene();
        let at = |z: f32| [0.0, 0.0, z];
        // On the wall, just behind half way, just before it, out of the picture, behind the camera.
        let model = model(&[at(10.0), at(5.1), at(4.9), [4.0, 0.0, 4.0], at(-1.0)], 0.0);
        let found = floaters(&model, &views, &points).expect("enough points");
        assert!((found.count - 0.5).abs() < 1e-9, "{found:?}");
        assert!((found.share - 0.2).abs() < 1e-9 && found.views == 1, "{found:?}");
    }

    #[test]
    fn one_wrong_point_before_the_scene_does_not_hide_floaters_and_few_points_say_nothing() {
        let (views, points) = scene();
        let model = model(&[[0.0, 0.0, 2.0]], 9.0);
        assert!(floaters(&model, &views, &points).expect("enough points").count > 0.99);
        let few = points.select(&(0..19).collect::<Vec<u32>>());
        assert_eq!(floaters(&model, &views, &few), None);
    }

    #[test]
    fn a_point_counts_in_the_views_of_its_track_only() {
        let (mut views, untracked) = scene();
        let mut points = Points::default();
        for position in &untracked.positions {
            assert!(points.push_seen(position.map(f64::from), [0; 3], &mut vec![3]));
        }
        let model = model(&[[0.0, 0.0, 2.0]], 0.0);
        assert_eq!(floaters(&model, &views, &points), None);
        views[0].0 = 3;
        assert!(floaters(&model, &views, &points).is_some());
    }
}
