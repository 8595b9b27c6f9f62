//! Converts a camera with lens distortion to the pinhole camera that training uses.
//!
//! The pinhole has the size, the focal lengths and the principal point of the input camera. So the centre is
//! not enlarged, cameras without distortion stay unchanged, and the result is known without any picture.
//! Pixels of the pinhole outside the photograph are masked; parts of the photograph outside the pinhole are
//! lost.
//!
//! The forward distortion maps a pixel of the result to the photograph; it is exact, and nothing is inverted.

use super::{Camera, CameraModel, PinholeCamera};
use crate::{CoreError, Result};

/// Radial and tangential distortion on the plane z = 1, as in OpenCV. The radial factor is `(1 + k1 r^2 + k2
/// r^4 + k3 r^6 + k4 r^8) / (1 + d1 r^2 + d2 r^4 + d3 r^6)`; p1 and p2 are tangential.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Distortion {
    numerator: [f64; 4],
    denominator: [f64; 3],
    p: [f64; 2],
}

/// A source camera of the radial or OpenCV family and the pinhole that replaces it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Undistortion {
    pinhole: PinholeCamera,
    distortion: Distortion,
    /// Square of the radius on z = 1 up to which the distorted radius grows. Beyond it the polynomial folds
    /// back and would repeat parts of the photograph.
    r2_limit: f64,
}

impl Camera {
    /// The pinhole camera of the undistorted photograph, of the size of the photograph.
    ///
    /// # Errors
    /// When the model has no such camera (fisheye, division, panorama); the message states the command to
    /// run.
    pub fn pinhole(&self) -> Result<PinholeCamera> {
        self.undistortion().map(|undistortion| undistortion.pinhole)
    }

    /// The mapping from photographs of this camera to those of [`Camera::pinhole`].
    pub(crate) fn undistortion(&self) -> Result<Undistortion> {
        self.check().map_err(CoreError::Scene)?;
        let p = self.params.as_slice();
        let (fx, fy, cx, cy, distortion) = match (self.model, p) {
            (CameraModel::SimplePinhole, &[f, cx, cy]) => (f, f, cx, cy, Distortion::default()),
            (CameraModel::Pinhole, &[fx, fy, cx, cy]) => (fx, fy, cx, cy, Distortion::default()),
            (CameraModel::SimpleRadial, &[f, cx, cy, k]) => (f, f, cx, cy, Distortion::radial(k, 0.0)),
            (CameraModel::Radial, &[f, cx, cy, k1, k2]) => (f, f, cx, cy, Distortion::radial(k1, k2)),
            (CameraModel::Opencv, &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
                (fx, fy, cx, cy, Distortion { p: [p1, p2], ..Distortion::radial(k1, k2) })
            }
            (CameraModel::Opencv, &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4]) => {
                let numerator = [k1, k2, k3, k4];
                (fx, fy, cx, cy, Distortion { numerator, denominator: [0.0; 3], p: [p1, p2] })
            }
            (CameraModel::FullOpencv, &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
                let numerator = [k1, k2, k3, 0.0];
                (fx, fy, cx, cy, Distortion { numerator, denominator: [k4, k5, k6], p: [p1, p2] })
            }
            _ => {
                return Err(CoreError::Scene(format!(
                    "camera {} has the model {}, which Fathom does not train on; make pinhole pictures \
                     first: `colmap image_undistorter --image_path IMAGES --input_path MODEL --output_path \
                     OUT`, then train on OUT",
                    self.id,
                    self.model.name()
                )));
            }
        };
        let pinhole = PinholeCamera { width: self.width, height: self.height, fx, fy, cx, cy };
        Ok(Undistortion { pinhole, distortion, r2_limit: distortion.r2_limit(&pinhole) })
    }
}

impl Undistortion {
    /// The camera of the result.
    pub fn pinhole(&self) -> PinholeCamera {
        self.pinhole
    }

    /// Whether the result is the photograph itself.
    pub fn is_identity(&self) -> bool {
        self.distortion == Distortion::default()
    }

