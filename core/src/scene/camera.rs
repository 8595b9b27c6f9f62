//! Camera models and poses.

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// The 18 camera models of COLMAP 4.1 (`sensor/models.h`), with their numbers in `cameras.bin`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
#[expect(missing_docs, reason = "the names are COLMAP's")]
pub enum CameraModel {
    SimplePinhole = 0,
    Pinhole = 1,
    SimpleRadial = 2,
    Radial = 3,
    Opencv = 4,
    OpencvFisheye = 5,
    FullOpencv = 6,
    Fov = 7,
    SimpleRadialFisheye = 8,
    RadialFisheye = 9,
    ThinPrismFisheye = 10,
    RadTanThinPrismFisheye = 11,
    SimpleDivision = 12,
    Division = 13,
    SimpleFisheye = 14,
    Fisheye = 15,
    Eucm = 16,
    Equirectangular = 17,
}

impl CameraModel {
    /// All models, in the order of COLMAP's numbers.
    const ALL: [(Self, &'static str, usize); 18] = [
        (Self::SimplePinhole, "SIMPLE_PINHOLE", 3),
        (Self::Pinhole, "PINHOLE", 4),
        (Self::SimpleRadial, "SIMPLE_RADIAL", 4),
        (Self::Radial, "RADIAL", 5),
        (Self::Opencv, "OPENCV", 8),
        (Self::OpencvFisheye, "OPENCV_FISHEYE", 8),
        (Self::FullOpencv, "FULL_OPENCV", 12),
        (Self::Fov, "FOV", 5),
        (Self::SimpleRadialFisheye, "SIMPLE_RADIAL_FISHEYE", 4),
        (Self::RadialFisheye, "RADIAL_FISHEYE", 5),
        (Self::ThinPrismFisheye, "THIN_PRISM_FISHEYE", 12),
        (Self::RadTanThinPrismFisheye, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
        (Self::SimpleDivision, "SIMPLE_DIVISION", 4),
        (Self::Division, "DIVISION", 5),
        (Self::SimpleFisheye, "SIMPLE_FISHEYE", 3),
        (Self::Fisheye, "FISHEYE", 4),
        (Self::Eucm, "EUCM", 6),
        (Self::Equirectangular, "EQUIRECTANGULAR", 2),
    ];

    /// The model with COLMAP's number in `cameras.bin`.
    pub fn from_number(number: u32) -> Option<Self> {
        Self::ALL.get(number as usize).map(|row| row.0)
    }

    /// The model with COLMAP's name in `cameras.txt`.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().find(|row| row.1 == name).map(|row| row.0)
    }

    /// COLMAP's name.
    pub fn name(self) -> &'static str {
        Self::ALL[self as usize].1
    }

    /// Number of parameters in COLMAP's files; `cameras.bin` cannot be read with a wrong one.
    pub fn param_count(self) -> usize {
        Self::ALL[self as usize].2
    }

    /// Number of focal lengths at the start of the parameters.
    fn focal_count(self) -> usize {
        match self {
            Self::SimplePinhole
            | Self::SimpleRadial
            | Self::Radial
            | Self::SimpleRadialFisheye
            | Self::RadialFisheye
            | Self::SimpleDivision
            | Self::SimpleFisheye => 1,
            Self::Equirectangular => 0,
            _ => 2,
        }
    }
}

/// Largest distance of a camera or a point from the origin along an axis, scene units. Squares of such
/// numbers still fit f32, which training uses. The distance to the moon is 4e11 millimetres.
pub(super) const MAX_COORDINATE: f64 = 1e12;

/// Largest parameter of a camera. Lenses are far below it, and its powers in the distortion formula fit f64.
const MAX_PARAMETER: f64 = 1e9;

/// Smallest focal length, pixels. No lens comes near it, and quotients by it stay finite.
const MIN_FOCAL: f64 = 1e-3;

/// Whether a position is usable: finite, and within [`MAX_COORDINATE`] on every axis.
pub(super) fn is_near(place: DVec3) -> bool {
    place.abs().max_element() <= MAX_COORDINATE && !place.is_nan()
}

/// A camera as in the input.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// The input's number.
    pub id: u32,
    /// Model of projection and distortion.
    pub model: CameraModel,
    /// Columns of its photographs.
    pub width: u32,
    /// Rows of its photographs.
    pub height: u32,
    /// Parameters in COLMAP's order for the model; pixels and distortion coefficients.
    ///
    /// One addition: OPENCV may have ten parameters instead of eight. The last two are the coefficients of
    /// r^6 and r^8, k3 and k4 in nerfstudio, which no model of COLMAP has.
    pub params: Vec<f64>,
}

impl Camera {
    /// Checks size, parameters and focal lengths; the message names the camera but not the file.
    pub(super) fn check(&self) -> Result<(), String> {
        let Self { id, model, width, height, params } = self;
        // The largest side that JPEG can store; no camera comes near it.
        const MAX_SIDE: u32 = 65_535;
        if !(1..=MAX_SIDE).contains(width) || !(1..=MAX_SIDE).contains(height) {
            return Err(format!(
                "camera {id} has the size {width}x{height}; each side must be between 1 and {MAX_SIDE} pixels"
            ));
        }
        let expected = model.param_count();
        let extended = *model == CameraModel::Opencv && params.len() == 10;
        if params.len() != expected && !extended {
            return Err(format!(
                "camera {id} has {} parameters, but {} takes {expected}",
                params.len(),
                model.name()
            ));
        }
        // Phrased positively, so that NaN is out of range.
        let usable = |value: &f64| value.abs() <= MAX_PARAMETER;
        if let Some(index) = params.iter().position(|value| !usable(value)) {
            return Err(format!(
                "parameter {} of camera {id} ({}) is {}; it must lie within {MAX_PARAMETER:e} of 0: run the \
                 reconstruction again or remove the camera",
                index + 1,
                model.name(),
                params[index]
            ));
        }
        match params[..model.focal_count()].iter().find(|focal| **focal < MIN_FOCAL) {
            Some(focal) => Err(format!(
                "camera {id} has the focal length {focal}; it must be above 0, and at least {MIN_FOCAL} pixels"
            )),
            None => Ok(()),
        }
    }
}

