//! The one error type of this crate.
//!
//! A variant exists where somebody acts on it (the worker reports memory errors by class, ingest
//! names the file); everything else is a sentence with the fact and the way out.

use std::path::PathBuf;

/// Result with [`CoreError`].
pub type Result<T, E = CoreError> = std::result::Result<T, E>;

/// What can go wrong in the trainer and its readers.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CoreError {
    /// A file could not be read or written.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", "create", ...
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Input that cannot be used: which file, where in it, what is wrong and what helps.
    #[error("{path}: {message}", path = path.display())]
    Input {
        /// The file at fault.
        path: PathBuf,
        /// Place, fact and way out, one sentence.
        message: String,
    },
    /// A scene that was read but cannot serve the purpose.
    #[error("{0}")]
    Scene(String),
    /// A configuration value out of its range, or two that contradict each other.
    #[error("configuration: {0}")]
    Config(String),
    /// No adapter that may be used.
    #[error("{0}")]
    NoAdapter(String),
    /// A buffer that the device cannot bind or hold.
    #[error(
        "{buffer} needs {needed_bytes} bytes but the device allows {limit_bytes}; \
         use more partitions, lower --max-gaussians or lower --max-resolution"
    )]
    BufferTooLarge {
        /// Which buffer.
        buffer: &'static str,
        /// Bytes it needs.
        needed_bytes: u64,
        /// Bytes the device allows.
        limit_bytes: u64,
    },
    /// The device ran out of memory.
    #[error("the GPU is out of memory ({message}); use more partitions or lower --max-gaussians")]
    OutOfMemory {
        /// What the driver said.
        message: String,
    },
    /// The device was lost or refused a command.
    #[error("GPU: {0}")]
    Gpu(String),
    /// A checkpoint that must not be used.
    #[error("checkpoint: {0}")]
    Checkpoint(String),
}

impl CoreError {
    /// An [`CoreError::Io`] in the making: `.map_err(CoreError::io("read", path))`.
    pub fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }

    /// An [`CoreError::Input`].
    pub fn input(path: impl Into<PathBuf>, message: impl Into<String>) -> Self {
        Self::Input { path: path.into(), message: message.into() }
    }
}
