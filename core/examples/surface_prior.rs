//! Finds the water surface of a scene from its tracks, without training and without a GPU.
//!
//! `cargo run --example surface_prior -- SCENE [--offset O] [--normal X,Y,Z] [--ior N] [--up X,Y,Z]
//! [--start paper]`; held-out views are not used. It prints one JSON object: the plane, its standard errors,
//! and its distance from the truth if SCENE has `truth/surface.json`.

use std::error::Error;
use std::path::PathBuf;
use std::time::Instant;

use fathom_core::config::DataConfig;
use fathom_core::scene::{Purpose, load_scene};
use fathom_core::surface::{SurfaceOptions, SurfacePrior, SurfaceStart};
use glam::DVec3;
use serde_json::{Value, json};

fn direction(text: &str) -> Result<DVec3, Box<dyn Error>> {
    let numbers = text.split(',').map(str::parse).collect::<Result<Vec<f64>, _>>()?;
    Ok(DVec3::from(<[f64; 3]>::try_from(numbers).map_err(|_| "a direction has three numbers: X,Y,Z")?))
}

/// How far the plane is from that of `truth/surface.json`.
fn errors(prior: &SurfacePrior, truth: &Value) -> Option<Value> {
    let normal: Vec<f64> = truth["normal"].as_array()?.iter().filter_map(Value::as_f64).collect();
    let normal = DVec3::from(<[f64; 3]>::try_from(normal).ok()?).normalize();
    let offset = truth["offset"].as_f64()?;
    let height = offset - normal.dot(prior.centre);
    // The arc cosine would lose small angles.
    let tilt_degrees = prior.surface.normal.cross(normal).length().asin().to_degrees();
    Some(json!({
        "offset": prior.surface.offset - offset,
        "offset_share": (prior.surface.offset - offset) / prior.viewing_distance,
        "height_at_centre": height,
        "height_in_standard_errors": prior.standard_error.map(|error| height / error.offset),
        "tilt_degrees": tilt_degrees,
        "tilt_in_standard_errors": prior.standard_error.map(|error| tilt_degrees / error.tilt_degrees),
        "ior": truth["ior"],
    }))
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut words = std::env::args().skip(1);
    let usage = "usage: surface_prior SCENE [--offset O] [--normal X,Y,Z] [--ior N] [--up X,Y,Z] \
                 [--start paper|tracks]";
    let root = PathBuf::from(words.next().ok_or(usage)?);
    let mut options = SurfaceOptions::default();
    while let Some(key) = words.next() {
        let value = words.next().ok_or(usage)?;
        match key.as_str() {
            "--offset" => options.offset = Some(value.parse()?),
            "--normal" => options.normal = Some(direction(&value)?),
            "--ior" => options.ior = value.parse()?,
            "--up" => options.up = Some(direction(&value)?),
            "--start" if value == "paper" => options.start = SurfaceStart::Paper,
            "--start" if value == "tracks" => options.start = SurfaceStart::Tracks,
            _ => return Err(usage.into()),
        }
    }
    let data = DataConfig::default();
    let scene = load_scene(&root, Purpose::Train, &data)?;
    let started = Instant::now();
    // As text: an error that ends `main` is shown with the names of its fields.
    let prior = SurfacePrior::of_scene(&scene, data.test_every, &options);
    let prior = prior.map_err(|error| error.to_string())?;
    let seconds = started.elapsed().as_secs_f64();
    let truth = root.join("truth/surface.json");
    let truth: Option<Value> =
        if truth.is_file() { Some(serde_json::from_slice(&std::fs::read(truth)?)?) } else { None };
    let result = json!({
        "normal": prior.surface.normal.to_array(),
        "offset": prior.surface.offset,
        "ior": prior.surface.ior,
        "standard_error": prior.standard_error.map(|error| json!({
            "offset": error.offset,
            "offset_share": error.offset_share,
            "tilt_degrees": error.tilt_degrees,
        })),
        "error": truth.and_then(|truth| errors(&prior, &truth)),
        "centre": prior.centre.to_array(),
        "viewing_distance": prior.viewing_distance,
        "wet_tracks": prior.wet_tracks,
        "dry_tracks": prior.dry_tracks,
        "wet_points": prior.wet.len(),
        "dry_points": prior.dry.len(),
        "wet_error_px": prior.wet_error_px,
        "wet_straight_error_px": prior.wet_straight_error_px,
        "dry_error_px": prior.dry_error_px,
        "seconds": seconds,
    });
    println!("{}", serde_json::to_string_pretty(&result)?);
    Ok(())
}
