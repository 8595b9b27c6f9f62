//! How a coordinator runs.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::retention::{Housekeeping, Policy};
use crate::schedule::{Quota, Rules};

/// How a coordinator runs. Unknown keys are refused; contradictions are reported together at start.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CoordinatorConfig {
    /// Where jobs and blobs live; created when it is not there. One process at a time. Default "fathom-data".
    pub data_dir: PathBuf,
    /// Where to listen; port 0 takes a free one. Default 127.0.0.1:7420.
    pub listen: SocketAddr,
    /// Where to serve metrics and health over HTTP, neither encrypted nor authenticated; port 0 takes a free one. Default: nowhere.
    pub metrics_listen: Option<SocketAddr>,
    /// Silence after which a task is given to another worker, milliseconds; workers renew four times as often.
    /// Default 60 000, at least 1000.
    pub lease_ms: u32,
    /// Attempts of a task that may end with an error; the last of them fails the job. Default 3.
    pub max_errors: u32,
    /// Attempts of a task whose worker may fall silent; the last of them fails the job. Default 5.
    pub max_losses: u32,
    /// Pause before a second attempt, milliseconds; doubles with each further one up to a minute. Default 1000.
    pub backoff_ms: u32,
    /// Time without progress after which a task is given to another worker although its own lives, milliseconds. Default 1 800 000
    /// (half an hour: fetching photographs is no progress); 0 never does.
    pub stall_ms: u32,
    /// A worker with nothing else to do also takes a partition with which another takes so many times as long as others took with
    /// theirs, iteration for iteration; the first result counts. Default 3; 0 never does.
    pub straggler_factor: f64,
    /// No partition is taken by a second worker before the first has had it for so long, milliseconds. Default 600 000.
    pub straggler_after_ms: u32,
    /// A job fails when workers are connected and none has had the memory for its next task for so long, milliseconds. Default 0:
    /// it waits for one that has.
    pub capacity_timeout_ms: u32,
    /// Hours after its end at which a job is forgotten with its files. Default 0: never.
    pub keep_jobs_hours: u32,
    /// Hours for which files are kept that no job refers to: uploads without a job, checkpoints that newer ones replaced, and what
    /// deleted jobs leave. Default 168, a week; at least 24, since tasks upload for hours before they hand in.
    pub keep_unused_hours: u32,
    /// Hours after which the upload of a dataset ends that nobody has gone on with. Default 168, a week; at least 1.
    pub keep_uploads_hours: u32,
    /// Whether every call must show a token. Default false, which is for one machine alone. The first token is then written to
    /// `operator.token` in `data_dir`.
    pub tokens: bool,
    /// Certificates of this server, PEM, its own first; with `tls_key`. Default none: plain text. These three files are read again
    /// when they change; open connections stay.
    pub tls_cert: Option<PathBuf>,
    /// The key of `tls_cert`, PEM.
    pub tls_key: Option<PathBuf>,
    /// Authorities, PEM: workers must then show a certificate that one of them signed (mutual TLS). Default none.
    pub client_ca: Option<PathBuf>,
    /// Whether it may listen beyond this machine without TLS or without tokens: where something before it does that. Default false.
    pub insecure: bool,
    /// Calls that people of one tenant may make a second, where tokens are asked for; more are told to wait. Default 200; 0: any
    /// number.
    pub calls_per_second: u32,
    /// Jobs of a tenant that have not ended; one more is refused. Default 0: any number. Operators set others for single tenants.
    pub tenant_open_jobs: u32,
    /// Tasks of a tenant that are worked on at a time; others wait. Default 0: any number.
    pub tenant_parallel: u32,
    /// Bytes of a tenant's photographs, checkpoints and results; uploads and new jobs are refused beyond. Default 0: any number.
    pub tenant_bytes: u64,
    /// Log lines that are kept of one attempt, bytes; the middle of a longer log is cut. Default 4 MiB, at least 64 KiB.
    pub attempt_log_bytes: u64,
    /// Uploads and new jobs are refused when less is free on the disk, bytes. Default 1 GiB; 0 never refuses.
    pub min_free_bytes: u64,
}

impl Default for CoordinatorConfig {
    fn default() -> Self {
        Self {
            data_dir: PathBuf::from("fathom-data"),
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 7420)),
            metrics_listen: None,
            lease_ms: 60_000,
            max_errors: 3,
            max_losses: 5,
            backoff_ms: 1000,
            stall_ms: 1_800_000,
            straggler_factor: 3.0,
            straggler_after_ms: 600_000,
            capacity_timeout_ms: 0,
            keep_jobs_hours: 0,
            keep_unused_hours: 168,
            keep_uploads_hours: 168,
            tokens: false,
            tls_cert: None,
            tls_key: None,
            client_ca: None,
            insecure: false,
            calls_per_second: 200,
            tenant_open_jobs: 0,
            tenant_parallel: 0,
            tenant_bytes: 0,
            attempt_log_bytes: 4 << 20,
            min_free_bytes: 1 << 30,
        }
    }
}

