//! The random scene of the benchmarks, defined by a formula and a seed so that it is the same everywhere.
//!
//! With u_k = `uniform_at(1, Test, i, k)` in [0, 1), Gaussian i of n has:
//! - depth `z = 2 + 4 u_2` and mean `(1.1 (u_0 - 1/2) z, 0.65 (u_1 - 1/2) z, z)`;
//! - quaternion `u_3..u_6 - 1/2`;
//! - log scales `s + 1.5 u_7..u_9` with `s = -4.2 - max(0, ln(n / 30,000) / 2)`, so that more than 30,000
//!   Gaussians cover the same area together;
//! - opacity logit `-3 + 5 u_10`;
//! - coefficient k of channel c: `u_(20 + 20 c + k) - 1/2`.
//!
//! The camera is at the origin and looks along z. Its focal length is 0.9 of the width, so that a picture of
//! 16:9 shows all Gaussians.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use fathom_core::gaussians::Gaussians;
use fathom_core::rng::{Stream, uniform_at};
use fathom_core::scene::{PinholeCamera, Pose};

/// The first `n` Gaussians, SH 3.
pub fn model(n: u32) -> Gaussians {
    let mut model = Gaussians::empty(3);
    let least = -4.2 - 0.5 * (n as f32 / 30_000.0).ln().max(0.0);
    model.sh_coeffs.reserve_exact(16 * n as usize);
    for i in 0..n {
        let u = |k: u32| uniform_at(1, Stream::Test, i, k);
        let z = 2.0 + 4.0 * u(2);
        model.means.push([(u(0) - 0.5) * z * 1.1, (u(1) - 0.5) * z * 0.65, z]);
        model.quats.push([u(3) - 0.5, u(4) - 0.5, u(5) - 0.5, u(6) - 0.5]);
        model.log_scales.push([least + 1.5 * u(7), least + 1.5 * u(8), least + 1.5 * u(9)]);
        model.opacity_logits.push(-3.0 + 5.0 * u(10));
        model.sh_coeffs.extend((0..16).map(|k| [u(20 + k) - 0.5, u(40 + k) - 0.5, u(60 + k) - 0.5]));
    }
    model
}

/// The camera that sees all Gaussians.
pub fn camera(width: u32, height: u32) -> (PinholeCamera, Pose) {
    let focal = 0.9 * f64::from(width);
    let camera = PinholeCamera {
        width,
        height,
        fx: focal,
        fy: focal,
        cx: f64::from(width) / 2.0,
        cy: f64::from(height) / 2.0,
    };
    (camera, Pose::from_wxyz([1.0, 0.0, 0.0, 0.0], [0.0; 3]))
}

/// Writes the scene for a program that shares no code with this one. A line of JSON has the counts and the
/// camera. After it come, as little-endian f32, all means, quaternions (w first), log scales, opacity logits
/// and coefficients. A coefficient has its three channels next to each other.
#[allow(dead_code, reason = "not every program that has this scene writes it")]
pub fn write(file: &Path, n: u32, width: u32, height: u32) -> io::Result<()> {
    let model = model(n);
    let (camera, _) = camera(width, height);
    let header = serde_json::json!({
        "gaussians": n,
        "sh_degree": 3,
        "width": width,
        "height": height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        // World to camera, by rows: the camera is at the origin and looks along z.
        "viewmat": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    });
    let mut out = BufWriter::new(File::create(file)?);
    writeln!(out, "{header}")?;
    let lists: [&[f32]; 5] = [
        bytemuck::cast_slice(&model.means),
        bytemuck::cast_slice(&model.quats),
        bytemuck::cast_slice(&model.log_scales),
        &model.opacity_logits,
        bytemuck::cast_slice(&model.sh_coeffs),
    ];
    for value in lists.into_iter().flatten() {
        out.write_all(&value.to_le_bytes())?;
    }
    out.flush()
}
