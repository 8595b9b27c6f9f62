//! `fathom coordinator`: takes jobs, plans them, leases tasks to workers, merges, hands out.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use fathom_coordinator::{CoordinatorConfig, serve};

use crate::children;
use crate::error::{CliError, Result};
use crate::output;

/// Nothing is lost when it is too short: what was acknowledged is durable, and every call may be repeated.
const STOP_GRACE: Duration = Duration::from_millis(300);

/// Arguments of `fathom coordinator`. In order of strength: flags, environment, file.
#[derive(Args, Debug)]
pub struct CoordinatorArgs {
    /// Folder for jobs, photographs and results; survives restarts [default: fathom-data]
    #[arg(long, value_name = "DIR", env = "FATHOM_DATA_DIR")]
    data_dir: Option<PathBuf>,
    /// Address to listen on; port 0 takes a free one, which is printed [default: 127.0.0.1:7420]
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_LISTEN")]
    listen: Option<SocketAddr>,
    /// Silence of a worker after which its task is given to another one, milliseconds [default: 60000]
    #[arg(long, value_name = "MS", env = "FATHOM_LEASE_MS")]
    lease_ms: Option<u32>,
    /// Settings in a TOML file: data_dir, listen, lease_ms, max_errors, max_losses, backoff_ms, min_free_bytes
    #[arg(long, value_name = "FILE", env = "FATHOM_CONFIG")]
    config: Option<PathBuf>,
    /// Stop when standard input closes: for a parent process that must not leave it behind
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

pub async fn run(args: CoordinatorArgs) -> Result<()> {
    let config = args.resolve()?;
    let failed = |error: fathom_coordinator::CoordinatorError| CliError::Message(error.to_string());
    let coordinator = serve(config).await.map_err(failed)?;
    output::line(format!("{}{}", children::LISTENING, coordinator.url()));
    let parent_gone = args.stop_with_stdin.then(children::stdin_closes);
    let told_to_stop = async {
        match parent_gone {
            Some(gone) => tokio::select! {
                _ = gone => {}
                () = children::stop_signal() => {}
            },
            None => children::stop_signal().await,
        }
    };
    tokio::select! {
        // It never ends by itself in good order: the store or the server has failed.
        ended = coordinator.wait() => ended.map_err(failed),
        () = told_to_stop => {
            // `wait` is dropped, which tells the server to stop; open calls have this long to be answered.
            tokio::time::sleep(STOP_GRACE).await;
            Ok(())
        }
    }
}

impl CoordinatorArgs {
    fn resolve(&self) -> Result<CoordinatorConfig> {
        let mut config = match &self.config {
            None => CoordinatorConfig::default(),
            Some(path) => {
                let text = std::fs::read_to_string(path).map_err(CliError::io("read", path))?;
                toml::from_str(&text).map_err(|error| {
                    CliError::Message(format!("{}: {}", path.display(), error.to_string().trim_end()))
                })?
            }
        };
        if let Some(data_dir) = &self.data_dir {
            config.data_dir.clone_from(data_dir);
        }
        config.listen = self.listen.unwrap_or(config.listen);
        config.lease_ms = self.lease_ms.unwrap_or(config.lease_ms);
        Ok(config)
    }
}
