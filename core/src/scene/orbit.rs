//! A circular flight around a model without known cameras or scale.

use std::f64::consts::TAU;

use glam::DVec3;

use super::{PinholeCamera, Pose};
use crate::gaussians::Gaussians;
use crate::{CoreError, Result};

/// Distance of the cameras, in median distances of the Gaussians from the centre. An object that was scanned
/// from all sides fills [`FIELD_OF_VIEW_DEGREES`]. A shell of sky or open water around the scene stays behind
/// the cameras.
const DISTANCE: f64 = 2.0;
/// Elevation of the cameras above the centre, degrees.
const ELEVATION_DEGREES: f64 = 20.0;
/// Field of view of the shorter side.
const FIELD_OF_VIEW_DEGREES: f64 = 60.0;
/// Logit of an opacity of 1/255, below which a Gaussian is not drawn.
const LEAST_LOGIT: f32 = -5.537_334_3;

/// A circle of cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Orbit {
    /// The point that they look at, world.
    pub centre: DVec3,
    /// Their distance from it, scene units.
    pub radius: f64,
}

impl Orbit {
    /// An orbit around the median of the visible Gaussians, so that outliers do not count.
    ///
    /// # Errors
    /// [`CoreError::Scene`] when the model has no visible Gaussian.
    pub fn around(model: &Gaussians) -> Result<Self> {
        let seen: Vec<(DVec3, f64)> = (0..model.len())
            .map(|index| {
                let largest = model.log_scales[index].into_iter().fold(f32::NEG_INFINITY, f32::max);
                (DVec3::from(model.means[index].map(f64::from)), f64::from(largest).exp())
            })
            .zip(&model.opacity_logits)
            .filter(|((mean, scale), logit)| mean.is_finite() && scale.is_finite() && **logit >= LEAST_LOGIT)
            .map(|(seen, _)| seen)
            .collect();
        let axis = |axis: usize| median(seen.iter().map(|(mean, _)| mean[axis]).collect());
        let nothing = || {
            CoreError::Scene("the model has no visible Gaussian; there is nothing to fly around".to_owned())
        };
        let (Some(x), Some(y), Some(z)) = (axis(0), axis(1), axis(2)) else { return Err(nothing()) };
        let centre = DVec3::new(x, y, z);
        // A Gaussian reaches two standard deviations; a model of a single one has no other size.
        let reach = median(seen.iter().map(|(mean, scale)| mean.distance(centre) + 2.0 * scale).collect());
        Ok(Self { centre, radius: DISTANCE * reach.ok_or_else(nothing)? })
    }

    /// `count` poses at even angles, once around `up`, from slightly above. The first looks along +z as
    /// closely as possible.
    pub fn poses(&self, up: DVec3, count: u32) -> impl ExactSizeIterator<Item = Pose> {
        let up = up.normalize();
        let forward = if up.z.abs() < 0.9 { DVec3::Z } else { DVec3::Y };
        let back = -(forward - up * forward.dot(up)).normalize();
        let side = up.cross(back);
        let (height, across) = ELEVATION_DEGREES.to_radians().sin_cos();
        (0..count).map(move |index| {
            let (sine, cosine) = (TAU * f64::from(index) / f64::from(count)).sin_cos();
            let direction = across * (cosine * back + sine * side) + height * up;
            Pose::looking_at(self.centre + self.radius * direction, self.centre, -up)
        })
    }

    /// The camera for pictures of this size.
    pub fn camera(width: u32, height: u32) -> PinholeCamera {
        let half = f64::from(width.min(height)) / 2.0;
        let focal = half / (FIELD_OF_VIEW_DEGREES / 2.0).to_radians().tan();
        let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        PinholeCamera { width, height, fx: focal, fy: focal, cx, cy }
    }
}

/// The median; the upper one of two. `None` without values.
fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ball of Gaussians of radius 1 around `centre`, and some that are far away, not finite or invisible.
    fn ball(centre: DVec3) -> Gaussians {
        let mut model = Gaussians::empty(0);
        let mut push = |mean: DVec3, logit: f32| {
            model.means.push(mean.as_vec3().to_array());
            model.quats.push([1.0, 0.0, 0.0, 0.0]);
            model.log_scales.push([-7.0; 3]);
            model.opacity_logits.push(logit);
            model.sh_coeffs.push([0.0; 3]);
        };
        for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
            for _ in 0..10 {
                push(centre + axis, 2.0);
                push(centre - axis, 2.0);
            }
        }
        push(DVec3::splat(1e6), 2.0);
        push(DVec3::new(f64::NAN, 0.0, 0.0), 2.0);
        for _ in 0..100 {
            push(DVec3::splat(-50.0), -9.0);
        }
        model
    }

    #[test]
    fn outliers_and_invisible_gaussians_do_not_move_the_orbit() {
        let centre = DVec3::new(10.0, -3.0, 5.0);
        let orbit = Orbit::around(&ball(centre)).expect("an orbit");
        // Means are f32.
        assert!(orbit.centre.distance(centre) < 1e-5, "{orbit:?}");
        assert!((orbit.radius - 2.0).abs() < 0.01, "{orbit:?}");
    }

    #[test]
    fn every_camera_of_an_orbit_looks_at_the_centre_from_above() {
        let orbit = Orbit { centre: DVec3::new(1.0, 2.0, 3.0), radius: 4.0 };
        for up in [DVec3::X, DVec3::NEG_Y, DVec3::Z, DVec3::new(1.0, 1.0, 0.2)] {
            let poses: Vec<Pose> = orbit.poses(up, 12).collect();
            assert_eq!(poses.len(), 12);
            for pose in &poses {
                let middle = pose.transform(orbit.centre);
                assert!(middle.distance(DVec3::new(0.0, 0.0, 4.0)) < 1e-9, "{middle}");
                assert!(pose.transform(orbit.centre + up).y < -0.5, "up {up} is not up in the picture");
                let height = (pose.centre() - orbit.centre).dot(up.normalize());
                assert!((height - 4.0 * 20.0_f64.to_radians().sin()).abs() < 1e-9, "{height}");
            }
            let step = poses[0].centre().distance(poses[1].centre());
            let back = poses[11].centre().distance(poses[0].centre());
            assert!((step - back).abs() < 1e-9, "the circle closes: {step} {back}");
        }
        let first = orbit.poses(DVec3::NEG_Y, 4).next().expect("a pose");
        assert!(first.forward().z > 0.9, "{}", first.forward());
    }

    #[test]
    fn one_gaussian_has_an_orbit_and_an_empty_model_has_none() {
        let mut one = Gaussians::empty(0);
        let refused = Orbit::around(&one).map(|_| ()).map_err(|error| error.to_string());
        assert!(refused.is_err_and(|said| said.contains("no visible Gaussian")));
        one.means.push([1.0; 3]);
        one.quats.push([1.0, 0.0, 0.0, 0.0]);
        one.log_scales.push([0.0, -1.0, -1.0]);
        one.opacity_logits.push(0.0);
        one.sh_coeffs.push([0.0; 3]);
        let orbit = Orbit::around(&one).expect("an orbit");
        assert!((orbit.radius - 4.0).abs() < 1e-6, "two deviations of 1, twice: {orbit:?}");
    }

    #[test]
    fn the_shorter_side_has_the_field_of_view() {
        for camera in [Orbit::camera(300, 200), Orbit::camera(200, 300)] {
            assert!((2.0 * (100.0 / camera.fx).atan().to_degrees() - 60.0).abs() < 1e-9);
            assert_eq!((camera.fx, camera.cx * 2.0), (camera.fy, f64::from(camera.width)));
        }
    }
}
