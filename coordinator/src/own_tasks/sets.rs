//! The files of a scene with a water surface: the scene without it as `model.ply`, which every viewer shows,
//! its three sets in `sets/`, and `surface.json`.

use std::io::BufReader;
use std::sync::Arc;

use bytes::Bytes;
use fathom_core::ply::{self, SplatReader};
use fathom_core::scene::BlobRef;
use fathom_core::surface::SurfaceModel;
use tokio::sync::Semaphore;

use super::OwnTaskError;
use super::input::blocking;
use crate::objects::BlobStore;

/// One at a time: a model is held in memory.
static PLACE: Semaphore = Semaphore::const_new(1);

/// Stores the files of `model`, with their names.
pub async fn make(objects: &Arc<BlobStore>, model: &BlobRef) -> Result<Vec<(String, BlobRef)>, OwnTaskError> {
    // Until all are stored. It is never closed.
    let _place = PLACE.acquire().await.ok();
    let (files, path) = (objects.files(), objects.path_of(model)?);
    let made = blocking(move || {
        let (file, _) = files.open(&path).map_err(|error| OwnTaskError::of_io(&error))?;
        let failed = |error: fathom_core::CoreError| OwnTaskError::failed(error.to_string());
        let reader =
            SplatReader::new(BufReader::with_capacity(1 << 20, file), "model.ply").map_err(failed)?;
        let model = ply::surface_from_rows(reader).map_err(failed)?;
        let model = model.ok_or_else(|| {
            OwnTaskError::failed("the merged model has no water surface; use workers of one version".into())
        })?;
        files_of(&model).map_err(failed)
    });
    let mut stored = Vec::new();
    for (name, bytes) in made.await? {
        stored.push((name.to_owned(), objects.put(Bytes::from(bytes)).await?));
    }
    Ok(stored)
}

fn files_of(model: &SurfaceModel) -> Result<Vec<(&'static str, Vec<u8>)>, fathom_core::CoreError> {
    let disks = [ply::DISKS.to_owned()];
    let record = serde_json::to_vec_pretty(&model.record)
        .map_err(|error| fathom_core::CoreError::Config(format!("surface.json: {error}")))?;
    let [base, reflected, refracted] = model.set_files()?;
    Ok(vec![
        ("model.ply", ply::to_bytes(&model.dry(), &disks)?),
        ("sets/base.ply", base),
        ("sets/reflected.ply", reflected),
        ("sets/refracted.ply", refracted),
        ("surface.json", record),
    ])
}
