//! `model.compressed.ply`: a copy of the model with about a quarter of its bytes, which pages load in its
//! place.

use std::io::{self, BufRead, BufReader, Read};
use std::sync::Arc;

use fathom_core::CoreError;
use fathom_core::gaussians::Gaussians;
use fathom_core::ply::{CompressedCopy, SplatReader, compressed};
use fathom_core::scene::BlobRef;
use tokio::sync::Semaphore;

use super::OwnTaskError;
use super::input::blocking;
use crate::objects::BlobStore;

/// Its name among the files of a job.
pub const FILE: &str = "model.compressed.ply";
/// Largest model that is copied, bytes: a million Gaussians of degree 3. It is read into memory.
const MOST_MODEL_BYTES: u64 = 256 << 20;
/// One at a time, so that the memory of this process has a bound.
static PLACE: Semaphore = Semaphore::const_new(1);
/// Gaussians that are read at a time.
const BLOCK: usize = 1 << 14;

/// Stores the copy of a job's model. `None` where there is none: the model is too large, has nothing to show,
/// or the disk is almost full.
pub async fn make(objects: &Arc<BlobStore>, model: &BlobRef) -> Result<Option<BlobRef>, OwnTaskError> {
    make_up_to(MOST_MODEL_BYTES, objects, model).await
}

async fn make_up_to(
    most_bytes: u64,
    objects: &Arc<BlobStore>,
    model: &BlobRef,
) -> Result<Option<BlobRef>, OwnTaskError> {
    if model.bytes > most_bytes {
        let (bytes, most) = (model.bytes, most_bytes);
        tracing::info!(
            bytes,
            most,
            "the model is too large for a compressed copy; `fathom export` makes one"
        );
        return Ok(None);
    }
    // Until the copy is stored. It is never closed.
    let _place = PLACE.acquire().await.ok();
    let (files, path, expected) = (objects.files(), objects.path_of(model)?, model.digest.clone());
    let copy = blocking(move || {
        let (file, _) = files.open(&path).map_err(|error| OwnTaskError::of_io(&error))?;
        let hashed = Hashed { file, hasher: blake3::Hasher::new() };
        let mut file = BufReader::with_capacity(1 << 20, hashed);
        let copy = copy_of(&mut file);
        if let Err(CoreError::Io { source, .. }) = &copy {
            return Err(OwnTaskError::of_io(source));
        }
        io::copy(&mut file, &mut io::sink()).map_err(|error| OwnTaskError::of_io(&error))?;
        let is_damaged = file.into_inner().hasher.finalize().to_hex().as_str() != expected;
        Ok((copy, is_damaged))
    });
    let (copy, is_damaged) = copy.await?;
    if is_damaged {
        let digest = &model.digest;
        // Only partitions can be made again, not what was merged of them.
        return Err(if objects.set_aside_if_damaged(digest).await? {
            OwnTaskError::input(format!(
                "the model {digest} was damaged where it is stored after it was merged; check the disk or the \
                 bucket, and submit the job again"
            ))
        } else {
            OwnTaskError::failed(format!("the model {digest} was read with errors; its file is intact"))
        });
    }
    let copy = match copy {
        Ok(Some(copy)) => copy,
        Ok(None) => return Ok(None),
        Err(error) => {
            tracing::warn!(%error, "the model has no compressed copy");
            return Ok(None);
        }
    };
    if copy.left_out > 0 {
        tracing::warn!(
            left_out = copy.left_out,
            "Gaussians without finite values or a rotation are not in the copy"
        );
    }
    // Nothing depends on it.
    if let Err(error) = objects.check_space(copy.bytes.len() as u64).await {
        tracing::warn!(%error, "the model has no compressed copy");
        return Ok(None);
    }
    Ok(Some(objects.put(copy.bytes.into()).await?))
}

/// A file that is hashed as it is read.
struct Hashed<R> {
    file: R,
    hasher: blake3::Hasher,
}

impl<R: Read> Read for Hashed<R> {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let count = self.file.read(into)?;
        self.hasher.update(&into[..count]);
        Ok(count)
    }
}

