//! Estimates the water of a scene from its photographs without training, for `make accept` and for a first
//! look.
//!
//! `cargo run --example water_prior -- SCENE [--max-resolution PX] [--tracks BOOL] [--beyond-points BOOL]`;
//! held-out views are not used. It prints one JSON object: the water parameters, their standard errors, and
//! the ground truth if SCENE has `truth/water.json`.

use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

use fathom_core::config::DataConfig;
use fathom_core::picture::{Photograph, prepare, prepared_camera};
use fathom_core::scene::{Camera, Purpose, Tracks, View, load_scene};
use fathom_core::views::{PackedImage, TrainView, ViewSource};
use fathom_core::water::water_prior;
use fathom_core::{CoreError, Result};
use serde_json::{Value, json};

/// Photographs in a folder, read on demand.
struct Folder {
    views: Vec<TrainView>,
    files: Vec<(View, Camera)>,
    data: DataConfig,
}

impl ViewSource for Folder {
    fn views(&self) -> &[TrainView] {
        &self.views
    }

    fn load(&self, index: usize) -> Result<Arc<PackedImage>> {
        let (view, camera) = &self.files[index];
        let read = |path: &PathBuf| std::fs::read(path).map_err(CoreError::io("read", path));
        let image = read(view.image.as_ref().ok_or_else(|| CoreError::Scene("no photograph".to_owned()))?)?;
        let mask = view.mask.as_ref().map(read).transpose()?;
        let photograph = Photograph { name: &view.name, image: &image, mask: mask.as_deref() };
        Ok(Arc::new(prepare(&photograph, camera, self.data.mask_keep, self.data.max_resolution)?.1))
    }
}

/// JSON has no infinity, so an infinite error is written as "unknown".
fn numbers(values: [f64; 9]) -> Value {
    let spelt = |value: &f64| if value.is_finite() { json!(value) } else { json!("unknown") };
    let three = |values: &[f64]| Value::Array(values.iter().map(spelt).collect());
    json!({"beta_d": three(&values[..3]), "beta_b": three(&values[3..6]), "b_inf": three(&values[6..])})
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut words = std::env::args().skip(1);
    let usage = "usage: water_prior SCENE [--max-resolution PX] [--tracks BOOL] [--beyond-points BOOL]";
    let root = PathBuf::from(words.next().ok_or(usage)?);
    let (mut data, mut with_tracks, mut beyond_points) = (DataConfig::default(), true, true);
    while let Some(key) = words.next() {
        let value = words.next().ok_or(usage)?;
        match key.as_str() {
            "--max-resolution" => data.max_resolution = value.parse()?,
            "--tracks" => with_tracks = value.parse()?,
            "--beyond-points" => beyond_points = value.parse()?,
            _ => return Err(usage.into()),
        }
    }
    let mut scene = load_scene(&root, Purpose::Train, &data)?;
    if !with_tracks {
        scene.points.tracks = Tracks::default();
    }
    let (mut views, mut files, mut scene_views) = (Vec::new(), Vec::new(), Vec::new());
    for (index, view) in (0_u32..).zip(&scene.views) {
        if data.test_every > 0 && index.is_multiple_of(data.test_every) {
            continue;
        }
        let camera = scene.camera(view.camera_id).ok_or("a view refers to a missing camera")?;
        views.push(TrainView {
            name: view.name.clone(),
            camera: prepared_camera(camera, data.max_resolution)?,
            pose: view.pose,
            clear_range: 0.0,
        });
        files.push((view.clone(), camera.clone()));
        scene_views.push(index);
    }
    let source = Folder { views, files, data };
    let started = Instant::now();
    let estimate = water_prior(&scene.points, &source, &scene_views, beyond_points)?;
    let seconds = started.elapsed().as_secs_f64();
    let (prior, water) = (estimate.sparse.clone()?, estimate.water.ok_or("the water cannot be estimated")?);

    let truth = root.join("truth/water.json");
    let truth: Option<Value> =
        if truth.is_file() { Some(serde_json::from_slice(&std::fs::read(truth)?)?) } else { None };
    let result = json!({
        "water": numbers(water.to_array()),
        "standard_error": numbers(estimate.standard_error),
        "by_direction": estimate.by_direction,
        "open_water": estimate.open.as_ref().map(|open| json!({
            "share": open.share, "views": open.views, "colour": open.colour().0, "standard_error": open.colour().1
        })),
        "by_darkness": estimate.by_darkness,
        "by_points_alone": {
            "water": numbers(prior.water.to_array()), "standard_error": numbers(prior.standard_error)
        },
        "truth": truth.map(|truth| json!({
            "beta_d": truth["beta_d_per_m"], "beta_b": truth["beta_b_per_m"], "b_inf": truth["b_inf_linear"]
        })),
        "points": prior.points,
        "observations": prior.observations,
        "inliers": prior.inliers,
        "ranges_p5_p50_p95": prior.ranges,
        "range_ratio": prior.range_ratio,
        "seconds": seconds,
    });
    println!("{}", serde_json::to_string_pretty(&result)?);
    Ok(())
}
