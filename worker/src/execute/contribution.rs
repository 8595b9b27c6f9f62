//! Measures how much each view shows of each partition, by the surfaces of the coarse model.
//!
//! The box of a partition is tall and mostly empty, and things in front may hide it: a camera whose frustum
//! meets the box may see none of its surfaces. So this stage renders the coarse model into every training
//! view, at its training size. Each pixel with a surface counts by its alpha for all partitions whose box
//! holds the surface. Haze and background Gaussians are excluded, as in the loss mask of a partition
//! (`loss_mask.rs`).

use std::sync::Arc;

use bytes::Bytes;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::{Gpu, Rendered, Renderer};
use fathom_core::scene::BlobRef;
use fathom_core::views::{TrainView, ViewSource};
use fathom_proto::worker::v1::{Contributions, FocusBox};
use glam::{DQuat, DVec3};
use prost::Message;

use super::loss_mask::surfaces;
use super::partition::Inside;
use super::{Control, TaskError, TaskInput};

/// Version of [`Contributions`]'s layout.
const FORMAT: u32 = 1;

/// Measures by `model` how much the task's views show of the boxes of its spec, and uploads it.
pub fn submit(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    regions: &[FocusBox],
    model: &Gaussians,
    views: &dyn ViewSource,
    control: &dyn Control,
) -> Result<BlobRef, TaskError> {
    let regions: Vec<Inside<'_>> = regions.iter().map(Inside::new).collect::<Result<_, _>>()?;
    let solid = model.surfaces(task.common.viewing_distance);
    let mut renderer = Renderer::new(Arc::clone(gpu), &solid)?.with_mip_filter(task.config.train.mip_filter);
    let mut shares = Vec::with_capacity(views.views().len() * regions.len());
    for view in views.views() {
        if control.stop_reason().is_some() {
            return Err(TaskError::Stopped { checkpoint: None });
        }
        let rendered = renderer.render(&view.camera, &view.pose, [0.0; 3])?;
        shares.extend(shares_of(&rendered, view, &regions));
    }
    let contributions = Contributions {
        format: FORMAT,
        views: task.common.views.clone(),
        partitions: regions.len() as u32,
        shares,
    };
    control.upload(Bytes::from(contributions.encode_to_vec()))
}

/// For each region, the share of a picture that shows its surfaces, weighted by alpha.
fn shares_of<'a>(rendered: &'a Rendered, view: &'a TrainView, regions: &'a [Inside<'_>]) -> Vec<f32> {
    let shown: Vec<(DVec3, f64)> = surfaces(rendered, view)
        .zip(&rendered.alpha)
        .filter_map(|(surface, &alpha)| Some((surface.filter(|at| at.is_finite())?, f64::from(alpha))))
        .collect();
    let pixels = rendered.alpha.len().max(1) as f64;
    // All boxes of a plan share one frame, so each surface is rotated once, whatever the number of
    // partitions.
    let mut turned: Option<(DQuat, Vec<(DVec3, f64)>)> = None;
    let mut share = |region: &Inside<'_>| {
        let known = turned.take().filter(|(rotation, _)| *rotation == region.rotation());
        let (rotation, aligned) = known.unwrap_or_else(|| {
            let aligned = shown.iter().map(|(at, alpha)| (region.aligned(*at), *alpha));
            (region.rotation(), aligned.collect())
        });
        let inside = aligned.iter().filter(|(at, _)| region.contains_aligned(*at));
        let share = (inside.map(|(_, alpha)| alpha).sum::<f64>() / pixels).clamp(0.0, 1.0) as f32;
        turned = Some((rotation, aligned));
        share
    };
    regions.iter().map(&mut share).collect()
}

#[cfg(test)]
mod tests {
    use fathom_core::scene::{PinholeCamera, Pose};
    use fathom_proto::worker::v1::FocusBox;

    use super::*;

    /// A camera at the origin that looks along z at a wall at z = 10; its pixels see x = -7.5, -2.5, 2.5 and
    /// 7.5.
    fn wall(alpha: [f32; 4]) -> (Rendered, TrainView) {
        let camera = PinholeCamera { width: 4, height: 1, fx: 2.0, fy: 2.0, cx: 2.0, cy: 0.5 };
        let pose = Pose::from_wxyz([1.0, 0.0, 0.0, 0.0], [0.0; 3]);
        let range = [-0.75_f32, -0.25, 0.25, 0.75].map(|x| 10.0 * (1.0 + x * x).sqrt());
        let range = (0..4).map(|i| alpha[i] * range[i]).collect();
        let rendered = Rendered { width: 4, height: 1, rgb: vec![[0.0; 3]; 4], alpha: alpha.into(), range };
        (rendered, TrainView { name: "v".into(), camera, pose, clear_range: 0.0 })
    }

    fn region(min_x: f64, max_x: f64, max_z: f64) -> FocusBox {
        let align_quat_wxyz = vec![1.0, 0.0, 0.0, 0.0];
        FocusBox { align_quat_wxyz, min_x, max_x, min_z: f64::NEG_INFINITY, max_z }
    }

    #[test]
    fn surface_pixels_count_for_their_box_by_alpha() {
        let boxes = [
            region(f64::NEG_INFINITY, 0.0, f64::INFINITY),
            region(0.0, f64::INFINITY, f64::INFINITY),
            region(-3.0, 3.0, f64::INFINITY),
            region(f64::NEG_INFINITY, f64::INFINITY, 9.0),
        ];
        let regions: Vec<Inside<'_>> = boxes.iter().map(|bounds| Inside::new(bounds).unwrap()).collect();
        let (rendered, view) = wall([1.0, 0.75, 0.5, 0.25]);
        // The last pixel is too transparent for a surface; the last box ends before the wall.
        assert_eq!(shares_of(&rendered, &view, &regions), [1.75 / 4.0, 0.5 / 4.0, 1.25 / 4.0, 0.0]);
        let (hazy, view) = wall([0.1; 4]);
        assert_eq!(shares_of(&hazy, &view, &regions), [0.0; 4]);
    }
}
