//! EVALUATE: renders the held-out views of the merged model and measures them.
//!
//! Protocol: the render is clamped and rounded to 8 bits in sRGB, over black or through the model's water, as
//! in training. Where several tasks measure a part of the views each, all of them together give the results
//! of one.

use std::sync::Arc;

use bytes::Bytes;
use fathom_core::cover::{CoverMeter, HeldOut};
use fathom_core::gpu::{Gpu, Output, Rendered, Renderer, SeamRun, SurfaceRenderer, WaterView};
use fathom_core::metrics::{SsimMap, psnr, quantised};
use fathom_core::picture::{encode_png, prepared_camera};
use fathom_core::ply;
use fathom_core::scene::{ManifestView, PinholeCamera, Pose};
use fathom_core::seams::{Axis, Line, SeamLines};
use fathom_core::views::{PackedImage, ViewSource};
use fathom_core::white_point::{self, Exposure};
use fathom_proto::v1::Progress;
use fathom_proto::worker::v1::{self, Artifact, EvaluateSpec, Evaluation, FailClass, ViewMetrics};
use glam::DQuat;
use prost::Message;
use serde::Serialize;

use super::training::read_points;
use super::{Control, TaskError, TaskInput, TaskOutput, input_fault};
use crate::blobs::to_proto;

/// Version of [`Evaluation`]'s layout.
const FORMAT: u32 = 1;
/// Background of training.
const BACKGROUND: [f32; 3] = [0.0; 3];
/// Views that set the brightness of pictures of J, at half their size.
const EXPOSED_VIEWS: usize = 64;
/// Differences are amplified by this factor; a tenth of the 8-bit range is hard to see.
const DIFFERENCE_GAIN: u8 = 4;

pub fn run(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    spec: &EvaluateSpec,
    views: &dyn ViewSource,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let Some(path) = task.input(Artifact::Model) else {
        let message = "an evaluation needs the merged model".to_owned();
        return Err(TaskError::Failed { class: FailClass::Input, message });
    };
    let model = ply::read_model(path)?;
    let gaussians = model.len() as u32;
    let record = ply::water_record(path)?;
    let through = |output| record.as_ref().map(|record| WaterView::of_record(record, output));
    let drawing = ply::drawing(path)?;
    let mut renderer = Renderer::new(Arc::clone(gpu), &model)?.drawn(drawing)?;
    let mut through_surface = match ply::read_surface_model(path)? {
        Some(model) => Some(SurfaceRenderer::new(Arc::clone(gpu), &model)?),
        None => None,
    };
    let mut seams = match &spec.seams {
        Some(lines) => {
            let measured = (seam_lines(lines)?, task.config.seams.clone());
            SeamRun::if_it_fits(gpu, &model, drawing, task.common.viewing_distance, measured)?
        }
        None => None,
    };
    let (points, cameras) = (read_points(task)?, all_cameras(task)?);
    let is_part = !spec.held_out.is_empty();
    // Brightness and cover are those of the whole job, also where other workers measure the other views.
    let held_out = if is_part { &spec.held_out } else { &task.common.views };
    let gains = match &record {
        Some(record) => {
            let clear = WaterView::of_record(record, Output::Restored);
            Some(gains_of(&mut renderer, clear, &cameras, held_out)?)
        }
        None => None,
    };
    let mut cover = CoverMeter::new(&cameras, held_out, &points);
    let count = views.views().len() as u32;
    let mut measured = Vec::with_capacity(views.views().len());
    for (index, view) in views.views().iter().enumerate() {
        if control.stop_reason().is_some() {
            return Err(TaskError::Stopped { checkpoint: None });
        }
        let truth = views.load(index)?;
        let mut shown = |output| -> Result<Rendered, TaskError> {
            renderer.set_water(through(output));
            Ok(renderer.render(&view.camera, &view.pose, BACKGROUND)?)
        };
        let picture = |shown: &Rendered| quantised(shown.width, shown.height, &shown.rgb);
        let (mut parts, mut clear) = (Vec::new(), None);
        let seen = match &mut through_surface {
            Some(renderer) => renderer.render(&view.camera, &view.pose)?,
            None => shown(Output::Underwater)?,
        };
        // The scene without the surface: what covers a pixel is seen straight there.
        let dry = if through_surface.is_some() { Some(shown(Output::Underwater)?) } else { None };
        parts.extend(dry.as_ref().map(picture));
        let render = picture(&seen);
        if let Some(gains) = gains {
            let mut rendered = shown(Output::Restored)?;
            clear = Some(picture(&rendered));
            white_point::apply(&mut rendered.rgb, gains);
            parts = vec![picture(&rendered), picture(&shown(Output::Backscatter)?)];
        }
        cover.add(&HeldOut {
            index: task.common.views[index],
            camera: &view.camera,
            pose: &view.pose,
            alpha: &dry.as_ref().unwrap_or(&seen).alpha,
            range: &dry.as_ref().unwrap_or(&seen).range,
            photograph: &truth,
            clear: clear.as_ref(),
            truth: None,
        });
        let png = side_by_side(&truth, &render, &parts)?;
        let map = SsimMap::new(&render, &truth);
        let border = match &mut seams {
            Some(seams) => seams.add((&view.camera, &view.pose), &render, &truth, map.as_ref())?,
            None => None,
        };
        let upload = |png: Vec<u8>| Ok::<_, TaskError>(to_proto(&control.upload(Bytes::from(png))?));
        measured.push(ViewMetrics {
            name: view.name.clone(),
            psnr_db: psnr(&render, &truth),
            ssim: map.as_ref().map_or(f64::NAN, SsimMap::mean),
            side_by_side: Some(upload(png)?),
            border: border.map(upload).transpose()?,
        });
        control.report(Progress {
            iteration: index as u32 + 1,
            iterations: count,
            gaussians,
            ..Progress::default()
        });
    }
    let mut evaluation = Evaluation {
        format: FORMAT,
        views: measured,
        gaussians,
        adapter: gpu.adapter().name.clone(),
        clear_gains: gains.map_or_else(Vec::new, |gains| gains.to_vec()),
        ..Evaluation::default()
    };
    let (mut seams, cover) = (seams.map(SeamRun::sums), cover.sums());
    if is_part {
        if let Some(seams) = &mut seams {
            seams.thin();
            evaluation.seam_sums_json = json("at borders", seams)?;
        }
        evaluation.cover_sums_json = json("of cover", &cover)?;
    } else {
        if let Some(seams) = seams {
            evaluation.seams_json = json("at borders", &seams.report())?;
        }
        evaluation.cover_json = json("of cover", &cover.report())?;
    }
    let result = Bytes::from(evaluation.encode_to_vec());
    Ok(TaskOutput { result, gaussians, resumed_from: 0, held_out: Vec::new(), further: Vec::new() })
}

