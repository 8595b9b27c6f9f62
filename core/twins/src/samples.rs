//! Seeded scenes that are hard for a renderer, for the tests of the twins and the kernels.
//!
//! Every number is computed in f32, so that a kernel and its twin start from the same bits.

use glam::DVec3;

use super::Gaussians64;
use fathom_core::gaussians::Gaussians;
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::{PinholeCamera, Pose};
use fathom_core::views::{InMemory, TrainView};

/// A view with an off-centre principal point and pixels that are not square. It looks along z from about
/// `eye_distance` in front of the origin, slightly turned.
pub fn off_centre_view(width: u32, height: u32, eye_distance: f64) -> (PinholeCamera, Pose) {
    let (w, h) = (f64::from(width), f64::from(height));
    let camera = PinholeCamera { width, height, fx: 0.9 * w, fy: 1.05 * w, cx: 0.41 * w, cy: 0.57 * h };
    let eye = DVec3::new(0.3, -0.2, -eye_distance);
    (camera, Pose::looking_at(eye, DVec3::new(0.05, 0.1, 0.0), DVec3::new(0.1, 1.0, 0.05)))
}

/// Grey photographs, for runs that only need work to do.
pub fn grey(views: Vec<TrainView>) -> InMemory {
    InMemory::plain(views, 0xff80_8080)
}

/// `count` Gaussians in a box of side 2 around the origin, with all sizes, rotations, opacities and colours.
pub fn random(seed: u32, count: usize, sh_degree: u8) -> Gaussians {
    let mut model = Gaussians::empty(sh_degree);
    for i in 0..count as u32 {
        let u = |j: u32| uniform_at(seed, Stream::Test, i, j);
        let signed = |j: u32| 2.0 * u(j) - 1.0;
        model.means.push([signed(0), signed(1), signed(2)]);
        model.quats.push([signed(3), signed(4), signed(5), signed(6)].map(|v| v + 0.01));
        model.log_scales.push([u(7), u(8), u(9)].map(|v| -4.0 + 3.0 * v));
        model.opacity_logits.push(-2.0 + 5.0 * u(10));
        for k in 0..model.coeffs() as u32 {
            let size = if k == 0 { 1.0 } else { 0.3 };
            model.sh_coeffs.push([11, 12, 13].map(|j| size * signed(j + 3 * k)));
        }
    }
    model
}

/// The same as needles: one axis is a thousand times as long as the other two.
pub fn needles(seed: u32, count: usize, sh_degree: u8) -> Gaussians {
    let mut model = random(seed, count, sh_degree);
    for scales in &mut model.log_scales {
        *scales = [-0.5 + 0.2 * scales[0], -8.0, -8.0];
    }
    model
}

/// The same, each larger than the image.
pub fn huge(seed: u32, count: usize, sh_degree: u8) -> Gaussians {
    let mut model = random(seed, count, sh_degree);
    for scales in &mut model.log_scales {
        *scales = scales.map(|s| s + 3.5);
    }
    for logit in &mut model.opacity_logits {
        *logit -= 2.0;
    }
    model
}

/// The same, larger and spread over three times the width. Most centres are outside the image of
/// [`off_centre_view`], and many are beyond the bounds of the linearisation.
pub fn beyond_the_border(seed: u32, count: usize, sh_degree: u8) -> Gaussians {
    let mut model = random(seed, count, sh_degree);
    for (mean, scales) in model.means.iter_mut().zip(&mut model.log_scales) {
        *mean = [mean[0] * 3.0, mean[1] * 3.0, mean[2]];
        *scales = scales.map(|s| s + 1.5);
    }
    model
}

/// Gaussians that must not be drawn from [`off_centre_view`], each with the name of its fault.
pub fn degenerate(sh_degree: u8) -> (Gaussians, Vec<&'static str>) {
    type Fault = (&'static str, fn(&mut Gaussians));
    let faults: [Fault; 13] = [
        ("NaN in the mean", |g| g.means[0][1] = f32::NAN),
        ("infinite mean", |g| g.means[0][2] = f32::INFINITY),
        ("behind the camera", |g| g.means[0] = [0.0, 0.0, -100.0]),
        ("NaN in the quaternion", |g| g.quats[0][3] = f32::NAN),
        ("infinite quaternion", |g| g.quats[0][0] = f32::INFINITY),
        ("quaternion of length 0", |g| g.quats[0] = [0.0; 4]),
        ("NaN in the scale", |g| g.log_scales[0][0] = f32::NAN),
        ("scale of minus infinity", |g| g.log_scales[0][1] = f32::NEG_INFINITY),
        ("scale that overflows", |g| g.log_scales[0] = [1000.0; 3]),
        ("NaN in the opacity", |g| g.opacity_logits[0] = f32::NAN),
        ("opacity 0", |g| g.opacity_logits[0] = f32::NEG_INFINITY),
        ("opacity under 1/255", |g| g.opacity_logits[0] = -6.0),
        ("NaN in the colour", |g| g.sh_coeffs[0][1] = f32::NAN),
    ];
    let mut model = Gaussians::empty(sh_degree);
    for (_, spoil) in &faults {
        let mut one = random(1, 1, sh_degree);
        spoil(&mut one);
        model.push_from(&one, 0);
    }
    (model, faults.iter().map(|(name, _)| *name).collect())
}

/// All scenes by name, in f64, for the checks of every backward pass.
pub fn all(seed: u32, count: usize, sh_degree: u8) -> Vec<(&'static str, Gaussians64)> {
    [
        ("random", random(seed, count, sh_degree)),
        ("needles", needles(seed, count, sh_degree)),
        ("huge", huge(seed, count, sh_degree)),
        ("beyond the border", beyond_the_border(seed, count, sh_degree)),
    ]
    .map(|(name, model)| (name, Gaussians64::from(&model)))
    .into()
}