    /// The position in the photograph of the pinhole's (`u`, `v`); both in pixels from the top-left corner.
    ///
    /// `None` outside the photograph and beyond the radius where the model is valid.
    pub fn source_of(&self, u: f64, v: f64) -> Option<(f64, f64)> {
        let PinholeCamera { width, height, fx, fy, cx, cy } = self.pinhole;
        let (x, y) = ((u - cx) / fx, (v - cy) / fy);
        if x * x + y * y > self.r2_limit {
            return None;
        }
        let (x, y) = self.distortion.apply(x, y);
        let (u, v) = (fx * x + cx, fy * y + cy);
        let inside = u >= 0.0 && v >= 0.0 && u <= f64::from(width) && v <= f64::from(height);
        inside.then_some((u, v))
    }

    /// The inverse of [`Undistortion::source_of`]: the position in the pinhole of the photograph's (`u`,
    /// `v`). It may be outside the pinhole's picture.
    ///
    /// `None` beyond the radius where the model is valid, and where no position is found.
    pub fn result_of(&self, u: f64, v: f64) -> Option<[f64; 2]> {
        // Newton doubles the digits in each round; strong lenses need six.
        const ROUNDS: u32 = 20;
        /// Of a pixel: less than anything that stores the result can hold.
        const TOLERANCE_PX: f64 = 1e-6;
        if self.is_identity() {
            return Some([u, v]);
        }
        let PinholeCamera { fx, fy, cx, cy, .. } = self.pinhole;
        let (goal_x, goal_y) = ((u - cx) / fx, (v - cy) / fy);
        let (mut x, mut y) = (goal_x, goal_y);
        for _ in 0..ROUNDS {
            let (at_x, at_y) = self.distortion.apply(x, y);
            let (left_x, left_y) = (goal_x - at_x, goal_y - at_y);
            if (left_x * fx).hypot(left_y * fy) < TOLERANCE_PX {
                let valid = x * x + y * y <= self.r2_limit;
                return valid.then_some([fx * x + cx, fy * y + cy]);
            }
            let [[xx, xy], [yx, yy]] = self.distortion.slopes(x, y);
            let determinant = xx * yy - xy * yx;
            let (step_x, step_y) =
                ((yy * left_x - xy * left_y) / determinant, (xx * left_y - yx * left_x) / determinant);
            // A longer step would leave the part of the model that grows.
            let scale = (0.5 * (1.0 + x.hypot(y)) / step_x.hypot(step_y)).min(1.0);
            (x, y) = (x + scale * step_x, y + scale * step_y);
        }
        None
    }
}

impl Distortion {
    fn radial(k1: f64, k2: f64) -> Self {
        Self { numerator: [k1, k2, 0.0, 0.0], ..Self::default() }
    }

    fn factor(&self, r2: f64) -> f64 {
        let [k1, k2, k3, k4] = self.numerator;
        let [d1, d2, d3] = self.denominator;
        let numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        numerator / (1.0 + r2 * (d1 + r2 * (d2 + r2 * d3)))
    }

    fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let r2 = x * x + y * y;
        let factor = self.factor(r2);
        let [p1, p2] = self.p;
        (
            x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * factor + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }

    /// Derivatives of [`Distortion::apply`]: a row for each of its two results.
    fn slopes(&self, x: f64, y: f64) -> [[f64; 2]; 2] {
        let r2 = x * x + y * y;
        let [k1, k2, k3, k4] = self.numerator;
        let [d1, d2, d3] = self.denominator;
        let below = 1.0 + r2 * (d1 + r2 * (d2 + r2 * d3));
        let factor = self.factor(r2);
        let above_slope = k1 + r2 * (2.0 * k2 + r2 * (3.0 * k3 + r2 * 4.0 * k4));
        let below_slope = d1 + r2 * (2.0 * d2 + r2 * 3.0 * d3);
        // By r^2; r^2 changes by 2x and 2y.
        let slope = (above_slope - factor * below_slope) / below;
        let [p1, p2] = self.p;
        let cross = 2.0 * (slope * x * y + p1 * x + p2 * y);
        [
            [factor + 2.0 * slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x, cross],
            [cross, factor + 2.0 * slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x],
        ]
    }

