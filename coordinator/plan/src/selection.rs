//! Selects the cameras of a partition, and computes the depth of its points.
//!
//! A partition uses its own cameras, those inside its extended box, and every camera whose image the box
//! covers by at least tau. (SMP-UWGS eq. 3; tau is smaller at the edge of the grid.) Cameras are judged
//! independently of each other and listed by index, so threads and order change nothing.

use fathom_core::config::PartitionConfig;
use fathom_core::scene::{PinholeCamera, Pose};
use glam::DVec3;

use crate::geometry::Box3;
use crate::plan::Layer;
use crate::visibility::coverage;

/// Minimum number of cameras of a partition. If there are fewer, those with the next best coverage are added,
/// as long as they see the box: a handful of views overfits.
pub const MIN_CAMERAS: usize = 16;
/// Maximum number of own cameras, and of points for each, in the depth of a partition. A median of this many
/// is exact to a few percent, and planning a large scene stays a matter of seconds.
const DEPTH_CAMERAS: usize = 256;
const DEPTH_POINTS: usize = 4096;

/// A training camera in the aligned frame.
#[derive(Clone, Copy, Debug)]
pub struct Candidate {
    /// Index into the scene's views.
    pub view: u32,
    /// Real intrinsics.
    pub camera: PinholeCamera,
    /// From the aligned frame to the camera.
    pub pose: Pose,
    /// Centre, aligned frame.
    pub centre: DVec3,
}

/// The cameras of a partition.
#[derive(Clone, Debug, PartialEq)]
pub struct Selection {
    /// Views, ascending.
    pub views: Vec<u32>,
    /// Number of those added to reach [`MIN_CAMERAS`].
    pub filled: u32,
    /// Mean coverage over them.
    pub mean_visibility: f64,
}

/// Chooses among all training cameras, given by ascending view. `own` is ascending.
pub fn select(
    candidates: &[Candidate],
    own: &[u32],
    layer: Layer,
    extended: &Box3,
    config: &PartitionConfig,
) -> Selection {
    let threshold = match layer {
        Layer::Inner => config.visibility,
        Layer::Corner | Layer::Edge => config.visibility * config.visibility_edge_factor,
    };
    let coverages: Vec<f64> = candidates.iter().map(|c| coverage(&c.camera, &c.pose, extended)).collect();
    let mut chosen: Vec<bool> = candidates
        .iter()
        .zip(&coverages)
        .map(|(c, &rho)| {
            own.binary_search(&c.view).is_ok()
                || extended.contains(c.centre)
                || (rho > 0.0 && rho >= threshold)
        })
        .collect();
    let missing = MIN_CAMERAS.saturating_sub(chosen.iter().filter(|&&is| is).count());
    let mut next: Vec<usize> = (0..candidates.len()).filter(|&i| !chosen[i] && coverages[i] > 0.0).collect();
    next.sort_by(|&a, &b| coverages[b].total_cmp(&coverages[a]).then(a.cmp(&b)));
    next.truncate(missing);
    for &i in &next {
        chosen[i] = true;
    }
    let taken: Vec<usize> = (0..candidates.len()).filter(|&i| chosen[i]).collect();
    let sum: f64 = taken.iter().map(|&i| coverages[i]).sum();
    Selection {
        views: taken.iter().map(|&i| candidates[i].view).collect(),
        filled: next.len() as u32,
        mean_visibility: sum / taken.len().max(1) as f64,
    }
}

/// Mean over `cameras` of the median depth of those `points` that lie before them (SMP-UWGS eq. 6); 0
/// where there are none. Takes evenly spread samples of both.
pub fn mean_depth(cameras: &[Candidate], points: &[DVec3]) -> f64 {
    let points: Vec<DVec3> = evenly(points, DEPTH_POINTS).copied().collect();
    let medians: Vec<f64> = evenly(cameras, DEPTH_CAMERAS)
        .filter_map(|camera| {
            let mut depths: Vec<f64> =
                points.iter().map(|&p| camera.pose.transform(p).z).filter(|&z| z > 0.0).collect();
            let middle = depths.len().checked_sub(1)? / 2;
            Some(*depths.select_nth_unstable_by(middle, f64::total_cmp).1)
        })
        .collect();
    // A fold from 0.0: the sum of no numbers is -0.0 otherwise, which reads badly in a plan.
    medians.iter().fold(0.0, |sum, depth| sum + depth) / medians.len().max(1) as f64
}

