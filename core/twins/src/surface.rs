//! Scenes seen through a calm water surface (WSGS): three sets of disks and a plane.
//!
//! The first set is seen straight, the second in rays that the surface reflects, the third in rays that it
//! refracts:
//!
//! ```text
//! water = shown(F light(c_reflected) + (1 - F) light(c_refracted))    (eq. 11)
//! c = c_straight + (1 - alpha_straight) water                         over
//! c = R c_straight + (1 - R) water                                    masked (eq. 12)
//! ```
//!
//! R is the blended mask of the straight set: 1 where a pixel shows the scene above water.
//!
//! F is the reflectance, by Fresnel or by Schlick (eq. 10). `light` decodes sRGB and `shown` encodes it,
//! unless the light is added as it is shown.
//!
//! Gradients of the plane are those of the rays at it. The low-pass of disks has no part in them, nor have
//! colours that depend on the direction: both know a ray by the pixel only.

mod per_hit;
mod sight;

use glam::DVec3;

use crate::adam::adam_update_with;
use crate::water::{decode, encode};
use crate::{DiskRaster, DiskRay, Raster, RayGradient};
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_core::surface::optics::{fresnel, schlick};
use fathom_core::surface::{AIR, Surface};

pub use per_hit::{refracted_outline, trace_per_hit};
pub use sight::Sight;

/// Least cosine with the normal of a ray that meets the surface.
const LEAST_COSINE: f64 = 1e-3;
/// From this R or alpha on, a pixel shows nothing but the scene above water.
const DRY: f64 = 0.999;
/// Least cosine with the normal of a ray that says something about the plane.
const LEAST_STEEP: f64 = 0.1;

/// A water surface, and how its light adds up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WaterSurface {
    /// The plane, scene axes.
    pub plane: Surface,
    /// Schlick's reflectance in place of Fresnel's.
    pub schlick: bool,
    /// Reflected and refracted light add in sRGB, in place of linear light.
    pub as_shown: bool,
    /// The straight picture lies over that of the water, in place of its masks.
    pub over: bool,
}

impl WaterSurface {
    /// By how much the straight picture covers the water, `[H*W]`: its alpha, or R.
    pub fn cover<'a>(&self, straight: &'a DiskRaster) -> &'a [f64] {
        if self.over { &straight.raster.alpha } else { &straight.mask }
    }

    /// Share of the light that is reflected.
    pub fn reflectance(&self, cos_i: f64) -> f64 {
        if self.schlick { schlick(cos_i, AIR, self.plane.ior) } else { fresnel(cos_i, AIR, self.plane.ior) }
    }

    /// Its derivative, as a central difference: the kernel has a formula.
    fn reflectance_slope(&self, cos_i: f64) -> f64 {
        const STEP: f64 = 1e-5;
        (self.reflectance(cos_i + STEP) - self.reflectance(cos_i - STEP)) / (2.0 * STEP)
    }

    /// Light of a blended colour, and its derivative.
    fn light(&self, shown: f64) -> (f64, f64) {
        if self.as_shown { (shown, 1.0) } else { decode(shown) }
    }

    /// Colour of light, and its derivative.
    fn shown(&self, light: f64) -> (f64, f64) {
        if self.as_shown { (light, 1.0) } else { encode(light) }
    }
}

/// The rays of the pixels at the surface, row-major. A pixel without a ray has [`DiskRay::NONE`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SurfaceRays {
    /// Reflected, in the frame of the mirrored camera.
    pub reflected: Vec<DiskRay>,
    /// Refracted, in the frame of the camera.
    pub refracted: Vec<DiskRay>,
    /// F.
    pub share: Vec<f64>,
}

impl SurfaceRays {
    /// Whether the ray of a pixel meets the surface.
    pub fn is_hit(&self, pixel: usize) -> bool {
        self.refracted[pixel].nearest.is_finite()
    }
}

/// Unit direction of a pixel, scene axes.
fn direction(camera: &PinholeCamera, pose: &Pose, pixel: usize) -> DVec3 {
    pose.rotation.inverse() * camera.direction(pixel)
}

