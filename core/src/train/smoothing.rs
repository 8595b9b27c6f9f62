//! The 3D filter of Mip-Splatting (Yu et al. 2024, section 5.1): no Gaussian is finer than its sampling by
//! the training views.
//!
//! Each Gaussian is rendered as if convolved with an isotropic Gaussian of standard deviation d (see
//! `smoothing.wgsl`) that preserves its integral. Its scales become sqrt(s^2 + d^2), and its opacity is
//! multiplied by the product of s / sqrt(s^2 + d^2). The widths depend on the positions of the Gaussians, so
//! they are computed at the start and after every density decision. An exported model has them in its scales
//! and opacities, so that any viewer shows it as it was trained.

use super::Trainer;
use crate::Result;
use crate::gaussians::Gaussians;
use crate::gpu::{Gpu, Recorder, Size};
use crate::views::TrainView;

/// The views in the layout of `smoothing.wgsl`.
pub(super) fn views_on_device(gpu: &Gpu, views: &[TrainView]) -> Result<wgpu::Buffer> {
    let mut rows: Vec<[f32; 4]> = Vec::with_capacity(5 * views.len());
    for TrainView { camera, pose, .. } in views {
        let rotation = glam::DMat3::from_quat(pose.rotation);
        for i in 0..3 {
            rows.push(rotation.row(i).extend(pose.translation[i]).as_vec4().to_array());
        }
        rows.push([camera.fx, camera.fy, camera.cx, camera.cy].map(|v| v as f32));
        rows.push([camera.width as f32, camera.height as f32, 0.0, 0.0]);
    }
    let buffer = gpu.buffer("sampling views", size_of_val(rows.as_slice()) as u64)?;
    gpu.write(&buffer, 0, &rows);
    Ok(buffer)
}

impl Trainer {
    /// Computes the smoothing of each trainable Gaussian, if the filter is on.
    pub(super) fn update_smoothing(&self) -> Result<()> {
        if !self.config.mip_filter {
            return Ok(());
        }
        let views = views_on_device(&self.gpu, self.targets.views())?;
        let mut recorder = Recorder::new(&self.gpu);
        for (_, block, training) in self.blocks.trainable() {
            recorder.dispatch(
                "smoothing",
                Size::Items(block.count, 64),
                &[
                    ("block", &block.uniform),
                    ("transforms", &block.transforms),
                    ("views", &views),
                    ("density_sums", &training.density_sums),
                ],
            )?;
        }
        recorder.submit();
        self.gpu.release_unused()
    }

    /// Standard deviation of the filter of each trainable Gaussian, scene units; 0 if the filter is off.
    pub(super) fn smoothing(&self) -> Result<Vec<f32>> {
        let mut all = Vec::new();
        for (_, block, training) in self.blocks.trainable() {
            let rows: Vec<[f32; 4]> = self.gpu.read(&training.density_sums, 0, block.count as usize)?;
            all.extend(rows.iter().map(|row| row[2]));
        }
        Ok(all)
    }
}

/// The model with the 3D filter in its scales and opacities; `smoothing` `[N]`: standard deviations, scene
/// units.
pub fn smoothed(mut model: Gaussians, smoothing: &[f32]) -> Gaussians {
    for (index, &width) in smoothing.iter().enumerate().filter(|(_, width)| **width > 0.0) {
        let mut share = 1.0;
        for log_scale in &mut model.log_scales[index] {
            let bare = f64::from(*log_scale);
            let wide = 0.5 * (f64::from(width).powi(2) + (2.0 * bare).exp()).ln();
            share *= (bare - wide).exp();
            *log_scale = wide as f32;
        }
        let logit = &mut model.opacity_logits[index];
        let opacity = share / (1.0 + (-f64::from(*logit)).exp());
        *logit = (opacity.max(f64::MIN_POSITIVE) / (1.0 - opacity)).ln() as f32;
    }
    model
}