    /// Walks outwards to the farthest corner of the pinhole until the distorted radius stops growing.
    fn r2_limit(&self, pinhole: &PinholeCamera) -> f64 {
        // A step of a thousandth of the diagonal: about a pixel of a usual training picture.
        const STEPS: u32 = 1000;
        if *self == Self::default() {
            return f64::INFINITY;
        }
        let PinholeCamera { width, height, fx, fy, cx, cy } = *pinhole;
        let x = cx.abs().max((f64::from(width) - cx).abs()) / fx;
        let y = cy.abs().max((f64::from(height) - cy).abs()) / fy;
        let corner = x.hypot(y);
        let mut reached = 0.0;
        for step in 1..=STEPS {
            let r = corner * f64::from(step) / f64::from(STEPS);
            let distorted = r * self.factor(r * r);
            // Phrased positively, so that NaN ends the walk.
            let grows = distorted > reached;
            if !grows {
                let last = corner * f64::from(step - 1) / f64::from(STEPS);
                return last * last;
            }
            reached = distorted;
        }
        f64::INFINITY
    }
}

#[cfg(test)]
mod tests {

    use super::*;

    fn camera(model: CameraModel, params: &[f64]) -> Camera {
        Camera { id: 7, model, width: 1000, height: 800, params: params.to_vec() }
    }

    #[test]
    fn pinholes_stay_unchanged() {
        let simple = camera(CameraModel::SimplePinhole, &[900.0, 501.0, 399.0]);
        let pinhole = simple.pinhole().unwrap();
        assert_eq!((pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy), (900.0, 900.0, 501.0, 399.0));
        assert_eq!((pinhole.width, pinhole.height), (1000, 800));
        assert!(simple.undistortion().unwrap().is_identity());
        let flat = camera(CameraModel::Opencv, &[900.0, 910.0, 500.0, 400.0, 0.0, 0.0, 0.0, 0.0]);
        assert!(flat.undistortion().unwrap().is_identity());
    }

    #[test]
    fn distortion_is_that_of_opencv_and_colmap() {
        // cv2.projectPoints([[[0.3, -0.2, 1]]], 0, 0, K, dist) of OpenCV 5.0.0 with K = [[900, 0, 500], [0,
        // 910, 400], [0, 0, 1]] and dist the parameters below in the same order. `Camera.img_from_cam` of
        // pycolmap 4.2.1 gives the same for these two; it is the source of the values of the first two
        // models.
        let lens = [900.0, 910.0, 500.0, 400.0, -0.1, 0.02, 0.001, -0.002, 0.003, 0.01, -0.004, 0.002];
        for (model, params, expected) in [
            (CameraModel::SimpleRadial, &[900.0, 500.0, 400.0, -0.12][..], (765.788, 222.808)),
            (CameraModel::Radial, &[900.0, 500.0, 400.0, -0.12, 0.03][..], (765.924_89, 222.716_74)),
            (CameraModel::Opencv, &lens[..8], (765.915_26, 220.713_983_999_999_98)),
            (CameraModel::FullOpencv, &lens[..], (765.587_738_543_691_6, 220.934_757_722_400_5)),
        ] {
            let undistortion = camera(model, params).undistortion().unwrap();
            let fy = undistortion.pinhole().fy;
            let (u, v) = undistortion.source_of(500.0 + 0.3 * 900.0, 400.0 - 0.2 * fy).unwrap();
            assert!((u - expected.0).abs() < 1e-9 && (v - expected.1).abs() < 1e-9, "{model:?}: {u}, {v}");
        }
    }

