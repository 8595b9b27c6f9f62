//! How a camera sees a set of disks: straight, mirrored by a water surface, or refracted by it.
//!
//! Reflected rays are those of the mirrored eye (WSGS, eq. 8), so the mirrored camera is a camera like any
//! other; only the determinant of its axes is -1. A refracted disk appears where the line of sight to its
//! centre crosses the surface.

use glam::{DMat3, DVec2, DVec3};

use crate::{DISK_BLUR, NEAR};
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_core::surface::Surface;
use fathom_core::surface::optics::{Crossing, Motion};

/// The camera, and the water surface between it and the disks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sight {
    /// From scene axes to the axes of the camera, or of the mirrored camera.
    pub world_to_camera: DMat3,
    /// The eye or the mirrored eye, scene axes.
    pub eye: DVec3,
    bent: Option<Surface>,
    mirror: Option<Surface>,
}

impl Sight {
    /// Without a surface.
    pub fn straight(pose: &Pose) -> Self {
        Self {
            world_to_camera: DMat3::from_quat(pose.rotation),
            eye: pose.centre(),
            bent: None,
            mirror: None,
        }
    }

    /// Of the disks above `surface`, through rays that it reflects.
    pub fn reflected(pose: &Pose, surface: &Surface) -> Self {
        let straight = Self::straight(pose);
        let n = surface.normal;
        let across = DMat3::from_cols(n.x * n, n.y * n, n.z * n);
        Self {
            world_to_camera: straight.world_to_camera * (DMat3::IDENTITY - 2.0 * across),
            eye: straight.eye - 2.0 * surface.height(straight.eye) * n,
            bent: None,
            mirror: Some(*surface),
        }
    }

    /// Of the disks below `surface`, through rays that it refracts.
    pub fn refracted(pose: &Pose, surface: &Surface) -> Self {
        let straight = Self::straight(pose);
        let normal = straight.world_to_camera * surface.normal;
        Self { bent: Some(Surface { normal, offset: -surface.height(straight.eye), ..*surface }), ..straight }
    }

    /// A point in the camera's frame.
    pub fn transform(&self, point: DVec3) -> DVec3 {
        self.world_to_camera * (point - self.eye)
    }

    /// Whether the surface refracts the rays.
    pub fn is_bent(&self) -> bool {
        self.bent.is_some()
    }

    /// Whether rays of this kind can reach a point, scene axes.
    pub(crate) fn reaches(&self, point: DVec3) -> bool {
        self.mirror.is_none_or(|surface| surface.height(point) > 0.0)
    }

    /// The point in the camera's frame towards which the eye looks to see `m`, also in that frame. `None` if
    /// `m` is not below a surface that refracts.
    pub fn apparent(&self, m: DVec3) -> Option<DVec3> {
        match &self.bent {
            None => Some(m),
            Some(surface) => crossing(surface, m).map(|crossing| crossing.at),
        }
    }

    /// Where the last straight part of the line of sight to `m` begins, camera's frame: at the eye, or at the
    /// surface.
    pub(crate) fn start(&self, m: DVec3) -> DVec3 {
        if self.is_bent() { self.apparent(m).unwrap_or(DVec3::ZERO) } else { DVec3::ZERO }
    }

    /// How the apparent point moves when `m` moves.
    fn moved(&self, m: DVec3, by: DVec3) -> DVec3 {
        let Some(surface) = &self.bent else { return by };
        let motion = Motion { point: by, ..Motion::default() };
        crossing(surface, m).map_or(DVec3::ZERO, |crossing| crossing.moved(DVec3::ZERO, m, surface, &motion))
    }

    /// The gradient of `m` from that of the apparent point.
    pub(crate) fn pulled(&self, m: DVec3, v: DVec3) -> DVec3 {
        DVec3::from_array(DVec3::AXES.map(|axis| v.dot(self.moved(m, axis))))
    }

    /// The gradient of `m` from that of its offset from where the line of sight begins.
    pub(crate) fn offset_pulled(&self, m: DVec3, v: DVec3) -> DVec3 {
        if self.is_bent() { v - self.pulled(m, v) } else { v }
    }

    /// By which disks are sorted: their depth, or the path to their centre under water.
    pub fn depth(&self, m: DVec3) -> f64 {
        if self.is_bent() { (m - self.start(m)).length().max(1.001 * NEAR) } else { m.z }
    }

    /// Covariance (xx, xy, yy) in px^2 of an ellipse, around the apparent centre, that holds a refracted disk
    /// of radius `reach` (in standard deviations). `half` are its axes times its scales. `None` where the
    /// disk reaches behind the camera, and without an edge.
    ///
    /// The outline is not an ellipse. That of a small disk lies in the ellipse of its centre, a bit widened.
    /// For others the ellipse grows until it holds points of the outline.
    pub(crate) fn ellipse(
        &self,
        m: DVec3,
        half: [DVec3; 2],
        reach: f64,
        camera: &PinholeCamera,
    ) -> Option<[f64; 3]> {
        if !reach.is_finite() {
            return None;
        }
        let q = self.start(m);
        let focal = DVec2::new(camera.fx, camera.fy);
        let [a, b] = half.map(|axis| {
            let moved = self.moved(m, axis);
            focal / q.z * (moved.truncate() - moved.z / q.z * q.truncate())
        });
        let pad = (DISK_BLUR.sqrt() + 0.5 / reach.max(1e-3)).powi(2);
        let [xx, xy, yy] = [a.x * a.x + b.x * b.x + pad, a.x * a.y + b.x * b.y, a.y * a.y + b.y * b.y + pad];
        let scale = half[0].length().max(half[1].length());
        let size = scale / (q.length() + (m - q).length());
        let mut wide = 1.0 + 6.0 * size;
        if size > SMALL {
            for k in 0..OUTLINE {
                let turn = std::f64::consts::TAU * f64::from(k) / f64::from(OUTLINE);
                let out = reach * (turn.cos() * half[0] + turn.sin() * half[1]);
                let seen = self.start(self.wet_end(m, out));
                if seen.z <= LEAST_AHEAD * q.z {
                    return None;
                }
                let e = focal * (seen.truncate() / seen.z - q.truncate() / q.z);
                let squared = (yy * e.x * e.x - 2.0 * xy * e.x * e.y + xx * e.y * e.y) / (xx * yy - xy * xy);
                wide = wide.max(SLACK * squared.sqrt() / reach.max(1e-3));
            }
        }
        Some([xx, xy, yy].map(|value| wide * wide * value))
    }

    /// The end of the part under water of a line from `m` to `m + out`.
    fn wet_end(&self, m: DVec3, out: DVec3) -> DVec3 {
        let Some(surface) = &self.bent else { return m + out };
        let (rise, least) = (surface.normal.dot(out), -(1.0 - LEAST_WET) * surface.height(m));
        if rise > least { m + least / rise * out } else { m + out }
    }
}

/// Share of its distance that the scale of a disk may have for all of it to be bent nearly as its centre is.
const SMALL: f64 = 0.03;
/// Points of the outline of others.
const OUTLINE: u32 = 16;
/// For what lies between them.
const SLACK: f64 = 1.2;
/// Share of the depth of the centre on the image at which a point counts as behind the camera.
const LEAST_AHEAD: f64 = 0.2;
/// Share of the depth of the centre under water at which a point counts as at the surface.
const LEAST_WET: f64 = 1e-3;

fn crossing(surface: &Surface, m: DVec3) -> Option<Crossing> {
    surface.crossing(DVec3::ZERO, m)
}