/// At most `most` items, evenly spread.
fn evenly<T>(items: &[T], most: usize) -> impl Iterator<Item = &T> {
    items.iter().step_by(items.len().div_ceil(most).max(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: PinholeCamera =
        PinholeCamera { width: 400, height: 300, fx: 300.0, fy: 300.0, cx: 200.0, cy: 150.0 };

    fn candidate(view: u32, eye: DVec3, target: DVec3) -> Candidate {
        let pose = Pose::looking_at(eye, target, DVec3::Y);
        Candidate { view, camera: CAMERA, pose, centre: pose.centre() }
    }

    fn unit_box() -> Box3 {
        Box3 { min: [-1.0; 3], max: [1.0; 3] }
    }

    /// Cameras that look at the box from distances 3, 4, 5 ...: the coverage falls from view to view.
    fn row_of_cameras(count: u32) -> Vec<Candidate> {
        (0..count).map(|i| candidate(i, DVec3::new(0.0, 0.0, -3.0 - f64::from(i)), DVec3::ZERO)).collect()
    }

    #[test]
    fn edge_partitions_take_cameras_at_0_3_of_the_threshold() {
        let cameras = row_of_cameras(60);
        let config = PartitionConfig::default();
        let count = |layer, threshold: f64| {
            let chosen = select(&cameras, &[0], layer, &unit_box(), &config);
            assert_eq!(
                chosen.filled,
                MIN_CAMERAS.saturating_sub(chosen.views.len() - chosen.filled as usize) as u32
            );
            let passing =
                cameras.iter().filter(|c| coverage(&c.camera, &c.pose, &unit_box()) >= threshold).count();
            (chosen.views.len() - chosen.filled as usize, passing)
        };
        let (inner, inner_expected) = count(Layer::Inner, 0.25);
        let (edge, edge_expected) = count(Layer::Edge, 0.075);
        assert_eq!((inner, edge), (inner_expected, edge_expected));
        assert!(edge > inner && inner > 1, "inner {inner}, edge {edge}");
    }

    #[test]
    fn few_cameras_are_filled_up_with_the_next_best_by_coverage() {
        let cameras = row_of_cameras(60);
        let chosen = select(
            &cameras,
            &[40],
            Layer::Inner,
            &unit_box(),
            &PartitionConfig { visibility: 1.0, ..Default::default() },
        );
        let nearest: Vec<u32> = (0..MIN_CAMERAS as u32 - 1).chain([40]).collect();
        assert_eq!(chosen.views, nearest);
        assert_eq!(chosen.filled, MIN_CAMERAS as u32 - 1);
    }

    #[test]
    fn cameras_that_see_nothing_of_the_box_are_not_taken_to_fill_up() {
        let mut cameras = row_of_cameras(3);
        cameras
            .extend((3..40).map(|i| candidate(i, DVec3::new(0.0, 0.0, -9.0), DVec3::new(0.0, 0.0, -20.0))));
        let chosen = select(&cameras, &[0], Layer::Inner, &unit_box(), &PartitionConfig::default());
        assert_eq!(chosen.views, [0, 1, 2]);
    }

    #[test]
    fn own_cameras_and_those_inside_the_box_are_always_used() {
        let away = DVec3::new(0.0, 0.0, -50.0);
        let cameras = [
            candidate(0, DVec3::new(0.0, 0.0, -9.0), away),
            candidate(1, DVec3::new(0.0, 0.0, -0.999), away),
            candidate(2, DVec3::new(0.0, 0.0, -9.0), away),
        ];
        let chosen = select(&cameras, &[2], Layer::Inner, &unit_box(), &PartitionConfig::default());
        assert_eq!(chosen.views, [1, 2]);
    }

    #[test]
    fn the_depth_is_the_mean_of_medians_over_the_points_in_front() {
        let cameras = [
            candidate(0, DVec3::new(0.0, 0.0, -10.0), DVec3::ZERO),
            candidate(1, DVec3::new(0.0, 0.0, -20.0), DVec3::ZERO),
        ];
        let points = [-30.0, -1.0, 2.0, 5.0].map(|z| DVec3::new(0.3, -0.2, z));
        // The first point lies behind both; the median of the other three is at z = 2: 12 and 22.
        assert!((mean_depth(&cameras, &points) - 17.0).abs() < 1e-12);
        assert_eq!(mean_depth(&cameras, &[]), 0.0);
        assert_eq!(mean_depth(&[], &points), 0.0);
    }
}
