//! `fathom coordinator`: plans jobs, leases tasks to workers, merges, and serves the results.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use fathom_coordinator::access::Token;
use fathom_coordinator::{CoordinatorConfig, serve};
use serde::Serialize;
use serde_json::Value;

use crate::children;
use crate::error::{CliError, Result};
use crate::output;
use crate::settings::{Declaration, Flags};

/// Nothing is lost when this is too short: acknowledged changes are durable, and clients repeat their calls.
const STOP_GRACE: Duration = Duration::from_millis(300);

/// Arguments of `fathom coordinator`.
#[derive(Args, Debug)]
pub struct CoordinatorArgs {
    #[command(flatten)]
    settings: Flags<CoordinatorSettings>,
    /// TOML file with these settings, under the names of the flags with _ for -; flags and environment win
    #[arg(long, value_name = "FILE", env = "FATHOM_CONFIG")]
    config: Option<PathBuf>,
    /// Require a token for the HTTP interface, which an invitation in the printed link to the page gives
    #[arg(long, hide = true)]
    own_page: bool,
    /// Stop when standard input closes, so that a parent process never leaves it behind
    #[arg(long, hide = true)]
    stop_with_stdin: bool,
}

/// The settings of a coordinator. Each is a field of [`CoordinatorConfig`], which has the default.
#[derive(Args, Debug, Serialize)]
pub struct CoordinatorSettings {
    /// Folder for jobs, photographs and results, for one coordinator at a time
    #[arg(long, value_name = "DIR", env = "FATHOM_DATA_DIR")]
    data_dir: Option<PathBuf>,
    /// PostgreSQL database for jobs, postgres://USER@HOST:PORT/DATABASE; give the password in PGPASSWORD or
    /// a password file [default: a store in the data folder]
    #[arg(long, value_name = "URL", env = "FATHOM_STORE", hide_env_values = true)]
    store: Option<String>,
    /// Maximum connections to that database, at least 2
    #[arg(long, value_name = "N", env = "FATHOM_STORE_CONNECTIONS")]
    store_connections: Option<u32>,
    /// Bucket or folder for photographs, checkpoints and results: s3://BUCKET/PREFIX, gs://BUCKET/PREFIX,
    /// az://CONTAINER/PREFIX or file:///FOLDER; give keys in the environment variables of the provider, such
    /// as AWS_ACCESS_KEY_ID [default: the data folder]
    #[arg(long, value_name = "URL", env = "FATHOM_OBJECTS")]
    objects: Option<String>,
    /// Let workers and people use the bucket themselves for large files, by URLs that are valid for a minute;
    /// false sends all files through the coordinator
    #[arg(long, num_args = 0..=1, default_missing_value = "true", require_equals = true, value_name = "BOOL", env = "FATHOM_DIRECT_TRANSFERS")]
    direct_transfers: Option<bool>,
    /// Let them send only files of at least this many bytes to the bucket themselves; shorter ones cost more
    /// requests than they save
    #[arg(long, value_name = "BYTES", env = "FATHOM_DIRECT_UPLOADS_FROM_BYTES")]
    direct_uploads_from_bytes: Option<u64>,
    /// Address or host name to listen on; beyond this machine it needs TLS and tokens; port 0 takes a free
    /// one
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_LISTEN", value_parser = super::parse_address)]
    listen: Option<SocketAddr>,
    /// Address that serves metrics and health over plain HTTP (/metrics, /healthz, /readyz), without
    /// authentication [default: nowhere]
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_METRICS_LISTEN", value_parser = super::parse_address)]
    metrics_listen: Option<SocketAddr>,
    /// Address that serves the HTTP interface (JSON, server-sent events and gRPC-Web), with the same TLS and
    /// tokens; beyond this machine it needs both [default: nowhere]
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_WEB", value_parser = super::parse_address)]
    web: Option<SocketAddr>,
    /// URL for a signed POST request at the end of each new job [default: none]
    #[arg(long, value_name = "URL", env = "FATHOM_WEBHOOK")]
    webhook: Option<String>,
    /// File with the secret that signs these requests [default: webhook.secret in the data folder, made where
    /// it is missing]
    #[arg(long, value_name = "FILE", env = "FATHOM_WEBHOOK_SECRET")]
    webhook_secret: Option<PathBuf>,
    /// Address that tells KEDA how many workers to start; beyond this machine it needs --tls-cert, --tls-key
    /// and --scaler-client-ca [default: nowhere]
    #[arg(long, value_name = "ADDRESS:PORT", env = "FATHOM_SCALER_LISTEN", value_parser = super::parse_address)]
    scaler_listen: Option<SocketAddr>,
    /// CA certificates, PEM, read again when the file changes; KEDA must show a certificate that one of them
    /// signed [default: none]
    #[arg(long, value_name = "FILE", env = "FATHOM_SCALER_CLIENT_CA")]
    scaler_client_ca: Option<PathBuf>,
    /// Silence of a worker after which another worker gets its task, milliseconds, 1000 to a day
    #[arg(long, value_name = "MS", env = "FATHOM_LEASE_MS")]
    lease_ms: Option<u32>,
    /// Fail a job when one of its tasks has failed this many times
    #[arg(long, value_name = "N", env = "FATHOM_MAX_ERRORS")]
    max_errors: Option<u32>,
    /// Fail a job when one of its tasks has lost its worker this many times
    #[arg(long, value_name = "N", env = "FATHOM_MAX_LOSSES")]
    max_losses: Option<u32>,
    /// Pause before the second attempt at a task, milliseconds; doubles with each further one, up to a minute
    #[arg(long, value_name = "MS", env = "FATHOM_BACKOFF_MS")]
    backoff_ms: Option<u32>,
    /// Time without progress after which another worker gets a task, milliseconds; 0 disables it
    #[arg(long, value_name = "MS", env = "FATHOM_STALL_MS")]
    stall_ms: Option<u32>,
    /// Run a second attempt when a task takes this many times longer than its siblings; 0 disables it
    #[arg(long, value_name = "FACTOR", env = "FATHOM_STRAGGLER_FACTOR", value_parser = finite)]
    straggler_factor: Option<f64>,
    /// Run no second attempt before the first attempt has run for this long, milliseconds
    #[arg(long, value_name = "MS", env = "FATHOM_STRAGGLER_AFTER_MS")]
    straggler_after_ms: Option<u32>,
    /// Fail a job after this long without a worker that has enough GPU memory, milliseconds; 0 waits forever
    #[arg(long, value_name = "MS", env = "FATHOM_CAPACITY_TIMEOUT_MS")]
    capacity_timeout_ms: Option<u32>,
    /// Delete a job and its files this many hours after its end; 0 keeps them
    #[arg(long, value_name = "N", env = "FATHOM_KEEP_JOBS_HOURS")]
    keep_jobs_hours: Option<u32>,
    /// Keep files that no job refers to for this many hours, at least 24
    #[arg(long, value_name = "N", env = "FATHOM_KEEP_UNUSED_HOURS")]
    keep_unused_hours: Option<u32>,
    /// Discard an unfinished upload of a dataset after this many hours without activity, at least 1
    #[arg(long, value_name = "N", env = "FATHOM_KEEP_UPLOADS_HOURS")]
    keep_uploads_hours: Option<u32>,
    /// Require a token with every call; the first one is written to operator.token in the data folder
    #[arg(long, num_args = 0..=1, default_missing_value = "true", require_equals = true, value_name = "BOOL", env = "FATHOM_TOKENS")]
    tokens: Option<bool>,
    /// Certificate chain of this server, PEM, read again when the file changes; needs --tls-key
    /// [default: none, plain text]
    #[arg(long, value_name = "FILE", env = "FATHOM_SERVER_TLS_CERT")]
    tls_cert: Option<PathBuf>,
    /// Private key of --tls-cert, PEM, read again when the file changes
    #[arg(long, value_name = "FILE", env = "FATHOM_SERVER_TLS_KEY")]
    tls_key: Option<PathBuf>,
    /// CA certificates, PEM, read again when the file changes; workers must show a certificate that one of
    /// them signed [default: none]
    #[arg(long, value_name = "FILE", env = "FATHOM_CLIENT_CA")]
    client_ca: Option<PathBuf>,
    /// Listen beyond this machine even without TLS or tokens
    #[arg(long, num_args = 0..=1, default_missing_value = "true", require_equals = true, value_name = "BOOL", env = "FATHOM_INSECURE")]
    insecure: Option<bool>,
    /// Calls per second that the users of one tenant may make, where tokens are required; 0 removes the limit
    #[arg(long, value_name = "N", env = "FATHOM_CALLS_PER_SECOND")]
    calls_per_second: Option<u32>,
    /// Unfinished jobs that a tenant may have, unless `fathom tenant limit` sets another limit; 0 removes the
    /// limit
    #[arg(long, value_name = "N", env = "FATHOM_TENANT_OPEN_JOBS")]
    tenant_open_jobs: Option<u32>,
    /// Tasks of a tenant that may run at a time; 0 removes the limit
    #[arg(long, value_name = "N", env = "FATHOM_TENANT_PARALLEL")]
    tenant_parallel: Option<u32>,
    /// Bytes of photographs, checkpoints and results that a tenant may store; 0 removes the limit
    #[arg(long, value_name = "BYTES", env = "FATHOM_TENANT_BYTES")]
    tenant_bytes: Option<u64>,
    /// Size of the log that is kept of each attempt at a task, bytes, 64 KiB to 1 GiB; longer logs lose their
    /// middle
    #[arg(long, value_name = "BYTES", env = "FATHOM_ATTEMPT_LOG_BYTES")]
    attempt_log_bytes: Option<u64>,
    /// Refuse uploads and new jobs when the disk has less free space than this, bytes; 0 never refuses
    #[arg(long, value_name = "BYTES", env = "FATHOM_MIN_FREE_BYTES")]
    min_free_bytes: Option<u64>,
}

