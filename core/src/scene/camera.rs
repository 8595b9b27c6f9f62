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

/// A camera as the input gives it.
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
    pub params: Vec<f64>,
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
    /// The same camera for a picture resized to `width` x `height`.
    ///
    /// With pixel centres at +0.5 a resize is a pure scale of pixel coordinates (the half-pixel rule).
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }

    /// The size of this camera's picture when its longest side is at most `max_side`.
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

    /// Pose of a camera at `eye` whose z axis points at `target`, with `down` as near to its y axis as can be.
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