/// The rays at the surface of all pixels but those that show the scene above water, or see the surface from
/// nearly its edge. `cover` is [`WaterSurface::cover`].
pub fn surface_rays(water: &WaterSurface, camera: &PinholeCamera, pose: &Pose, cover: &[f64]) -> SurfaceRays {
    let (plane, eye) = (&water.plane, pose.centre());
    let (mirrored, straight) = (Sight::reflected(pose, plane), Sight::straight(pose));
    let mut rays = SurfaceRays::default();
    for (pixel, cover) in cover.iter().enumerate() {
        let d = direction(camera, pose, pixel);
        let cos_i = -plane.normal.dot(d);
        let range = plane.meets(eye, d).filter(|_| cos_i > LEAST_COSINE && *cover < DRY);
        let [reflected, refracted] = range.map_or([DiskRay::NONE; 2], |range| {
            let (at, split) = (eye + range * d, plane.split(d));
            let seen = |sight: &Sight, along: DVec3| DiskRay {
                origin: sight.transform(at),
                direction: sight.world_to_camera * along,
                nearest: 0.0,
            };
            [seen(&mirrored, split.reflected), seen(&straight, split.refracted)]
        });
        rays.reflected.push(reflected);
        rays.refracted.push(refracted);
        rays.share.push(if range.is_some() { water.reflectance(cos_i) } else { 0.0 });
    }
    rays
}

/// The pictures of the three sets.
#[derive(Clone, Copy, Debug)]
pub struct Pictures<'a> {
    /// Seen straight, with the blended mask.
    pub straight: &'a DiskRaster,
    /// In reflected rays.
    pub reflected: &'a Raster,
    /// In refracted rays.
    pub refracted: &'a Raster,
}

/// Gradients of the loss with respect to [`Pictures`] and F, `[H*W]`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PictureGradients {
    /// With respect to the colours of the straight picture.
    pub straight: Vec<[f64; 3]>,
    /// With respect to its alpha.
    pub alpha: Vec<f64>,
    /// With respect to its blended mask.
    pub mask: Vec<f64>,
    /// With respect to the colours of the reflected picture.
    pub reflected: Vec<[f64; 3]>,
    /// With respect to those of the refracted one.
    pub refracted: Vec<[f64; 3]>,
    /// With respect to F.
    pub share: Vec<f64>,
}

/// The picture that the surface makes of three.
pub fn compose(water: &WaterSurface, rays: &SurfaceRays, of: Pictures<'_>) -> Vec<[f64; 3]> {
    let pixel = |i: usize| {
        let straight = of.straight.raster.rgb[i];
        if !rays.is_hit(i) {
            return straight;
        }
        let (dry, share) = (water.cover(of.straight)[i], rays.share[i]);
        let worth = if water.over { 1.0 } else { dry };
        std::array::from_fn(|c| {
            let light = share * water.light(of.reflected.rgb[i][c]).0
                + (1.0 - share) * water.light(of.refracted.rgb[i][c]).0;
            (1.0 - dry) * water.shown(light).0 + worth * straight[c]
        })
    };
    (0..rays.share.len()).map(pixel).collect()
}

/// Gradients through [`compose`]; `v` is that of its picture.
pub fn compose_backward(
    water: &WaterSurface,
    rays: &SurfaceRays,
    of: Pictures<'_>,
    v: &[[f64; 3]],
) -> PictureGradients {
    let pixels = v.len();
    let mut out = PictureGradients {
        straight: v.to_vec(),
        alpha: vec![0.0; pixels],
        mask: vec![0.0; pixels],
        reflected: vec![[0.0; 3]; pixels],
        refracted: vec![[0.0; 3]; pixels],
        share: vec![0.0; pixels],
    };
    for i in (0..pixels).filter(|&i| rays.is_hit(i)) {
        let (dry, share) = (water.cover(of.straight)[i], rays.share[i]);
        for c in 0..3 {
            let (up, up_slope) = water.light(of.reflected.rgb[i][c]);
            let (down, down_slope) = water.light(of.refracted.rgb[i][c]);
            let (shown, slope) = water.shown(share * up + (1.0 - share) * down);
            let v_light = (1.0 - dry) * v[i][c] * slope;
            if water.over {
                out.alpha[i] -= v[i][c] * shown;
            } else {
                out.straight[i][c] = dry * v[i][c];
                out.mask[i] += v[i][c] * (of.straight.raster.rgb[i][c] - shown);
            }
            out.reflected[i][c] = share * v_light * up_slope;
            out.refracted[i][c] = (1.0 - share) * v_light * down_slope;
            out.share[i] += v_light * (up - down);
        }
    }
    out
}

