//! The error type of the command line. Each variant's message states the fact and a remedy.

use std::path::PathBuf;

use fathom_core::CoreError;

/// Result with [`CliError`].
pub type Result<T, E = CliError> = std::result::Result<T, E>;

/// Why a verb failed.
#[derive(Debug, thiserror::Error)]
pub enum CliError {
    /// Scenes, models, GPU, configuration.
    #[error("{0}")]
    Core(#[from] CoreError),
    /// A file that the command line itself reads or writes.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", "create", ...
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// No coordinator answers.
    #[error(
        "cannot reach the coordinator at {url}: {message}; start one with `fathom coordinator`, or set its \
         address with --coordinator URL or FATHOM_COORDINATOR"
    )]
    Unreachable {
        /// The address that was called.
        url: String,
        /// The connection's error.
        message: String,
    },
    /// This tenant exceeded its call rate.
    #[error("the coordinator at {url} accepts no more calls for now: {message}")]
    TooOften {
        /// URL of the coordinator.
        url: String,
        /// Its message.
        message: String,
    },
    /// The coordinator refused the call.
    #[error("the coordinator at {url} refused to {action}: {message}")]
    Refused {
        /// URL of the coordinator.
        url: String,
        /// The requested action.
        action: &'static str,
        /// Its message.
        message: String,
    },
    /// A job that did not succeed.
    #[error("job {job} {outcome}{}", because(message))]
    Job {
        /// Id of the job.
        job: String,
        /// "failed" or "was cancelled".
        outcome: &'static str,
        /// The reason; may be empty.
        message: String,
    },
    /// Ctrl-C or SIGTERM.
    #[error("{0}")]
    Interrupted(String),
    /// Any other error: a whole sentence.
    #[error("{0}")]
    Message(String),
}

/// A reason after a colon, if there is one.
fn because(message: &str) -> String {
    if message.is_empty() { String::new() } else { format!(": {message}") }
}

impl CliError {
    /// Makes a [`CliError::Io`]: `.map_err(CliError::io("read", path))`.
    pub fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }

    /// The same error with advice for rendering, where training with fewer Gaussians is no remedy.
    #[must_use]
    pub fn of_rendering(self) -> Self {
        let Self::Core(error) = self else { return self };
        match error.shortage() {
            Some(shortage) => Self::Message(format!(
                "{shortage}; render on a GPU with more memory, raise --gpu-memory-limit if it is set, or \
                 render smaller pictures"
            )),
            None => Self::Core(error),
        }
    }

    /// The exit code of the process.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Interrupted(_) => 130,
            Self::Core(CoreError::Config(_)) => 2,
            _ => 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advice_for_rendering_does_not_mention_training() {
        let short = || CoreError::OutOfMemory {
            needed_bytes: Some(2 << 30),
            available_bytes: Some(1 << 30),
            message: "the driver refused 1.0 GiB for transforms".into(),
        };
        let training = CliError::from(short()).to_string();
        assert!(training.ends_with("use more partitions or lower --max-gaussians"), "{training}");
        let rendering = CliError::from(short()).of_rendering().to_string();
        assert!(
            rendering.starts_with("the GPU is out of memory (needs at least 2.0 GiB, has 1.0 GiB)"),
            "{rendering}"
        );
        assert!(rendering.contains("render on a GPU with more memory") && !rendering.contains("partitions"));
        let other = CliError::from(CoreError::Gpu("reset".into())).of_rendering();
        assert!(matches!(other, CliError::Core(CoreError::Gpu(_))));
    }
}
