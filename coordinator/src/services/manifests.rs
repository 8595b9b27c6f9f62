//! Manifests of new jobs.

use std::collections::HashSet;
use std::sync::Arc;

use fathom_core::scene::{BlobRef, Manifest};
use fathom_observe::threads;

use super::datasets::Read;
use super::turn_to_read;
use crate::datasets::FileList;
use crate::objects::BlobStore;
use crate::own_tasks::input::MAX_MANIFEST_BYTES;
use crate::service_error::ServiceError;

/// Memory of a manifest and its parsed form, as a multiple of its length.
const MANIFEST_TAKES: u64 = 3;

/// Refuses a manifest that cannot be read, or that names missing blobs or photographs outside its dataset.
/// The named blobs are young when this returns, so they are not collected before the job references them.
///
/// # Errors
/// When it is refused, with the missing files.
pub async fn check(
    objects: &Arc<BlobStore>,
    manifest: &BlobRef,
    of_dataset: Option<Read<FileList>>,
) -> Result<(), ServiceError> {
    if manifest.bytes > MAX_MANIFEST_BYTES {
        return Err(refused(format!(
            "has {} bytes, and a manifest has at most {MAX_MANIFEST_BYTES}; is it the reference of another file?",
            manifest.bytes
        )));
    }
    if !objects.contains(manifest).await? {
        return Err(ServiceError::BlobMissing { digest: manifest.digest.clone() });
    }
    let _turn = turn_to_read(MANIFEST_TAKES * manifest.bytes).await;
    let bytes = objects.read_at_most(manifest, MAX_MANIFEST_BYTES).await?;
    // It may be long.
    let named = threads::blocking(move || {
        let manifest = Manifest::from_json(&bytes).map_err(|error| {
            let message = error.to_string();
            message.strip_prefix("manifest: ").map_or(message.clone(), str::to_owned)
        })?;
        let mut seen = HashSet::new();
        let mut named: Vec<(String, BlobRef)> = Vec::new();
        let of_views = manifest.views.into_iter().flat_map(|view| {
            let name = view.name;
            std::iter::once(view.image).chain(view.mask).map(move |blob| (name.clone(), blob))
        });
        named.extend(of_views);
        named.retain(|(_, blob)| seen.insert(blob.clone()));
        if let Some(list) = of_dataset {
            let wanted: HashSet<(&str, u64)> =
                named.iter().map(|(_, blob)| (blob.digest.as_str(), blob.bytes)).collect();
            let there: HashSet<(&str, u64)> = list
                .value
                .files()
                .map(|file| (file.digest, file.bytes))
                .filter(|file| wanted.contains(file))
                .collect();
            let lacking = named.iter().find(|(_, blob)| !there.contains(&(blob.digest.as_str(), blob.bytes)));
            if let Some((name, _)) = lacking {
                return Err(format!("names {name}, which is not among the files of the dataset"));
            }
        }
        // The coordinator makes them from the files of a dataset, so they need not be among these.
        named.push(("the sparse points".to_owned(), manifest.points));
        // Also for a dataset: it keeps its files, but a disk may have lost one, and the job would fail later.
        Ok(named)
    });
    let named = named.await.unwrap_or_else(|error| Err(format!("cannot be read: {error}")));
    let (mut names, blobs): (Vec<String>, Vec<BlobRef>) = named.map_err(refused)?.into_iter().unzip();
    let missing = objects.missing(&blobs).await?;
    let Some(&first) = missing.first() else { return Ok(()) };
    let (name, digest) = (names.swap_remove(first), blobs[first].digest.clone());
    Err(ServiceError::FilesMissing { of: "manifest", count: missing.len() as u64, name, digest })
}

/// Photographs, masks and points of a manifest that the disk has lost or changed, by the names of their
/// views; empty if none is missing. If one is missing, all are verified, so that the user can upload all of
/// them at once.
///
/// # Errors
/// When the manifest or the disk cannot be read.
pub async fn lost(objects: &BlobStore, manifest: &BlobRef) -> Result<Vec<String>, ServiceError> {
    let _turn = turn_to_read(MANIFEST_TAKES * manifest.bytes).await;
    let bytes = objects.read_at_most(manifest, MAX_MANIFEST_BYTES).await?;
    // It was verified when the job was created.
    let Ok(manifest) = Manifest::from_json(&bytes) else { return Ok(Vec::new()) };
    let mut named: Vec<(String, BlobRef)> = Vec::new();
    for view in manifest.views {
        named.extend(view.mask.map(|mask| (format!("the mask of {}", view.name), mask)));
        named.push((view.name, view.image));
    }
    named.push(("the sparse points".to_owned(), manifest.points));
    let blobs: Vec<BlobRef> = named.iter().map(|(_, blob)| blob.clone()).collect();
    let mut lost = Vec::new();
    if !objects.missing(&blobs).await?.is_empty() {
        for (name, blob) in named {
            if objects.set_aside_if_damaged(&blob.digest).await? || !objects.contains(&blob).await? {
                lost.push(name);
            }
        }
    }
    Ok(lost)
}

/// The error of a job that lacks some of its files.
pub fn message_of_lost(names: &[String]) -> String {
    let shown = names.iter().take(MOST_SHOWN).cloned().collect::<Vec<_>>().join(", ");
    let more = names.len().saturating_sub(MOST_SHOWN);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    format!(
        "the coordinator's disk has lost or changed files of the scene: {shown}{more}; check the disk, submit the scene again, \
         which sends what is missing, and retry this job"
    )
}

/// Maximum names in a sentence.
const MOST_SHOWN: usize = 20;

fn refused(message: String) -> ServiceError {
    ServiceError::BadArgument { field: "manifest", message }
}
