//! Downloads the files of a job.

use std::path::Path;

use fathom_core::paths::check_inside;
use fathom_proto::direct::DirectError;
use fathom_proto::v1::{BlobRef, ReadBlobRequest};
use tokio::io::AsyncWriteExt as _;

use crate::client::{Client, passing};
use crate::error::{CliError, Result};
use crate::progress::{Progress, Unit};

/// Attempts in a row without a new byte.
const ATTEMPTS: u32 = 16;

impl Client {
    /// Writes all files of a succeeded job under `out`.
    ///
    /// Existing files with the right content are kept. All others are written under a temporary name, hashed
    /// and renamed, so `out` never holds a partial file.
    pub async fn download(&self, id: &str, out: &Path) -> Result<Vec<String>> {
        let artifacts = self.artifacts(id).await?;
        let total = artifacts.iter().filter_map(|a| a.blob.as_ref()).map(|blob| blob.size_bytes).sum();
        // Never replace a file of another origin; a file that an earlier download wrote is identical.
        for artifact in &artifacts {
            let Some(blob) = &artifact.blob else { continue };
            let path = safe_path(out, &artifact.path)?;
            if path.exists() && !holds(&path, blob) {
                return Err(CliError::Message(format!(
                    "{} already exists with other content; choose another folder, or move it away",
                    path.display()
                )));
            }
        }
        let progress = Progress::new("downloading", total, Unit::Bytes);
        let mut done = 0;
        for artifact in &artifacts {
            let Some(blob) = &artifact.blob else { continue };
            let path = safe_path(out, &artifact.path)?;
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder).map_err(CliError::io("create", folder))?;
            }
            if !holds(&path, blob) {
                let base = done;
                self.fetch(id, blob, &path, |arrived| progress.set(base + arrived, &artifact.path)).await?;
            }
            done += blob.size_bytes;
            progress.set(done, &artifact.path);
        }
        Ok(artifacts.into_iter().map(|artifact| artifact.path).collect())
    }

    async fn fetch(&self, job: &str, blob: &BlobRef, path: &Path, arrived: impl Fn(u64)) -> Result<()> {
        let name = path.file_name().map_or_else(|| "file".into(), |name| name.to_string_lossy());
        let partial = path.with_file_name(format!(".{name}.part"));
        // The coordinator looks at a blob when it sends it, and sets it aside if the bucket has changed it.
        for may_be_direct in [true, false] {
            let fetched = self.fetch_once(job, blob, &partial, may_be_direct, &arrived).await?;
            if fetched.is_whole {
                return tokio::fs::rename(&partial, path).await.map_err(CliError::io("rename", path));
            }
            if !fetched.was_direct {
                break;
            }
        }
        Err(CliError::Message(format!(
            "{} does not match the digest that the coordinator announced; run the download again",
            path.display()
        )))
    }

    /// Writes a blob to `partial`; if `may_be_direct`, from the bucket where the coordinator offers it.
    async fn fetch_once(
        &self,
        job: &str,
        blob: &BlobRef,
        partial: &Path,
        may_be_direct: bool,
        arrived: &impl Fn(u64),
    ) -> Result<Fetched> {
        let file = tokio::fs::File::create(partial).await.map_err(CliError::io("write", partial))?;
        let mut arriving = Arriving { file, partial, hasher: blake3::Hasher::new(), offset: 0 };
        let (mut was_direct, mut failures) = (false, 0);
        while arriving.offset < blob.size_bytes {
            let before = arriving.offset;
            let request = ReadBlobRequest {
                digest: blob.digest.clone(),
                offset_bytes: before,
                job_id: job.to_owned(),
                direct: may_be_direct && self.direct.is_wanted(),
            };
            let call = || async { self.uploads.clone().read_blob(request.clone()).await };
            let mut stream = self.patient("send a file", call).await?;
            let end = loop {
                match stream.message().await {
                    Ok(Some(piece)) if !piece.url.is_empty() => {
                        was_direct = true;
                        match self.fetch_from(&piece.url, blob, &mut arriving, arrived).await? {
                            Ok(()) => {}
                            Err(error) => self.direct.failed(&error),
                        }
                        break None;
                    }
                    Ok(Some(piece)) => {
                        arriving.write(&piece.data).await?;
                        arrived(arriving.offset);
                    }
                    Ok(None) => break None,
                    Err(status) => break Some(status),
                }
            };
            failures = if arriving.offset > before { 0 } else { failures + 1 };
            match end {
                Some(status) if !passing(&status) || failures > ATTEMPTS => {
                    return Err(self.fault("send a file", &status));
                }
                None if arriving.offset < blob.size_bytes && failures > ATTEMPTS => {
                    let message = format!("the coordinator's copy of blob {} is truncated", blob.digest);
                    return Err(CliError::Message(message));
                }
                _ => {}
            }
        }
        arriving.file.sync_all().await.map_err(CliError::io("write", partial))?;
        let is_whole = arriving.hasher.finalize().to_hex().as_str() == blob.digest;
        Ok(Fetched { was_direct, is_whole })
    }

    /// Appends what is missing from the bucket. The outer error is one of this machine.
    async fn fetch_from(
        &self,
        url: &str,
        blob: &BlobRef,
        arriving: &mut Arriving<'_>,
        arrived: &impl Fn(u64),
    ) -> Result<std::result::Result<(), DirectError>> {
        let missing = blob.size_bytes - arriving.offset;
        let mut pieces = match self.direct.get(url, arriving.offset, missing).await {
            Ok(pieces) => pieces,
            Err(error) => return Ok(Err(error)),
        };
        loop {
            match pieces.next().await {
                Ok(Some(data)) => arriving.write(&data).await?,
                Ok(None) => return Ok(Ok(())),
                Err(error) => return Ok(Err(error)),
            }
            arrived(arriving.offset);
        }
    }
}

/// How a blob arrived.
struct Fetched {
    /// Whether any of it came from the bucket.
    was_direct: bool,
    /// Whether it matches its digest.
    is_whole: bool,
}

/// A file that is being downloaded.
struct Arriving<'a> {
    file: tokio::fs::File,
    partial: &'a Path,
    hasher: blake3::Hasher,
    offset: u64,
}

impl Arriving<'_> {
    async fn write(&mut self, data: &[u8]) -> Result<()> {
        self.file.write_all(data).await.map_err(CliError::io("write", self.partial))?;
        self.hasher.update(data);
        self.offset += data.len() as u64;
        Ok(())
    }
}

/// The path of an artifact under `out`. A path that would leave `out` is refused, even from the coordinator.
pub fn safe_path(out: &Path, relative: &str) -> Result<std::path::PathBuf> {
    match check_inside(relative) {
        Ok(()) => Ok(out.join(relative)),
        Err(fault) => {
            let shown: String = relative.chars().take(80).collect();
            Err(CliError::Message(format!(
                "the coordinator sent a file named {shown:?}, whose path {fault}; nothing was written"
            )))
        }
    }
}

fn holds(path: &Path, blob: &BlobRef) -> bool {
    let same_size = std::fs::metadata(path).is_ok_and(|meta| meta.len() == blob.size_bytes);
    same_size && crate::blob::digest_file(path).is_ok_and(|digest| digest.digest == blob.digest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_that_leaves_the_folder_is_refused() {
        let out = Path::new("/tmp/out");
        assert_eq!(safe_path(out, "renders/a.png").ok(), Some(out.join("renders/a.png")));
        for wrong in ["../a", "/etc/passwd", "a/../../b", "", "a//b", "C:\\a"] {
            assert!(safe_path(out, wrong).is_err(), "{wrong}");
        }
    }
}