/// Gradients with respect to the rays at the surface and F, `[H*W]`.
#[derive(Clone, Copy, Debug)]
pub struct RayGradients<'a> {
    /// Of the reflected rays, in the frame of the mirrored camera.
    pub reflected: &'a [RayGradient],
    /// Of the refracted rays, in the frame of the camera.
    pub refracted: &'a [RayGradient],
    /// Of F.
    pub share: &'a [f64],
}

/// Gradient of the plane from that of its rays, by pixel: normal (scene axes; the plane turns about `pivot`)
/// and offset. Only its part at right angles to the normal can turn the plane. Rays that graze the surface
/// are left out: a small turn moves their origin far.
pub fn plane_gradients(
    water: &WaterSurface,
    camera: &PinholeCamera,
    pose: &Pose,
    rays: &SurfaceRays,
    v: RayGradients<'_>,
    pivot: DVec3,
) -> Vec<[f64; 4]> {
    let (n, eye) = (water.plane.normal, pose.centre());
    let to_world = Sight::straight(pose).world_to_camera.transpose();
    let from_mirror = Sight::reflected(pose, &water.plane).world_to_camera.transpose();
    let (eta, height) = (AIR / water.plane.ior, water.plane.height(eye));
    let of_pixel = |i: usize| {
        let d = direction(camera, pose, i);
        let cos_i = -n.dot(d);
        if !rays.is_hit(i) || cos_i < LEAST_STEEP {
            return [0.0; 4];
        }
        let v_at = to_world * v.refracted[i].origin + from_mirror * v.reflected[i].origin;
        // at = eye + (height / cos_i) d, height = n.eye - offset.
        let v_height = v_at.dot(d) / cos_i;
        let mut v_normal = v_height * (eye - pivot + height / cos_i * d);
        // reflected = d + 2 cos_i n
        let v_reflected = from_mirror * v.reflected[i].direction;
        v_normal += 2.0 * cos_i * v_reflected - 2.0 * v_reflected.dot(n) * d;
        // refracted = eta d + (eta cos_i - cos_t) n
        let v_refracted = to_world * v.refracted[i].direction;
        let cos_t = (1.0 - eta * eta * (1.0 - cos_i * cos_i)).sqrt();
        let slope = eta - eta * eta * cos_i / cos_t;
        v_normal += (eta * cos_i - cos_t) * v_refracted - slope * v_refracted.dot(n) * d;
        v_normal -= v.share[i] * water.reflectance_slope(cos_i) * d;
        [v_normal.x, v_normal.y, v_normal.z, -v_height]
    };
    (0..rays.share.len()).map(of_pixel).collect()
}

/// Adam on the plane: on the tilt of its normal about a point, and on its offset. Decay 0.9 and 0.999.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PlaneState {
    moments: [[f64; 2]; 4],
    steps: u32,
}

impl PlaneState {
    /// Takes one step against the gradient `v` of normal and offset. `rates` are those of the tilt (radians)
    /// and of the offset (scene units).
    pub fn step(&mut self, plane: &mut Surface, v: [f64; 4], rates: [f64; 2], pivot: DVec3) {
        self.steps += 1;
        let n = plane.normal;
        let v_normal = DVec3::new(v[0], v[1], v[2]);
        let tilt = v_normal - v_normal.dot(n) * n;
        let v = [tilt.x, tilt.y, tilt.z, v[3]];
        let mut moved = [0.0; 4];
        for (k, [first, second]) in self.moments.iter_mut().enumerate() {
            let rate = rates[usize::from(k == 3)];
            adam_update_with(&mut moved[k], v[k], (first, second), self.steps, rate, [0.9, 0.999]);
        }
        let moved_normal = DVec3::new(moved[0], moved[1], moved[2]);
        let turned = (n + moved_normal - moved_normal.dot(n) * n).normalize();
        plane.offset += (turned - n).dot(pivot) + moved[3];
        plane.normal = turned;
    }
}

/// The loss between the blended mask and a pseudo-mask, and its gradient (WSGS, eq. 15). `is_water` gives the
/// cell of a pixel.
pub fn mask_loss(masks: &[f64], is_water: impl Fn(usize) -> bool, weight: f64) -> (f64, Vec<f64>) {
    let share = weight / masks.len().max(1) as f64;
    let off: Vec<f64> = masks.iter().enumerate().map(|(i, r)| r - f64::from(!is_water(i))).collect();
    (off.iter().map(|off| share * off * off).sum(), off.iter().map(|off| 2.0 * share * off).collect())
}

#[cfg(test)]
mod tests;
