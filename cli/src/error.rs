//! The one error type of the command line. Each variant is a sentence with the fact and the way out.

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
    /// A file of the command line's own.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// "read", "write", "create", ...
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Nobody answers.
    #[error(
        "cannot reach the coordinator at {url}: {message}; start one with `fathom coordinator`, or say \
         where it is with --coordinator URL or FATHOM_COORDINATOR"
    )]
    Unreachable {
        /// Where it should be.
        url: String,
        /// What the connection said.
        message: String,
    },
    /// The coordinator takes no more calls of this tenant for now.
    #[error("the coordinator at {url} takes no more calls for now: {message}")]
    TooOften {
        /// Who.
        url: String,
        /// Its sentence.
        message: String,
    },
    /// The coordinator said no.
    #[error("the coordinator at {url} refused to {action}: {message}")]
    Refused {
        /// Who.
        url: String,
        /// What was asked.
        action: &'static str,
        /// Its sentence.
        message: String,
    },
    /// A job that did not succeed.
    #[error("job {job} {outcome}{}", because(message))]
    Job {
        /// Which job.
        job: String,
        /// "failed" or "was cancelled".
        outcome: &'static str,
        /// Why; may be empty.
        message: String,
    },
    /// Ctrl-C or SIGTERM.
    #[error("{0}")]
    Interrupted(String),
    /// Anything else: a whole sentence.
    #[error("{0}")]
    Message(String),
}

/// A reason behind a colon, where there is one.
fn because(message: &str) -> String {
    if message.is_empty() { String::new() } else { format!(": {message}") }
}

impl CliError {
    /// A [`CliError::Io`] in the making: `.map_err(CliError::io("read", path))`.
    pub fn io(action: &'static str, path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |source| Self::Io { action, path, source }
    }

    /// The same for who renders a model and cannot train it with fewer Gaussians.
    #[must_use]
    pub fn of_rendering(self) -> Self {
        let Self::Core(error) = self else { return self };
        match error.shortage() {
            Some(shortage) => Self::Message(format!(
                "{shortage}; render on a GPU with more memory, with a higher --gpu-memory-limit where one is set, or \
                 smaller pictures"
            )),
            None => Self::Core(error),
        }
    }

    /// What the process exits with.
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
    fn who_renders_is_not_told_to_train_with_less() {
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