/// Measurements as JSON; `what` they are is for the error.
fn json(what: &str, measured: &impl Serialize) -> Result<String, TaskError> {
    serde_json::to_string(measured).map_err(|error| TaskError::Failed {
        class: FailClass::Training,
        message: format!("the measurements {what} cannot be written: {error}"),
    })
}

/// Gains that make pictures of J neither clipped nor dim ([`white_point`]); 1 if no surface gives a
/// reference. Only pictures for viewing use them, no measurement does. `held_out` are indices of `cameras`.
fn gains_of(
    renderer: &mut Renderer,
    clear: WaterView,
    cameras: &[(PinholeCamera, Pose)],
    held_out: &[u32],
) -> Result<[f64; 3], TaskError> {
    let mut exposure = Exposure::after([1.0; 3]);
    renderer.set_water(Some(clear));
    for index in held_out.iter().step_by(held_out.len().div_ceil(EXPOSED_VIEWS).max(1)) {
        let (camera, pose) = cameras.get(*index as usize).ok_or_else(|| {
            input_fault(format!("view {index} is held out, and the manifest has {} views", cameras.len()))
        })?;
        let (width, height) = (camera.width.div_ceil(2), camera.height.div_ceil(2));
        let rendered = renderer.render(&camera.resized(width, height), pose, BACKGROUND)?;
        exposure.add(&rendered.rgb, &rendered.alpha);
    }
    Ok(exposure.gains().unwrap_or_else(|error| {
        tracing::warn!(%error, "pictures of J keep their original brightness");
        [1.0; 3]
    }))
}

/// Cameras and poses of all views of the scene, by index, at the size of the measured pictures.
fn all_cameras(task: &TaskInput) -> Result<Vec<(PinholeCamera, Pose)>, TaskError> {
    let camera = |view: &ManifestView| {
        let camera = task.manifest.camera(view.camera_id).ok_or_else(|| {
            input_fault(format!("{}: the manifest has no camera {}", view.name, view.camera_id))
        })?;
        Ok((prepared_camera(camera, task.common.max_resolution_px)?, view.pose))
    };
    task.manifest.views.iter().map(camera).collect()
}

