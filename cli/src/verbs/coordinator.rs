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
    /// Address to listen on, or a name for it; port 0 takes a free one, which is printed [default: 127.0.0.1:7420]
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_LISTEN", value_parser = super::parse_address)]
    listen: Option<SocketAddr>,
    /// Address to serve metrics and health on over HTTP (/metrics, /healthz, /readyz), neither encrypted nor authenticated
    /// [default: nowhere]
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_METRICS_LISTEN", value_parser = super::parse_address)]
    metrics_listen: Option<SocketAddr>,
    /// Silence of a worker after which its task is given to another one, milliseconds [default: 60000]
    #[arg(long, value_name = "MS", env = "FATHOM_LEASE_MS")]
    lease_ms: Option<u32>,
    /// Attempts of a task that may end with an error; the last of them fails the job [default: 3]
    #[arg(long, value_name = "N", env = "FATHOM_MAX_ERRORS")]
    max_errors: Option<u32>,
    /// Attempts of a task whose worker may fall silent; the last of them fails the job [default: 5]
    #[arg(long, value_name = "N", env = "FATHOM_MAX_LOSSES")]
    max_losses: Option<u32>,
    /// Pause before a second attempt, milliseconds; doubles with each further one [default: 1000]
    #[arg(long, value_name = "MS", env = "FATHOM_BACKOFF_MS")]
    backoff_ms: Option<u32>,
    /// Time without progress after which a task is given to another worker, milliseconds; 0 never does [default: 1800000]
    #[arg(long, value_name = "MS", env = "FATHOM_STALL_MS")]
    stall_ms: Option<u32>,
    /// An idle worker also takes a partition with which another takes so many times as long as others took with theirs; 0 never
    /// does [default: 3]
    #[arg(long, value_name = "FACTOR", env = "FATHOM_STRAGGLER_FACTOR")]
    straggler_factor: Option<f64>,
    /// No partition is taken by a second worker before the first has had it for so long, milliseconds [default: 600000]
    #[arg(long, value_name = "MS", env = "FATHOM_STRAGGLER_AFTER_MS")]
    straggler_after_ms: Option<u32>,
    /// A job fails when no connected worker has had the memory for its next task for so long, milliseconds; 0 waits for one
    /// that has [default: 0]
    #[arg(long, value_name = "MS", env = "FATHOM_CAPACITY_TIMEOUT_MS")]
    capacity_timeout_ms: Option<u32>,
    /// Hours after its end at which a job is forgotten with its files; 0 never does [default: 0]
    #[arg(long, value_name = "N", env = "FATHOM_KEEP_JOBS_HOURS")]
    keep_jobs_hours: Option<u32>,
    /// Hours for which files are kept that no job refers to, at least 24 [default: 168]
    #[arg(long, value_name = "N", env = "FATHOM_KEEP_UNUSED_HOURS")]
    keep_unused_hours: Option<u32>,
    /// Hours after which the upload of a dataset ends that nobody has gone on with [default: 168]
    #[arg(long, value_name = "N", env = "FATHOM_KEEP_UPLOADS_HOURS")]
    keep_uploads_hours: Option<u32>,
    /// Ask every call for a token; the first one is written to operator.token in the data folder [default: false]
    #[arg(long, num_args = 0..=1, default_missing_value = "true", require_equals = true, value_name = "BOOL", env = "FATHOM_TOKENS")]
    tokens: Option<bool>,
    /// Certificates of this server, PEM, read again when the file changes; with --tls-key [default: none, plain text]
    #[arg(long, value_name = "FILE", env = "FATHOM_SERVER_TLS_CERT")]
    tls_cert: Option<PathBuf>,
    /// Key of --tls-cert, PEM, read again when the file changes
    #[arg(long, value_name = "FILE", env = "FATHOM_SERVER_TLS_KEY")]
    tls_key: Option<PathBuf>,
    /// Authorities, PEM, read again when the file changes: workers must show a certificate that one of them signed [default: none]
    #[arg(long, value_name = "FILE", env = "FATHOM_CLIENT_CA")]
    client_ca: Option<PathBuf>,
    /// Listen beyond this machine even without TLS or tokens [default: false]
    #[arg(long, num_args = 0..=1, default_missing_value = "true", require_equals = true, value_name = "BOOL", env = "FATHOM_INSECURE")]
    insecure: Option<bool>,
    /// Calls that people of one tenant may make a second, where tokens are asked for; 0: any number [default: 200]
    #[arg(long, value_name = "N", env = "FATHOM_CALLS_PER_SECOND")]
    calls_per_second: Option<u32>,
    /// Jobs of a tenant that have not ended; 0: any number [default: 0]
    #[arg(long, value_name = "N", env = "FATHOM_TENANT_OPEN_JOBS")]
    tenant_open_jobs: Option<u32>,
    /// Tasks of a tenant that are worked on at a time; 0: any number [default: 0]
    #[arg(long, value_name = "N", env = "FATHOM_TENANT_PARALLEL")]
    tenant_parallel: Option<u32>,
    /// Bytes of a tenant's files; 0: any number [default: 0]
    #[arg(long, value_name = "BYTES", env = "FATHOM_TENANT_BYTES")]
    tenant_bytes: Option<u64>,
    /// Log lines that are kept of one attempt at a task, bytes [default: 4 MiB]
    #[arg(long, value_name = "BYTES", env = "FATHOM_ATTEMPT_LOG_BYTES")]
    attempt_log_bytes: Option<u64>,
    /// Uploads and new jobs are refused when less is free on the disk, bytes; 0 never refuses [default: 1 GiB]
    #[arg(long, value_name = "BYTES", env = "FATHOM_MIN_FREE_BYTES")]
    min_free_bytes: Option<u64>,
    /// All of these in a TOML file, under the names of the flags with _ for -
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
                _ = gone => "the process that started it has ended",
                () = children::stop_signal() => "SIGTERM or Ctrl-C",
            },
            None => {
                children::stop_signal().await;
                "SIGTERM or Ctrl-C"
            }
        }
    };
    tokio::select! {
        // It never ends by itself in good order: the store or the server has failed.
        ended = coordinator.wait() => ended.map_err(failed),
        by = told_to_stop => {
            tracing::info!("asked to stop by {by}; open calls have {} ms", STOP_GRACE.as_millis());
            // `wait` is dropped, which tells the server to stop; open calls have this long to be answered.
            tokio::time::sleep(STOP_GRACE).await;
            Ok(())
        }
    }
}

