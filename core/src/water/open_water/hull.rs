//! Finds the rays that leave the scene: those that pass above everything that was reconstructed.

use glam::DVec3;

use crate::scene::Points;
use crate::views::TrainView;

/// Maximum number of points for the outline, evenly thinned.
const MOST_POINTS: usize = 32_768;
/// Sectors of azimuth around a camera.
const SECTORS: usize = 180;
/// A sector has the highest elevation among itself and this many neighbours on either side.
const BESIDE: usize = 2;
/// Share of a sector's points that may be outliers.
const ASTRAY: f64 = 0.01;
/// Minimum elevation of a ray above the outline, radians: one degree.
const ABOVE: f64 = 0.0175;
/// Lowest elevation of a ray that may leave the scene, as a sine: ten degrees down. Steeper rays end on a
/// surface.
const LOWEST: f64 = -0.17;
/// Minimum length of the mean up axis of the cameras; below it, they agree on no direction.
const AGREE: f64 = 0.5;

/// The levelled frame of a scene: unit vectors in scene axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Levelled {
    pub(super) up: DVec3,
    pub(super) right: DVec3,
    pub(super) forward: DVec3,
}

impl Levelled {
    /// From the mean up axis of the cameras; `None` if they do not agree, as in a survey straight down.
    pub(super) fn of(views: &[TrainView]) -> Option<Self> {
        let mean = |axis: DVec3| {
            let sum: DVec3 = views.iter().map(|view| view.pose.rotation.inverse() * axis).sum();
            sum / views.len().max(1) as f64
        };
        let up = mean(DVec3::NEG_Y);
        if up.length() < AGREE {
            return None;
        }
        let up = up.normalize();
        let ahead = mean(DVec3::Z);
        let level = ahead - up * up.dot(ahead);
        let forward = if level.length() > 1e-3 { level.normalize() } else { up.any_orthonormal_vector() };
        Some(Self { up, right: forward.cross(up), forward })
    }
}

/// The reconstructed points, for the upper outline that a camera sees.
pub(super) struct Hull {
    levelled: Levelled,
    positions: Vec<DVec3>,
}

impl Hull {
    pub(super) fn new(levelled: Levelled, points: &Points) -> Self {
        let step = points.len().div_ceil(MOST_POINTS).max(1);
        let positions =
            points.positions.iter().step_by(step).map(|point| DVec3::from(point.map(f64::from))).collect();
        Self { levelled, positions }
    }

    /// The upper outline around `eye`: elevation by sector of azimuth, radians; -infinity in empty sectors.
    pub(super) fn outline(&self, eye: DVec3) -> Outline {
        let mut sectors = vec![Vec::new(); SECTORS];
        for position in &self.positions {
            let away = *position - eye;
            if away.length_squared() > 0.0 {
                let away = away.normalize();
                sectors[self.sector(away)].push(away.dot(self.levelled.up).asin());
            }
        }
        let tops: Vec<f64> = sectors
            .into_iter()
            .map(|mut elevations| {
                elevations.sort_by(|a, b| b.total_cmp(a));
                let astray = (elevations.len() as f64 * ASTRAY) as usize;
                elevations.get(astray.saturating_sub(1)).copied().unwrap_or(f64::NEG_INFINITY)
            })
            .collect();
        let beside = |sector: usize| {
            let near = (0..=2 * BESIDE).map(|k| tops[(sector + SECTORS + k - BESIDE) % SECTORS]);
            near.fold(f64::NEG_INFINITY, f64::max)
        };
        Outline((0..SECTORS).map(beside).collect())
    }

    /// Whether a ray along `direction`, unit length, passes above `outline`.
    pub(super) fn is_left_by(&self, outline: &Outline, direction: DVec3) -> bool {
        let elevation = direction.dot(self.levelled.up).asin();
        !self.is_steep(direction) && elevation > outline.0[self.sector(direction)] + ABOVE
    }

    /// Whether a ray along `direction`, unit length, points down so steeply that it must end on a surface.
    pub(super) fn is_steep(&self, direction: DVec3) -> bool {
        direction.dot(self.levelled.up) <= LOWEST
    }

    fn sector(&self, direction: DVec3) -> usize {
        let angle = direction.dot(self.levelled.right).atan2(direction.dot(self.levelled.forward));
        let turn = (angle / std::f64::consts::TAU).rem_euclid(1.0);
        ((turn * SECTORS as f64) as usize).min(SECTORS - 1)
    }
}

/// Highest elevation of the reconstructed points, by sector.
pub(super) struct Outline(Vec<f64>);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{PinholeCamera, Pose};

    fn view(from: DVec3, at: DVec3) -> TrainView {
        let camera = PinholeCamera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        TrainView {
            name: String::new(),
            camera,
            pose: Pose::looking_at(from, at, DVec3::Y),
            clear_range: 0.0,
        }
    }

    /// A wall 10 ahead, 2 high, on a floor that is 1 below the eye; y down.
    fn reef() -> Points {
        let mut points = Points::default();
        for x in -50..=50 {
            for k in 0..=20 {
                let (across, along) = (f64::from(x) * 0.2, f64::from(k) * 0.5);
                assert!(points.push([across, 1.0, along], [0; 3]));
                assert!(points.push([across, 1.0 - f64::from(k) * 0.1, 10.0], [0; 3]));
            }
        }
        points
    }

    #[test]
    fn only_rays_above_the_reef_leave_the_scene() {
        let views = [view(DVec3::ZERO, DVec3::Z)];
        let levelled = Levelled::of(&views).expect("a camera that looks ahead");
        assert!(
            (levelled.up - DVec3::NEG_Y).length() < 1e-9 && (levelled.forward - DVec3::Z).length() < 1e-9
        );
        let hull = Hull::new(levelled, &reef());
        let outline = hull.outline(DVec3::ZERO);
        let leaves = |y: f64, z: f64| hull.is_left_by(&outline, DVec3::new(0.0, y, z).normalize());
        assert!(leaves(-0.2, 1.0) && !leaves(-0.09, 1.0) && !leaves(0.05, 1.0));
        assert!(leaves(-0.05, -1.0), "nothing is behind the camera");
        assert!(!leaves(0.5, -1.0), "a ray pointing down may hit a floor that no view shows");
    }

    #[test]
    fn cameras_looking_down_at_all_headings_have_no_common_up() {
        let looking = |at: DVec3| view(DVec3::ZERO, at);
        let down: Vec<TrainView> = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]
            .map(|[x, z]| looking(DVec3::new(1e-3 * x, 1.0, 1e-3 * z)))
            .to_vec();
        assert_eq!(Levelled::of(&down), None);
        assert_eq!(Levelled::of(&[]), None);
    }
}