/// The cell borders of the model, from the wire format.
fn seam_lines(lines: &v1::SeamLines) -> Result<SeamLines, TaskError> {
    let fault = |message: String| TaskError::Failed { class: FailClass::Input, message };
    let Ok([w, x, y, z]) = <[f64; 4]>::try_from(lines.align_quat_wxyz.as_slice()) else {
        return Err(fault(format!("a quaternion has 4 numbers, not {}", lines.align_quat_wxyz.len())));
    };
    let line = |line: &v1::SeamLine| {
        let v1::SeamLine { from_x, from_z, to_x, to_z } = *line;
        if from_x == to_x && from_z < to_z {
            Ok(Line { axis: Axis::X, at: from_x, from: from_z, to: to_z })
        } else if from_z == to_z && from_x < to_x {
            Ok(Line { axis: Axis::Z, at: from_z, from: from_x, to: to_x })
        } else {
            Err(fault(format!("no line along an axis leads from ({from_x}, {from_z}) to ({to_x}, {to_z})")))
        }
    };
    Ok(SeamLines {
        world_to_aligned: DQuat::from_xyzw(x, y, z, w),
        borders: lines.borders.iter().map(line).collect::<Result<_, _>>()?,
        controls: lines.controls.iter().map(line).collect::<Result<_, _>>()?,
        band: lines.band,
    })
}

/// Photograph, render and difference from left to right, then `parts` (J and the backscatter).
fn side_by_side(
    truth: &PackedImage,
    render: &PackedImage,
    parts: &[PackedImage],
) -> Result<Vec<u8>, TaskError> {
    Ok(encode_png(truth.width * (3 + parts.len() as u32), truth.height, &abreast(truth, render, parts))?)
}

/// The pixels of [`side_by_side`], RGB. Masked pixels have difference 0.
fn abreast(truth: &PackedImage, render: &PackedImage, parts: &[PackedImage]) -> Vec<u8> {
    let width = truth.width as usize;
    let mut rgb = Vec::with_capacity(truth.pixels.len() * 3 * (3 + parts.len()));
    for (row, (truths, renders)) in truth.pixels.chunks(width).zip(render.pixels.chunks(width)).enumerate() {
        rgb.extend(truths.iter().flat_map(|pixel| rgb_of(*pixel)));
        rgb.extend(renders.iter().flat_map(|pixel| rgb_of(*pixel)));
        rgb.extend(truths.iter().zip(renders).flat_map(|(a, b)| difference(*a, *b)));
        for part in parts {
            rgb.extend(part.pixels[row * width..][..width].iter().flat_map(|pixel| rgb_of(*pixel)));
        }
    }
    rgb
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
    fn border_lines_arrive_unchanged_and_must_follow_an_axis() {
        let line =
            |from_x: f64, from_z: f64, to_x: f64, to_z: f64| v1::SeamLine { from_x, from_z, to_x, to_z };
        let sent = |borders: Vec<v1::SeamLine>| v1::SeamLines {
            align_quat_wxyz: vec![0.6, 0.0, 0.8, 0.0],
            borders,
            controls: vec![line(-1.0, 7.0, 4.0, 7.0)],
            band: 0.25,
        };
        let (open, until) = (f64::NEG_INFINITY, f64::INFINITY);
        let lines = seam_lines(&sent(vec![line(2.0, open, 2.0, until)])).ok();
        let expected = SeamLines {
            world_to_aligned: DQuat::from_xyzw(0.0, 0.8, 0.0, 0.6),
            borders: vec![Line { axis: Axis::X, at: 2.0, from: open, to: until }],
            controls: vec![Line { axis: Axis::Z, at: 7.0, from: -1.0, to: 4.0 }],
            band: 0.25,
        };
        assert_eq!(lines, Some(expected));
        for crooked in [line(0.0, 0.0, 1.0, 1.0), line(1.0, 1.0, 1.0, 1.0), line(f64::NAN, 0.0, 1.0, 0.0)] {
            assert!(seam_lines(&sent(vec![crooked])).is_err(), "{crooked:?}");
        }
    }

    #[test]
    fn pictures_stand_side_by_side_row_by_row() {
        let picture = |codes: [u8; 2]| PackedImage {
            width: 1,
            height: 2,
            pixels: codes.iter().map(|code| u32::from_le_bytes([*code, 0, 0, 255])).collect(),
        };
        let pictures = [[100, 101], [110, 120], [1, 2], [3, 4]].map(picture);
        let rgb = abreast(&pictures[0], &pictures[1], &pictures[2..]);
        let reds: Vec<u8> = rgb.iter().step_by(3).copied().collect();
        assert_eq!(reds, [100, 110, 40, 1, 3, 101, 120, 76, 2, 4]);
    }

    #[test]
    fn differences_are_amplified_and_masked_pixels_have_none() {
        let pixel = |rgb: [u8; 3], mask: u8| u32::from_le_bytes([rgb[0], rgb[1], rgb[2], mask]);
        let render = pixel([10, 0, 200], 255);
        assert_eq!(difference(pixel([12, 255, 200], 255), render), [8, 255, 0]);
        assert_eq!(difference(pixel([12, 255, 200], 0), render), [0, 0, 0]);
    }
}