impl CoordinatorArgs {
    fn resolve(&self) -> Result<CoordinatorConfig> {
        let file: CoordinatorConfig = super::settings(self.config.as_deref())?;
        Ok(CoordinatorConfig {
            data_dir: self.data_dir.clone().unwrap_or(file.data_dir),
            listen: self.listen.unwrap_or(file.listen),
            metrics_listen: self.metrics_listen.or(file.metrics_listen),
            lease_ms: self.lease_ms.unwrap_or(file.lease_ms),
            max_errors: self.max_errors.unwrap_or(file.max_errors),
            max_losses: self.max_losses.unwrap_or(file.max_losses),
            backoff_ms: self.backoff_ms.unwrap_or(file.backoff_ms),
            stall_ms: self.stall_ms.unwrap_or(file.stall_ms),
            straggler_factor: self.straggler_factor.unwrap_or(file.straggler_factor),
            straggler_after_ms: self.straggler_after_ms.unwrap_or(file.straggler_after_ms),
            capacity_timeout_ms: self.capacity_timeout_ms.unwrap_or(file.capacity_timeout_ms),
            keep_jobs_hours: self.keep_jobs_hours.unwrap_or(file.keep_jobs_hours),
            keep_unused_hours: self.keep_unused_hours.unwrap_or(file.keep_unused_hours),
            keep_uploads_hours: self.keep_uploads_hours.unwrap_or(file.keep_uploads_hours),
            tokens: self.tokens.unwrap_or(file.tokens),
            tls_cert: self.tls_cert.clone().or(file.tls_cert),
            tls_key: self.tls_key.clone().or(file.tls_key),
            client_ca: self.client_ca.clone().or(file.client_ca),
            insecure: self.insecure.unwrap_or(file.insecure),
            calls_per_second: self.calls_per_second.unwrap_or(file.calls_per_second),
            tenant_open_jobs: self.tenant_open_jobs.unwrap_or(file.tenant_open_jobs),
            tenant_parallel: self.tenant_parallel.unwrap_or(file.tenant_parallel),
            tenant_bytes: self.tenant_bytes.unwrap_or(file.tenant_bytes),
            attempt_log_bytes: self.attempt_log_bytes.unwrap_or(file.attempt_log_bytes),
            min_free_bytes: self.min_free_bytes.unwrap_or(file.min_free_bytes),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verbs::{Verb, parsed};

    fn resolve(words: &[&str]) -> CoordinatorConfig {
        let Verb::Coordinator(args) = parsed(&[&["coordinator"], words].concat()) else {
            panic!("another verb")
        };
        args.resolve().unwrap()
    }

    #[test]
    fn every_setting_has_a_flag_that_wins_over_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("coordinator.toml");
        let in_file = CoordinatorConfig {
            data_dir: "a".into(),
            listen: "127.0.0.1:1".parse().unwrap(),
            metrics_listen: Some("127.0.0.1:3".parse().unwrap()),
            lease_ms: 2000,
            max_errors: 7,
            max_losses: 8,
            backoff_ms: 9,
            stall_ms: 5000,
            straggler_factor: 1.5,
            straggler_after_ms: 21,
            capacity_timeout_ms: 11,
            keep_jobs_hours: 12,
            keep_unused_hours: 24,
            keep_uploads_hours: 25,
            tokens: true,
            tls_cert: Some("a.pem".into()),
            tls_key: Some("b.pem".into()),
            client_ca: Some("c.pem".into()),
            insecure: true,
            calls_per_second: 13,
            tenant_open_jobs: 14,
            tenant_parallel: 15,
            tenant_bytes: 16,
            attempt_log_bytes: 70_000,
            min_free_bytes: 10,
        };
        std::fs::write(&file, toml::to_string(&in_file).unwrap()).unwrap();
        let file = file.to_str().unwrap();
        assert_eq!(resolve(&["--config", file]), in_file);
        assert_eq!(resolve(&[]), CoordinatorConfig::default());

        let flags = [
            "--data-dir=b",
            "--listen=127.0.0.1:2",
            "--metrics-listen=127.0.0.1:4",
            "--lease-ms=3000",
            "--max-errors=1",
            "--max-losses=2",
            "--backoff-ms=3",
            "--stall-ms=6000",
            "--straggler-factor=2",
            "--straggler-after-ms=22",
            "--capacity-timeout-ms=5",
            "--keep-jobs-hours=6",
            "--keep-unused-hours=48",
            "--keep-uploads-hours=49",
            "--tokens=false",
            "--tls-cert=d.pem",
            "--tls-key=e.pem",
            "--client-ca=f.pem",
            "--insecure=false",
            "--calls-per-second=17",
            "--tenant-open-jobs=18",
            "--tenant-parallel=19",
            "--tenant-bytes=20",
            "--attempt-log-bytes=80000",
            "--min-free-bytes=4",
        ];
        let by_flags = CoordinatorConfig {
            data_dir: "b".into(),
            listen: "127.0.0.1:2".parse().unwrap(),
            metrics_listen: Some("127.0.0.1:4".parse().unwrap()),
            lease_ms: 3000,
            max_errors: 1,
            max_losses: 2,
            backoff_ms: 3,
            stall_ms: 6000,
            straggler_factor: 2.0,
            straggler_after_ms: 22,
            capacity_timeout_ms: 5,
            keep_jobs_hours: 6,
            keep_unused_hours: 48,
            keep_uploads_hours: 49,
            tokens: false,
            tls_cert: Some("d.pem".into()),
            tls_key: Some("e.pem".into()),
            client_ca: Some("f.pem".into()),
            insecure: false,
            calls_per_second: 17,
            tenant_open_jobs: 18,
            tenant_parallel: 19,
            tenant_bytes: 20,
            attempt_log_bytes: 80_000,
            min_free_bytes: 4,
        };
        assert_eq!(resolve(&[&["--config", file], &flags[..]].concat()), by_flags);
    }

    #[test]
    fn the_example_file_is_what_a_coordinator_has_without_one() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/coordinator.example.toml");
        assert_eq!(resolve(&["--config", file]), CoordinatorConfig::default());
    }
}
