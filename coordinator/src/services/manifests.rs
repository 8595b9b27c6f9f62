//! Manifests that jobs are made of.

use std::collections::HashSet;
use std::sync::Arc;

use fathom_core::scene::{BlobRef, Manifest};
use fathom_observe::threads;

use super::convert::ServiceError;
use super::turn_to_read;
use crate::datasets::FileList;
use crate::objects::BlobStore;
use crate::pipeline::MAX_MANIFEST_BYTES;

/// Refuses a manifest that cannot be read, or that names what is not there: of a dataset, what is not among its files. What it names
/// is young when this returns, and no garbage before there is a job that refers to it.
///
/// # Errors
/// When it is so, with what is missing.
pub async fn check(
    objects: &Arc<BlobStore>,
    manifest: &BlobRef,
    of_dataset: Option<FileList>,
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
    let turn = turn_to_read(manifest.bytes).await;
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
        named.extend(of_views.chain([("the sparse points".to_owned(), manifest.points)]));
        named.retain(|(_, blob)| seen.insert(blob.clone()));
        if let Some(list) = of_dataset {
            let there: HashSet<&BlobRef> = list.files().iter().map(|file| &file.blob).collect();
            return match named.into_iter().find(|(_, blob)| !there.contains(blob)) {
                Some((name, _)) => Err(format!("names {name}, which is not among the files of the dataset")),
                // A frozen dataset keeps them.
                None => Ok(Vec::new()),
            };
        }
        Ok(named)
    });
    let named = named.await.unwrap_or_else(|error| Err(format!("cannot be read: {error}")));
    // To look for millions of files takes long, and little memory.
    drop(turn);
    let (mut count, mut first) = (0, None);
    for (name, blob) in named.map_err(refused)? {
        if !objects.contains(&blob).await? {
            count += 1;
            first.get_or_insert((name, blob.digest));
        }
    }
    match first {
        Some((name, digest)) => Err(ServiceError::FilesMissing { of: "manifest", count, name, digest }),
        None => Ok(()),
    }
}

fn refused(message: String) -> ServiceError {
    ServiceError::BadArgument { field: "manifest", message }
}