impl Declaration for CoordinatorSettings {
    type Resolved = CoordinatorConfig;

    fn defaults() -> serde_json::Result<Value> {
        serde_json::to_value(CoordinatorConfig::default())
    }
}

fn finite(text: &str) -> std::result::Result<f64, String> {
    let number = text.parse().map_err(|error: std::num::ParseFloatError| error.to_string())?;
    if f64::is_finite(number) { Ok(number) } else { Err("use a finite number".to_owned()) }
}

pub async fn run(args: CoordinatorArgs) -> Result<()> {
    let config = args.settings.resolve(args.config.as_deref())?;
    let config = CoordinatorConfig { own_page: args.own_page, ..config };
    let failed = |error: fathom_coordinator::CoordinatorError| CliError::Message(error.to_string());
    let coordinator = serve(config).await.map_err(failed)?;
    if let (Some(address), Some(mut invitations)) = (coordinator.web_address(), coordinator.invitations()) {
        let scheme = if coordinator.url().starts_with("https:") { "https" } else { "http" };
        let print = move |invitation: &Option<Token>| {
            if let Some(invitation) = invitation {
                let link = format!("{scheme}://{address}/#invitation={}", invitation.reveal());
                output::line(format!("{}{link}", children::PAGE));
            }
        };
        print(&invitations.borrow_and_update());
        tokio::spawn(async move {
            while invitations.changed().await.is_ok() {
                print(&invitations.borrow_and_update());
            }
        });
    }
    output::line(format!("{}{}", children::LISTENING, coordinator.url()));
    let parent_gone = args.stop_with_stdin.then(children::stdin_closes);
    let asked_to_stop = async {
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
        // It ends by itself only when the store or the server has failed.
        ended = coordinator.wait() => ended.map_err(failed),
        by = asked_to_stop => {
            tracing::info!("asked to stop by {by}; open calls have {} ms", STOP_GRACE.as_millis());
            // Dropping `wait` stops the server; open calls have this long to finish.
            tokio::time::sleep(STOP_GRACE).await;
            Ok(())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verbs::{Verb, parsed};

    fn resolve(words: &[&str]) -> Result<CoordinatorConfig> {
        let Verb::Coordinator(args) = parsed(&[&["coordinator"], words].concat()) else {
            panic!("another verb")
        };
        args.settings.resolve(args.config.as_deref())
    }

    #[test]
    fn flags_win_over_the_file_and_the_file_over_defaults() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("coordinator.toml");
        std::fs::write(&file, "lease_ms = 2000\ntokens = true\ntls_key = \"a.key\"\nstraggler_factor = 2\n")
            .unwrap();
        let of_file = CoordinatorConfig {
            lease_ms: 2000,
            tokens: true,
            tls_key: Some("a.key".into()),
            straggler_factor: 2.0,
            ..CoordinatorConfig::default()
        };
        let file = file.to_str().unwrap();
        assert_eq!(resolve(&["--config", file]).unwrap(), of_file);
        assert_eq!(resolve(&[]).unwrap(), CoordinatorConfig::default());
        let flags = ["--tokens=false", "--tls-key=b.key", "--listen=127.0.0.1:2", "--straggler-factor=1.5"];
        let by_flags = CoordinatorConfig {
            tokens: false,
            tls_key: Some("b.key".into()),
            listen: "127.0.0.1:2".parse().unwrap(),
            straggler_factor: 1.5,
            ..of_file
        };
        assert_eq!(resolve(&[&["--config", file], &flags[..]].concat()).unwrap(), by_flags);
    }

    #[test]
    fn the_example_file_is_what_a_coordinator_has_without_one() {
        let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/coordinator.example.toml");
        assert_eq!(resolve(&["--config", file]).unwrap(), CoordinatorConfig::default());
    }

    #[test]
    fn faults_in_the_file_are_named_with_their_line() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("coordinator.toml");
        for (text, parts) in [
            ("tokens = true\nlease = 5\n", ["line 2", "`lease`", "lease_ms"]),
            ("\nlease_ms = -5\n", ["line 2", "lease_ms", "-5"]),
            ("straggler_factor = nan\n", ["line 1", "straggler_factor", "f64"]),
            ("listen = \"here\"\n", ["line 1", "listen", "address"]),
            ("listen = \n", ["line 1", "TOML", "string"]),
        ] {
            std::fs::write(&file, text).unwrap();
            let error = resolve(&["--config", file.to_str().unwrap()]).unwrap_err().to_string();
            assert!(error.contains("coordinator.toml"), "{error}");
            assert!(parts.iter().all(|part| error.contains(part)), "{text}: {error}");
        }
    }
}
