//! EVALUATE: renders the held-out views of the merged model and takes the metrics.
//!
//! Protocol: render clamped and rounded to 8 bits in sRGB, over black or through the model's water, as training rendered
//! it.

use std::sync::Arc;

use bytes::Bytes;
use fathom_core::gpu::{Gpu, Renderer, Show, WaterView};
use fathom_core::metrics::{psnr, quantised, ssim};
use fathom_core::picture::encode_png;
use fathom_core::ply;
use fathom_core::views::{PackedImage, ViewSource};
use fathom_proto::v1::Progress;
use fathom_proto::worker::v1::{Evaluation, FailClass, ViewMetrics};
use prost::Message;

use super::{Control, TaskError, TaskInput, TaskOutput};
use crate::blobs::to_proto;

/// Version of [`Evaluation`]'s layout.
const FORMAT: u32 = 1;
/// What training renders over.
const BACKGROUND: [f32; 3] = [0.0; 3];
/// Differences are shown so many times larger: a difference of 8 bits' tenth is hard to see.
const DIFFERENCE_GAIN: u8 = 4;

pub fn run(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    views: &dyn ViewSource,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let Some(path) = &task.merged_model else {
        let message = "an evaluation needs the merged model".to_owned();
        return Err(TaskError::Failed { class: FailClass::Input, message });
    };
    let model = ply::read_model(path)?;
    let gaussians = model.len() as u32;
    let water = ply::water_record(path)?.map(|record| WaterView::of_record(&record, Show::Seen));
    let mut renderer =
        Renderer::new(Arc::clone(gpu), &model)?.with_mip_filter(ply::is_antialiased(path)?).with_water(water);
    let count = views.views().len() as u32;
    let mut measured = Vec::with_capacity(views.views().len());
    for (index, view) in views.views().iter().enumerate() {
        if control.stop_reason().is_some() {
            return Err(TaskError::Stopped { checkpoint: None });
        }
        let truth = views.load(index)?;
        let rendered = renderer.render(&view.camera, &view.pose, BACKGROUND)?;
        let render = quantised(rendered.width, rendered.height, &rendered.rgb);
        let png = side_by_side(&truth, &render)?;
        measured.push(ViewMetrics {
            name: view.name.clone(),
            psnr_db: psnr(&render, &truth),
            ssim: ssim(&render, &truth),
            side_by_side: Some(to_proto(&control.upload(Bytes::from(png))?)),
        });
        control.report(Progress {
            iteration: index as u32 + 1,
            iterations: count,
            gaussians,
            ..Progress::default()
        });
    }
    let adapter = gpu.adapter().name.clone();
    let evaluation = Evaluation { format: FORMAT, views: measured, gaussians, adapter };
    let result = Bytes::from(evaluation.encode_to_vec());
    Ok(TaskOutput { result, gaussians, resumed_from: 0, held_out: Vec::new() })
}

/// Photograph, render and difference from left to right. What the mask leaves out has no difference.
fn side_by_side(truth: &PackedImage, render: &PackedImage) -> Result<Vec<u8>, TaskError> {
    let width = truth.width as usize;
    let mut rgb = Vec::with_capacity(truth.pixels.len() * 9);
    for (truths, renders) in truth.pixels.chunks(width).zip(render.pixels.chunks(width)) {
        rgb.extend(truths.iter().flat_map(|pixel| rgb_of(*pixel)));
        rgb.extend(renders.iter().flat_map(|pixel| rgb_of(*pixel)));
        rgb.extend(truths.iter().zip(renders).flat_map(|(a, b)| difference(*a, *b)));
    }
    Ok(encode_png(truth.width * 3, truth.height, &rgb)?)
}

fn rgb_of(pixel: u32) -> [u8; 3] {
    let [r, g, b, _] = pixel.to_le_bytes();
    [r, g, b]
}

fn difference(truth: u32, render: u32) -> [u8; 3] {
    if truth.to_le_bytes()[3] != 255 {
        return [0; 3];
    }
    let (a, b) = (rgb_of(truth), rgb_of(render));
    std::array::from_fn(|c| a[c].abs_diff(b[c]).saturating_mul(DIFFERENCE_GAIN))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_is_amplified_and_nothing_where_the_mask_leaves_out() {
        let pixel = |rgb: [u8; 3], mask: u8| u32::from_le_bytes([rgb[0], rgb[1], rgb[2], mask]);
        let render = pixel([10, 0, 200], 255);
        assert_eq!(difference(pixel([12, 255, 200], 255), render), [8, 255, 0]);
        assert_eq!(difference(pixel([12, 255, 200], 0), render), [0, 0, 0]);
    }
}