    #[test]
    fn models_of_one_family_agree_where_they_overlap() {
        let at =
            |model, params: &[f64]| camera(model, params).undistortion().unwrap().source_of(800.0, 650.0);
        let simple = at(CameraModel::SimpleRadial, &[900.0, 500.0, 400.0, -0.12]).unwrap();
        let same = [
            at(CameraModel::Radial, &[900.0, 500.0, 400.0, -0.12, 0.0]),
            at(CameraModel::Opencv, &[900.0, 900.0, 500.0, 400.0, -0.12, 0.0, 0.0, 0.0]),
            at(CameraModel::Opencv, &[900.0, 900.0, 500.0, 400.0, -0.12, 0.0, 0.0, 0.0, 0.0, 0.0]),
            at(
                CameraModel::FullOpencv,
                &[900.0, 900.0, 500.0, 400.0, -0.12, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            ),
        ];
        for other in same {
            assert_eq!(other.unwrap(), simple);
        }
    }

    #[test]
    fn a_pixel_of_a_photograph_returns_from_the_pinhole() {
        let lens = [900.0, 910.0, 500.0, 400.0, -0.1, 0.02, 0.001, -0.002, 0.003, 0.01, -0.004, 0.002];
        for (model, params) in [
            (CameraModel::Pinhole, &[900.0, 910.0, 500.0, 400.0][..]),
            (CameraModel::SimpleRadial, &[900.0, 500.0, 400.0, -0.2]),
            (CameraModel::Radial, &[900.0, 500.0, 400.0, 0.12, 0.03]),
            (CameraModel::Opencv, &lens[..8]),
            (CameraModel::Opencv, &lens[..10]),
            (CameraModel::FullOpencv, &lens[..]),
        ] {
            let undistortion = camera(model, params).undistortion().unwrap();
            let mut found = 0;
            for (u, v) in
                (0..=20).flat_map(|i| (0..=20).map(move |j| (f64::from(i) * 50.0, f64::from(j) * 40.0)))
            {
                let Some((x, y)) = undistortion.source_of(u, v) else { continue };
                found += 1;
                let [back_u, back_v] = undistortion.result_of(x, y).unwrap();
                assert!((back_u - u).hypot(back_v - v) < 1e-5, "{model:?}: {back_u} {back_v} for {u} {v}");
            }
            assert!(found > 200, "{model:?}: {found}");
        }
        // Beyond the largest distorted radius of this lens, 0.406 of its focal length, no pixel has a place.
        let strong = camera(CameraModel::SimpleRadial, &[900.0, 500.0, 400.0, -0.9]).undistortion().unwrap();
        assert!(strong.result_of(500.0 + 0.40 * 900.0, 400.0).is_some());
        assert!(strong.result_of(500.0 + 0.45 * 900.0, 400.0).is_none());
        assert!(strong.result_of(f64::NAN, 3.0).is_none());
    }

    #[test]
    fn pixels_beyond_the_fold_of_the_polynomial_have_no_source() {
        // r (1 - 0.9 r^2) has its maximum at r = sqrt(1 / 2.7) = 0.6086; the corner of this camera is at
        // 0.711.
        let strong = camera(CameraModel::SimpleRadial, &[900.0, 500.0, 400.0, -0.9]).undistortion().unwrap();
        assert!(strong.source_of(500.0 + 900.0 * 0.55, 400.0).is_some());
        assert!(strong.source_of(999.5, 799.5).is_none());
    }

    #[test]
    fn pincushion_leaves_pixels_without_source_but_barrel_does_not() {
        let corner = |k| {
            camera(CameraModel::SimpleRadial, &[900.0, 500.0, 400.0, k])
                .undistortion()
                .unwrap()
                .source_of(0.5, 0.5)
        };
        assert!(corner(0.05).is_none());
        assert!(corner(-0.05).is_some());
    }

    #[test]
    fn other_models_are_refused_by_name_with_the_command_that_helps() {
        let fisheye =
            camera(CameraModel::OpencvFisheye, &[900.0, 900.0, 500.0, 400.0, 0.01, 0.0, 0.0, 0.0]).pinhole();
        let message = fisheye.unwrap_err().to_string();
        assert!(message.contains("camera 7"), "{message}");
        assert!(message.contains("OPENCV_FISHEYE"), "{message}");
        assert!(message.contains("colmap image_undistorter"), "{message}");
    }
}