impl CoordinatorConfig {
    /// All faults, together; empty when there are none.
    pub fn faults(&self) -> Vec<String> {
        let mut faults = Vec::new();
        let mut require = |holds: bool, fault: &str| {
            if !holds {
                faults.push(fault.to_owned());
            }
        };
        require(
            self.metrics_listen.is_none_or(|listen| listen.port() == 0 || listen != self.listen),
            "metrics_listen must be another address than listen",
        );
        require(self.lease_ms >= 1000, "lease_ms must be at least 1000: workers renew every quarter of it");
        require(self.lease_ms <= 86_400_000, "lease_ms must be at most a day");
        require(self.max_errors >= 1, "max_errors must be at least 1");
        require(self.max_losses >= 1, "max_losses must be at least 1");
        require(
            self.stall_ms == 0 || self.stall_ms >= self.lease_ms,
            "stall_ms must be 0 or at least lease_ms: progress travels with renewals",
        );
        require(
            self.straggler_factor == 0.0
                || (self.straggler_factor.is_finite() && self.straggler_factor >= 1.0),
            "straggler_factor must be 0 or at least 1: how many times as long as others a slow worker takes",
        );
        require(
            self.keep_unused_hours >= 24,
            "keep_unused_hours must be at least 24: tasks upload for hours before they hand in",
        );
        require(
            self.keep_uploads_hours >= 1,
            "keep_uploads_hours must be at least 1: an upload takes its time, and may be interrupted",
        );
        require(
            self.tls_cert.is_some() == self.tls_key.is_some(),
            "tls_cert and tls_key go together: give both or neither",
        );
        require(
            self.client_ca.is_none() || self.tls_cert.is_some(),
            "client_ca needs tls_cert and tls_key: certificates are shown over TLS only",
        );
        let is_safe = self.tls_cert.is_some() && self.tokens;
        require(
            is_safe || self.insecure || self.listen.ip().is_loopback(),
            "listen is an address beyond this machine, where anybody could read and steer everything: give tls_cert, tls_key and \
             tokens = true, or say insecure = true",
        );
        require(
            (64 << 10..=1 << 30).contains(&self.attempt_log_bytes),
            "attempt_log_bytes must be between 65 536 and 1 073 741 824",
        );
        require(self.backoff_ms <= 60_000, "backoff_ms must be at most 60 000");
        faults
    }

    /// What the scheduler goes by.
    pub fn rules(&self) -> Rules {
        Rules {
            max_errors: self.max_errors,
            max_losses: self.max_losses,
            backoff_ms: self.backoff_ms.into(),
            quota: self.quota(),
            straggler_factor: self.straggler_factor,
            straggler_after_ms: self.straggler_after_ms.into(),
            ..Rules::default()
        }
    }

    /// What is kept for how long; once an hour it is looked what may go.
    pub fn housekeeping(&self) -> Housekeeping {
        let hours = |count: u32| Duration::from_secs(60 * 60 * u64::from(count));
        let policy = Policy {
            jobs: (self.keep_jobs_hours > 0).then(|| hours(self.keep_jobs_hours)),
            unused: hours(self.keep_unused_hours),
            uploads: hours(self.keep_uploads_hours),
        };
        Housekeeping { policy, every: hours(1) }
    }

    /// What a tenant may have for which nothing else was set.
    pub fn quota(&self) -> Quota {
        Quota {
            max_open_jobs: self.tenant_open_jobs,
            max_parallel: self.tenant_parallel,
            max_bytes: self.tenant_bytes,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn faults(change: impl FnOnce(&mut CoordinatorConfig)) -> Vec<String> {
        let mut config = CoordinatorConfig::default();
        change(&mut config);
        config.faults()
    }

    #[test]
    fn nobody_listens_beyond_the_machine_by_accident() {
        let everywhere = SocketAddr::from((Ipv4Addr::UNSPECIFIED, 7420));
        let pem = || Some(PathBuf::from("a.pem"));
        assert_eq!(faults(|_| {}), Vec::<String>::new());
        let said = faults(|config| config.listen = everywhere);
        assert!(said.len() == 1 && said[0].contains("insecure = true"), "{said:?}");
        let said = faults(|config| (config.listen, config.tokens) = (everywhere, true));
        assert_eq!(said.len(), 1, "tokens in plain text: {said:?}");
        let said = faults(|config| {
            (config.listen, config.tokens) = (everywhere, true);
            (config.tls_cert, config.tls_key) = (pem(), pem());
        });
        assert_eq!(said, Vec::<String>::new());
        assert_eq!(faults(|config| (config.listen, config.insecure) = (everywhere, true)).len(), 0);
    }

    #[test]
    fn contradictions_are_told_together() {
        let said = faults(|config| {
            config.tls_cert = Some("a.pem".into());
            config.client_ca = Some("b.pem".into());
            config.lease_ms = 10;
            config.stall_ms = 5;
        });
        assert_eq!(said.len(), 3, "{said:?}");
        let said = faults(|config| config.client_ca = Some("b.pem".into()));
        assert!(said.len() == 1 && said[0].contains("client_ca"), "{said:?}");
    }
}
