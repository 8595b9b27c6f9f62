//! Which rays leave the scene: those that pass above everything that was reconstructed.

use glam::DVec3;

use crate::scene::Points;
use crate::views::TrainView;

/// Points that the outline is made of, evenly thinned.
const MOST_POINTS: usize = 32_768;
/// Sectors of azimuth around a camera.
const SECTORS: usize = 180;
/// A sector counts as far up as the highest of so many to either side.
const BESIDE: usize = 2;
/// Share of a sector's points that may be astray.
const ASTRAY: f64 = 0.01;
/// How much higher than the outline a ray must go, radians: a degree.
const ABOVE: f64 = 0.0175;
/// Rays further down than this end somewhere: sine of the elevation, of ten degrees.
const LOWEST: f64 = -0.17;
/// Cameras whose mean image axis is shorter agree on no direction as up.
const AGREE: f64 = 0.5;

/// The levelled frame of a scene: unit vectors in scene axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Levelled {
    pub(super) up: DVec3,
    pub(super) right: DVec3,
    pub(super) forward: DVec3,
}

impl Levelled {
    /// By the mean of what the cameras hold for up; `None` where they do not agree, as in a survey straight
    /// down.
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

/// What was reconstructed, as a camera sees its upper outline.
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

    /// The upper outline around `eye`: elevation by sector of azimuth, radians; -infinity where nothing is.
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

    /// Whether a ray along `direction`, unit length, goes so far down that it ends somewhere.
    pub(super) fn is_steep(&self, direction: DVec3) -> bool {
        direction.dot(self.levelled.up) <= LOWEST
    }

    fn sector(&self, direction: DVec3) -> usize {
        let angle = direction.dot(self.levelled.right).atan2(direction.dot(self.levelled.forward));
        let turn = (angle / std::f64::consts::TAU).rem_euclid(1.0);
        ((turn * SECTORS as f64) as usize).min(SECTORS - 1)
    }
}

/// Elevation of the highest that was reconstructed, by sector.
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
    fn rays_above_the_reef_leave_it_and_rays_into_it_or_steeply_down_do_not() {
        let views = [view(DVec3::ZERO, DVec3::Z)];
        let levelled = Levelled::of(&views).expect("a camera that looks ahead");
        assert!(
            (levelled.up - DVec3::NEG_Y).length() < 1e-9 && (levelled.forward - DVec3::Z).length() < 1e-9
        );
        let hull = Hull::new(levelled, &reef());
        let outline = hull.outline(DVec3::ZERO);
        let leaves = |y: f64, z: f64| hull.is_left_by(&outline, DVec3::new(0.0, y, z).normalize());
        assert!(leaves(-0.2, 1.0) && !leaves(-0.09, 1.0) && !leaves(0.05, 1.0));
        assert!(leaves(-0.05, -1.0), "behind the camera nothing is");
        assert!(!leaves(0.5, -1.0), "but what looks down may meet a floor that nobody saw");
    }

    #[test]
    fn cameras_that_look_straight_down_in_all_turns_agree_on_no_up() {
        let looking = |at: DVec3| view(DVec3::ZERO, at);
        let down: Vec<TrainView> = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]
            .map(|[x, z]| looking(DVec3::new(1e-3 * x, 1.0, 1e-3 * z)))
            .to_vec();
        assert_eq!(Levelled::of(&down), None);
        assert_eq!(Levelled::of(&[]), None);
    }
}