/// An ideal camera: pixels from the top-left corner, pixel centres at +0.5.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PinholeCamera {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Focal length in x, pixels.
    pub fx: f64,
    /// Focal length in y, pixels.
    pub fy: f64,
    /// Principal point in x, pixels.
    pub cx: f64,
    /// Principal point in y, pixels.
    pub cy: f64,
}

impl PinholeCamera {
    /// Unit direction through the middle of pixel `index` (row-major), camera frame.
    pub fn direction(&self, index: usize) -> DVec3 {
        let width = self.width as usize;
        let (x, y) = ((index % width) as f64 + 0.5, (index / width) as f64 + 0.5);
        DVec3::new((x - self.cx) / self.fx, (y - self.cy) / self.fy, 1.0).normalize()
    }

    /// The same camera for a picture resized to `width` x `height`.
    ///
    /// With pixel centres at +0.5 a resize is a pure scale of pixel coordinates (the half-pixel rule).
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }

    /// A camera at the same position for pictures of another size and aspect ratio. They show everything that
    /// this one sees, and more at the sides if the aspect ratios differ. The scale is the same in x and y, so
    /// nothing is distorted.
    pub fn reshaped(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        let scale = sx.min(sy);
        // Distances of the principal point from the middle of the picture scale with it.
        let middle = |principal: f64, old: u32, new: u32| {
            f64::from(new) / 2.0 + (principal - f64::from(old) / 2.0) * scale
        };
        Self {
            width,
            height,
            fx: self.fx * scale,
            fy: self.fy * scale,
            cx: middle(self.cx, self.width, width),
            cy: middle(self.cy, self.height, height),
        }
    }

    /// This camera resized so that its longest side is at most `max_side`.
    pub fn fitted(&self, max_side: u32) -> Self {
        let longest = self.width.max(self.height);
        if longest <= max_side {
            return *self;
        }
        let scale = f64::from(max_side) / f64::from(longest);
        let side = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
        self.resized(side(self.width), side(self.height))
    }
}

/// World to camera: `x_camera = rotation * x_world + translation`; camera x right, y down, z forward.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Rotation from world to camera. glam stores x y z w.
    pub rotation: DQuat,
    /// Translation, scene units.
    pub translation: DVec3,
}

impl Pose {
    /// From COLMAP's order: Hamilton quaternion w x y z (normalised here) and translation.
    pub fn from_wxyz(quat_wxyz: [f64; 4], translation: [f64; 3]) -> Self {
        let [w, x, y, z] = quat_wxyz;
        Self { rotation: DQuat::from_xyzw(x, y, z, w).normalize(), translation: translation.into() }
    }

    /// Whether the rotation has unit length to 1e-6 and the camera is within 1e12 scene units of the origin
    /// on every axis, so that nothing computed from it overflows.
    pub fn is_sound(&self) -> bool {
        is_near(self.translation) && is_near(self.centre()) && (self.rotation.length() - 1.0).abs() < 1e-6
    }

    /// Pose of a camera at `eye` whose z axis points at `target` and whose y axis is as close to `down` as
    /// possible.
    pub fn looking_at(eye: DVec3, target: DVec3, down: DVec3) -> Self {
        let z = (target - eye).normalize();
        let x = down.cross(z).normalize();
        let y = z.cross(x);
        let rotation = DQuat::from_mat3(&DMat3::from_cols(x, y, z).transpose()).normalize();
        Self { rotation, translation: -(rotation * eye) }
    }

    /// Centre of the camera, world.
    pub fn centre(&self) -> DVec3 {
        -(self.rotation.inverse() * self.translation)
    }

    /// Viewing direction (camera z), world, unit.
    pub fn forward(&self) -> DVec3 {
        self.rotation.inverse() * DVec3::Z
    }

    /// Camera y, world, unit: down in the picture.
    pub fn down(&self) -> DVec3 {
        self.rotation.inverse() * DVec3::Y
    }

    /// A world point in the camera's frame.
    pub fn transform(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_aspect_ratio_shows_all_that_the_camera_sees() {
        let camera = PinholeCamera { width: 100, height: 50, fx: 80.0, fy: 82.0, cx: 48.0, cy: 30.0 };
        for (width, height, scale) in [(200, 100, 2.0), (200, 400, 2.0), (300, 25, 0.5), (1000, 500, 10.0)] {
            let other = camera.reshaped(width, height);
            assert_eq!((other.width, other.height), (width, height));
            assert_eq!((other.fx, other.fy), (80.0 * scale, 82.0 * scale), "{width}x{height}");
            // The old picture must be centred inside the new one.
            let left = other.cx - camera.cx * scale;
            let top = other.cy - camera.cy * scale;
            assert!(left >= 0.0 && top >= 0.0, "{other:?}");
            assert_eq!(left, (f64::from(width) - 100.0 * scale) / 2.0);
            assert_eq!(top, (f64::from(height) - 50.0 * scale) / 2.0);
        }
        assert_eq!(camera.reshaped(200, 100), camera.resized(200, 100));
    }
}
