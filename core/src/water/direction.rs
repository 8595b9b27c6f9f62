//! The colour of open water by direction: brighter towards the surface and the sun.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::Water;

/// Change of the open-water colour with direction (SMP-UWGS eq. 7 has `B_inf(x, y)`).
///
/// Along the unit direction `d`, from the camera into the scene, channel c is `b_inf[c] * exp(clamp(slopes[c]
/// . (d - middle), -most, most))`. Axes are those of the scene. The clamp keeps the colour in the observed
/// range, since no photograph shows the other directions.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ByDirection {
    /// Direction in which the colour is `b_inf`, unit length, scene axes.
    pub middle: [f64; 3],
    /// Change of the logarithm of the colour by direction, red, green and blue, scene axes.
    pub slopes: [[f64; 3]; 3],
    /// Largest change of the logarithm, above 0.
    pub most: f64,
}

impl ByDirection {
    /// Largest `most`: eight times brighter or darker.
    pub const MOST: f64 = 2.08;

    /// Factors on `b_inf` along `direction`, unit length, scene axes.
    pub fn factors(&self, direction: DVec3) -> [f64; 3] {
        let offset = direction - DVec3::from(self.middle);
        self.slopes.map(|slope| DVec3::from(slope).dot(offset).clamp(-self.most, self.most).exp())
    }

    /// The water along `direction`, unit length, scene axes.
    pub fn along(&self, water: &Water, direction: DVec3) -> Water {
        let factors = self.factors(direction);
        Water { b_inf: std::array::from_fn(|c| water.b_inf[c] * factors[c]), ..*water }
    }

    /// The same after the scene's axes were rotated by `turn`.
    #[must_use]
    pub fn turned(&self, turn: glam::DQuat) -> Self {
        let turned = |v: [f64; 3]| (turn * DVec3::from(v)).to_array();
        Self { middle: turned(self.middle), slopes: self.slopes.map(turned), most: self.most }
    }

    /// Whether all values are finite, the middle has unit length, and the colour stays within a factor of
    /// eight.
    pub fn is_sound(&self) -> bool {
        let length = DVec3::from(self.middle).length();
        (length - 1.0).abs() < 1e-6
            && self.slopes.iter().flatten().all(|slope| slope.is_finite())
            && self.most > 0.0
            && self.most <= Self::MOST
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn brighter_upwards() -> ByDirection {
        ByDirection {
            middle: [0.0, 0.0, 1.0],
            slopes: [[0.0, -1.0, 0.0], [0.0, -2.0, 0.0], [0.3, -8.0, 0.0]],
            most: 1.2,
        }
    }

    #[test]
    fn colour_grows_upwards_from_the_middle_to_a_limit() {
        let by_direction = brighter_upwards();
        assert!(by_direction.is_sound());
        assert_eq!(by_direction.along(&Water::COASTAL, DVec3::Z), Water::COASTAL);
        let up = by_direction.factors(DVec3::new(0.0, -0.1, 0.995));
        assert!((up[0] - 0.1_f64.exp()).abs() < 1e-12 && (up[1] - 0.2_f64.exp()).abs() < 1e-12, "{up:?}");
        let overhead = by_direction.factors(-DVec3::Y);
        assert!((overhead[2] - 1.2_f64.exp()).abs() < 1e-12, "{overhead:?}");
    }

    #[test]
    fn rotating_the_axes_rotates_the_colours() {
        let turn = glam::DQuat::from_rotation_x(0.7) * glam::DQuat::from_rotation_y(-1.1);
        let (before, after) = (brighter_upwards(), brighter_upwards().turned(turn));
        assert!(after.is_sound());
        for direction in [DVec3::X, DVec3::new(0.6, -0.48, 0.64)] {
            for (a, b) in before.factors(direction).into_iter().zip(after.factors(turn * direction)) {
                assert!((a - b).abs() < 1e-12, "{a} {b}");
            }
        }
    }

    #[test]
    fn broken_colours_by_direction_are_not_sound() {
        let sound = brighter_upwards();
        for broken in [
            ByDirection { middle: [0.0; 3], ..sound },
            ByDirection { slopes: [[f64::NAN; 3]; 3], ..sound },
            ByDirection { most: 0.0, ..sound },
            ByDirection { most: 40.0, ..sound },
        ] {
            assert!(!broken.is_sound(), "{broken:?}");
        }
    }
}
