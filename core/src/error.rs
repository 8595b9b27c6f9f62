//! The one error type of this crate.
//!
//! An error has a variant of its own if callers act on it: the worker reports memory errors by class, ingest
//! names the file. All others are one sentence that states the fact and the remedy.

use std::path::PathBuf;

/// Result with [`CoreError`].
pub type Result<T, E = CoreError> = std::result::Result<T, E>;

/// Errors of the trainer and its readers.
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
        /// The error from the operating system.
        source: std::io::Error,
    },
    /// Unusable input: the file, the place in it, the fault and the remedy.
    #[error("{path}: {message}", path = path.display())]
    Input {
        /// The file at fault.
        path: PathBuf,
        /// Place, fact and remedy in one sentence.
        message: String,
    },
    /// A scene that was read but is unsuitable for the purpose.
    #[error("{0}")]
    Scene(String),
    /// A configuration value out of its range, or two that contradict each other.
    #[error("configuration: {0}")]
    Config(String),
    /// No usable adapter.
    #[error("{0}")]
    NoAdapter(String),
    /// A buffer that the device cannot bind or hold.
    #[error(
        "{}; use more partitions, lower --max-gaussians or lower --max-resolution",
        too_large(buffer, *needed_bytes, *limit_bytes)
    )]
    BufferTooLarge {
        /// Name of the buffer.
        buffer: &'static str,
        /// Bytes it needs.
        needed_bytes: u64,
        /// Bytes the device allows.
        limit_bytes: u64,
    },
    /// The device has no memory left.
    #[error(
        "{}; use more partitions or lower --max-gaussians",
        out_of_memory(*needed_bytes, *available_bytes, message)
    )]
    OutOfMemory {
        /// Allocated plus requested bytes, so the work needs at least this much; `None` if unknown.
        needed_bytes: Option<u64>,
        /// The limit if one was set and exceeded; otherwise the bytes that the driver had granted before it
        /// refused.
        available_bytes: Option<u64>,
        /// What refused which allocation.
        message: String,
    },
    /// The device is lost: the driver was reset or updated, or the GPU was unplugged or hung. Open another
    /// device.
    #[error("the GPU was lost ({message}); the interrupted work must be repeated")]
    DeviceLost {
        /// The message of the driver.
        message: String,
    },
    /// The device refused a command.
    #[error("GPU: {0}")]
    Gpu(String),
    /// A network that got unsuitable input, or has diverged.
    #[error("network: {0}")]
    Network(String),
    /// A checkpoint that must not be used.
    #[error("checkpoint: {0}")]
    Checkpoint(String),
}

impl CoreError {
    /// Builds a [`CoreError::Io`]: `.map_err(CoreError::io("read", path))`.
    pub fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }

    /// The memory shortage without the advice, which is for people who train; `None` for other errors.
    pub fn shortage(&self) -> Option<String> {
        match self {
            Self::BufferTooLarge { buffer, needed_bytes, limit_bytes } => {
                Some(too_large(buffer, *needed_bytes, *limit_bytes))
            }
            Self::OutOfMemory { needed_bytes, available_bytes, message } => {
                Some(out_of_memory(*needed_bytes, *available_bytes, message))
            }
            _ => None,
        }
    }

    /// An [`CoreError::Input`].
    pub fn input(path: impl Into<PathBuf>, message: impl Into<String>) -> Self {
        Self::Input { path: path.into(), message: message.into() }
    }
}

fn too_large(buffer: &str, needed_bytes: u64, limit_bytes: u64) -> String {
    format!("{buffer} needs {needed_bytes} bytes but the device allows {limit_bytes}")
}

fn out_of_memory(needed_bytes: Option<u64>, available_bytes: Option<u64>, message: &str) -> String {
    let need = match (needed_bytes, available_bytes) {
        (Some(needed), Some(available)) => {
            format!(" (needs at least {}, has {})", Size(needed), Size(available))
        }
        _ => String::new(),
    };
    format!("the GPU is out of memory{need}: {message}")
}

/// Bytes for people, "1.5 GiB", in binary units as memory is sold.
pub(crate) struct Size(pub u64);

impl std::fmt::Display for Size {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let units = ["bytes", "KiB", "MiB", "GiB", "TiB"];
        // Rounded before the unit is chosen: 1023.96 KiB are 1.0 MiB.
        let fits = |power: usize| self.0 as f64 / 1024_f64.powi(power as i32) < 1023.95;
        match (0..units.len() - 1).find(|&power| fits(power)).unwrap_or(units.len() - 1) {
            0 => write!(f, "{} bytes", self.0),
            power => write!(f, "{:.1} {}", self.0 as f64 / 1024_f64.powi(power as i32), units[power]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_given_in_the_unit_that_people_read() {
        for (bytes, text) in [
            (0, "0 bytes"),
            (1023, "1023 bytes"),
            (1024, "1.0 KiB"),
            (3 << 19, "1.5 MiB"),
            ((1 << 30) - 1, "1.0 GiB"),
            (5_583_457_485, "5.2 GiB"),
            (u64::MAX, "16777216.0 TiB"),
        ] {
            assert_eq!(Size(bytes).to_string(), text);
        }
    }

    #[test]
    fn out_of_memory_reports_needed_and_available_bytes() {
        let error = CoreError::OutOfMemory {
            needed_bytes: Some(5_583_457_485),
            available_bytes: Some(4_187_593_114),
            message: "the driver refused 24.0 MiB for slot gradients".into(),
        };
        assert_eq!(
            error.to_string(),
            "the GPU is out of memory (needs at least 5.2 GiB, has 3.9 GiB): the driver refused 24.0 MiB for slot \
             gradients; use more partitions or lower --max-gaussians"
        );
    }
}
