//! Errors of the object store.

use std::io;
use std::path::PathBuf;

use crate::store::StoreError;

/// Errors of the object store.
#[derive(Debug, thiserror::Error)]
pub enum ObjectError {
    /// Not 64 lower-case hex digits.
    #[error("{0:?} is not a digest; a digest is BLAKE3 as 64 lower-case hex digits")]
    BadDigest(String),
    /// There is no such blob.
    #[error("there is no blob {0}; upload it first")]
    NotFound(String),
    /// A write at the wrong offset.
    #[error("the upload of {digest} continues at byte {committed_bytes}, not at {offset_bytes}")]
    WrongOffset {
        /// The blob.
        digest: String,
        /// The offset received.
        offset_bytes: u64,
        /// The offset expected.
        committed_bytes: u64,
    },
    /// The bytes differ from the declaration.
    #[error("blob {digest}: {message}; the received bytes were deleted, send the blob again")]
    DigestMismatch {
        /// The declared digest.
        digest: String,
        /// The fault.
        message: String,
    },
    /// A blob that is too large to be read into memory as its type.
    #[error("blob {digest} is {bytes} bytes; the limit for this type is {most}")]
    TooLarge {
        /// The blob.
        digest: String,
        /// Its length.
        bytes: u64,
        /// The limit.
        most: u64,
    },
    /// A blob has changed on disk.
    #[error(
        "blob {0} has another digest on the coordinator's disk: the disk changed it; check the disk, and upload the blob again"
    )]
    Damaged(String),
    /// The work on an upload has ended early, after an error or at the end of the process.
    #[error("the upload was interrupted; call QueryBlob and continue it")]
    Interrupted,
    /// An upload to the bucket of which nothing has arrived, or whose time is over.
    #[error("nothing of this upload is in the bucket, or its time is over; send the blob with WriteBlob")]
    NoUpload,
    /// Another stream writes this blob.
    #[error("blob {0} is being written by another stream; call QueryBlob and try again")]
    Busy(String),
    /// A tenant would exceed its quota.
    #[error("the blobs use {used_bytes} of {limit_bytes} bytes")]
    OverLimit {
        /// Bytes used.
        used_bytes: u64,
        /// Bytes allowed.
        limit_bytes: u64,
    },
    /// The disk is nearly full.
    #[error(
        "{free_bytes} bytes are free on the coordinator's disk, but {min_free_bytes} must stay free; free some space"
    )]
    LowSpace {
        /// Bytes free.
        free_bytes: u64,
        /// Bytes that must stay free.
        min_free_bytes: u64,
    },
    /// The file system failed.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", ...
        action: &'static str,
        /// The path.
        path: PathBuf,
        /// The error of the system.
        source: io::Error,
    },
    /// The local disk failed.
    #[error("object store: {0}")]
    Store(#[from] object_store::Error),
    /// The bucket does not answer, or refuses.
    #[error("the object store is not available: {0}")]
    Unavailable(object_store::Error),
    /// The database that counts the blobs failed.
    #[error(transparent)]
    Ledger(#[from] StoreError),
    /// Deletions took too long.
    #[error("the object store did not delete objects within {seconds} s; the next garbage collection will")]
    Late {
        /// The limit.
        seconds: u64,
    },
    /// A URL that names no object store.
    #[error("objects = {url:?}: {message}")]
    BadUrl {
        /// The URL.
        url: String,
        /// The fault.
        message: String,
    },
    /// The files of another deployment are in the bucket.
    #[error(
        "{place} has the files of another deployment ({found}, this is {ours}), and this coordinator would delete them: \
         pass the right --objects or --store; if the jobs of that deployment are lost for good, remove {marker} from the bucket"
    )]
    OfOther {
        /// The URL.
        place: String,
        /// Its deployment.
        found: String,
        /// The deployment of this coordinator.
        ours: String,
        /// The object that names it.
        marker: String,
    },
}

impl ObjectError {
    /// Whether the disk, or the process's quota on it, is full.
    pub fn is_full(&self) -> bool {
        let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(self);
        while let Some(error) = cause {
            if let Some(error) = error.downcast_ref::<io::Error>()
                && matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded)
            {
                return true;
            }
            cause = error.source();
        }
        false
    }
}