/// The copy of a model; `None` of one without Gaussians.
fn copy_of(mut file: impl BufRead) -> Result<Option<CompressedCopy>, CoreError> {
    // The reader of the header does not tell a bucket that is away from a file of another kind.
    file.fill_buf().map_err(CoreError::io("read", "model.ply"))?;
    let mut reader = SplatReader::new(file, "model.ply")?;
    let comments = reader.comments().to_vec();
    let mut model = Gaussians::empty(reader.layout().sh_degree());
    // The header of a damaged file may name any number.
    let most = MOST_MODEL_BYTES / reader.layout().row_bytes() as u64;
    model.reserve(reader.count().min(most) as usize);
    while let Some(block) = reader.next_block(BLOCK)? {
        (0..block.len()).for_each(|index| model.push_from(&block, index));
    }
    Ok(if model.is_empty() { None } else { Some(compressed(&model, &comments)?) })
}

#[cfg(test)]
mod tests {
    use fathom_core::ply;
    use tempfile::TempDir;

    use super::*;
    use crate::clock::Clock;
    use crate::schedule::FailClass;

    async fn stored(model: &Gaussians) -> (TempDir, Arc<BlobStore>, BlobRef) {
        let folder = tempfile::tempdir().unwrap();
        let objects = Arc::new(BlobStore::open(folder.path(), 0, Clock::start()).unwrap());
        let bytes = ply::to_bytes(model, &["fathom_water {}".to_owned()]).unwrap();
        let blob = objects.put(bytes.into()).await.unwrap();
        (folder, objects, blob)
    }

    fn model(rotation: [f32; 4]) -> Gaussians {
        let mut model = Gaussians::empty(0);
        for n in 0..300 {
            model.means.push([n as f32, 0.0, 1.0]);
            model.quats.push(rotation);
            model.log_scales.push([-1.0; 3]);
            model.opacity_logits.push(0.5);
            model.sh_coeffs.push([0.1, 0.2, 0.3]);
        }
        model
    }

    #[tokio::test]
    async fn the_copy_has_all_gaussians_and_the_comments() {
        let (_folder, objects, blob) = stored(&model([1.0, 0.0, 0.0, 0.0])).await;
        let copy = make(&objects, &blob).await.unwrap().unwrap();
        let bytes = objects.read(&copy).await.unwrap();
        let header = String::from_utf8_lossy(&bytes[..1200.min(bytes.len())]).into_owned();
        assert!(header.contains("comment fathom_water {}\n"), "{header}");
        assert!(header.contains("element vertex 300\n"), "{header}");
        assert!(copy.bytes < blob.bytes / 2, "{} of {} bytes", copy.bytes, blob.bytes);
        assert_eq!(make(&objects, &blob).await.unwrap(), Some(copy), "the same bytes again");
    }

    #[tokio::test]
    async fn a_model_without_a_copy_fails_no_job() {
        let (_folder, objects, blob) = stored(&model([1.0, 0.0, 0.0, 0.0])).await;
        assert_eq!(make_up_to(blob.bytes - 1, &objects, &blob).await.unwrap(), None, "too large");
        let (_folder, objects, blob) = stored(&model([0.0; 4])).await;
        assert_eq!(make(&objects, &blob).await.unwrap(), None, "nothing to show");
        let (_folder, objects, blob) = stored(&Gaussians::empty(0)).await;
        assert_eq!(make(&objects, &blob).await.unwrap(), None, "no Gaussians");
    }

    #[tokio::test]
    async fn a_model_that_cannot_be_read_fails_the_task() {
        let (_folder, objects, blob) = stored(&model([1.0, 0.0, 0.0, 0.0])).await;
        let lost = BlobRef { digest: "0".repeat(64), ..blob };
        assert!(make(&objects, &lost).await.is_err());
    }

    #[tokio::test]
    async fn a_damaged_model_fails_the_job_with_a_remedy() {
        let (folder, objects, blob) = stored(&model([1.0, 0.0, 0.0, 0.0])).await;
        let path = objects.path_of(&blob).unwrap();
        let mut bytes = std::fs::read(&path).unwrap();
        // In a centre, so that the file can still be read.
        let at = bytes.len() - 60;
        bytes[at] ^= 1;
        std::fs::remove_file(&path).unwrap();
        std::fs::write(&path, bytes).unwrap();
        let error = make(&objects, &blob).await.unwrap_err();
        assert_eq!((error.class, error.lost.len()), (FailClass::Input, 0), "{error}");
        assert!(error.message.contains("submit the job again"), "{error}");
        assert!(!objects.contains(&blob).await.unwrap(), "the damaged file is set aside");
        drop(folder);
    }
}
