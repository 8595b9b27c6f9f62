//! Configuration of a coordinator.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::retention::{Housekeeping, Policy};
use crate::schedule::{Quota, Rules};

/// Configuration of a coordinator. Unknown keys are refused; contradictions are reported together at start.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CoordinatorConfig {
    /// Folder of jobs and blobs; created if missing. One process at a time. Default "fathom-data".
    pub data_dir: PathBuf,
    /// URL of a PostgreSQL database for jobs, `postgres://USER@HOST:PORT/DATABASE`; the password may be in
    /// it, in `PGPASSWORD` or in a password file. Default none: a store in `data_dir`.
    pub store: Option<String>,
    /// Maximum connections to that database. Default 32, at least 2.
    pub store_connections: u32,
    /// URL of the place of photographs, checkpoints and results: `s3://BUCKET/PREFIX`, `gs://BUCKET/PREFIX`,
    /// `az://CONTAINER/PREFIX` or `file:///FOLDER`. Keys come from the environment variables of the provider,
    /// or from the role of the machine. Default none: `data_dir`.
    pub objects: Option<String>,
    /// Whether workers and people may send files to a bucket and fetch them from there themselves, by URLs
    /// that the coordinator signs for a minute. Default true.
    pub direct_transfers: bool,
    /// Least length of an upload to a bucket that clients make themselves, bytes: shorter ones cost more
    /// requests than they save. Default 8 MiB.
    pub direct_uploads_from_bytes: u64,
    /// Where to listen; port 0 takes a free one. Default 127.0.0.1:7420.
    pub listen: SocketAddr,
    /// Where to serve metrics and health over HTTP, neither encrypted nor authenticated; port 0 takes a free
    /// one. Default: nowhere.
    pub metrics_listen: Option<SocketAddr>,
    /// Where to serve the HTTP interface, with the TLS and the tokens of this coordinator, which it needs
    /// beyond this machine; port 0 takes a free one. Default: nowhere.
    pub web: Option<SocketAddr>,
    /// Whether `web` requires a token that only an invitation gives, although `tokens` is false: the page of
    /// `fathom train` is for the one who started it. See [`crate::Coordinator::invitations`]. No setting of a
    /// file.
    #[serde(skip)]
    pub own_page: bool,
    /// URL for a signed POST request at the end of each job that is created from then on. Default none.
    pub webhook: Option<String>,
    /// File with the secret of `webhook`: `whsec_` and 24 to 64 bytes in base64, as Standard Webhooks has it.
    /// Default none: `webhook.secret` in `data_dir`, made where it is missing.
    pub webhook_secret: Option<PathBuf>,
    /// Where to serve KEDA, which starts workers by the number of tasks; port 0 takes a free one. Beyond this
    /// machine it needs `tls_cert`, `tls_key` and `scaler_client_ca`. Default: nowhere.
    pub scaler_listen: Option<SocketAddr>,
    /// Certificate authorities, PEM: KEDA must present a certificate signed by one of them. Default none.
    pub scaler_client_ca: Option<PathBuf>,
    /// Lease duration: a task whose worker does not renew for this long is requeued, milliseconds. Workers
    /// renew every quarter of it. Default 60 000, at least 1000.
    pub lease_ms: u32,
    /// Maximum attempts of a task that end with an error; the last of them fails the job. Default 3.
    pub max_errors: u32,
    /// Maximum attempts of a task whose worker is lost; the last of them fails the job. Default 5.
    pub max_losses: u32,
    /// Back-off before a second attempt, milliseconds; doubles with each further one, up to a minute. Default
    /// 1000.
    pub backoff_ms: u32,
    /// Time without progress after which a task is requeued although its worker still renews, milliseconds.
    /// Default 1 800 000 (half an hour, because downloads of photographs report no progress); 0 disables it.
    pub stall_ms: u32,
    /// Run a second attempt on an idle worker when a partition takes this many times longer per iteration
    /// than its siblings; the first result counts. Default 3; 0 disables it.
    pub straggler_factor: f64,
    /// Minimum age of an attempt before a duplicate one starts, milliseconds. Default 600 000.
    pub straggler_after_ms: u32,
    /// Fail a job after this long without a connected worker that has enough GPU memory for its next task,
    /// milliseconds. It applies only while workers are connected. Default 0: wait forever.
    pub capacity_timeout_ms: u32,
    /// Hours after its end after which a job is deleted with its files. Default 0: never.
    pub keep_jobs_hours: u32,
    /// Hours to keep unreferenced files: uploads without a job, replaced checkpoints, and files of deleted
    /// jobs. Default 168, a week; at least 24, because tasks upload for hours before they submit.
    pub keep_unused_hours: u32,
    /// Hours without activity after which the upload of a dataset expires. Default 168, a week; at least 1.
    pub keep_uploads_hours: u32,
    /// Whether every call needs a token. Default false, which is for a single machine. The first token is
    /// then written to `operator.token` in `data_dir`.
    pub tokens: bool,
    /// Certificates of this server, PEM, its own first; with `tls_key`. Default none: plain text. These three
    /// files are reloaded when they change; open connections stay.
    pub tls_cert: Option<PathBuf>,
    /// The key of `tls_cert`, PEM.
    pub tls_key: Option<PathBuf>,
    /// Certificate authorities, PEM: workers must then present a certificate signed by one of them (mutual
    /// TLS). Default none.
    pub client_ca: Option<PathBuf>,
    /// Whether it may listen beyond this machine without TLS or tokens, for example behind a proxy that
    /// provides them. Default false.
    pub insecure: bool,
    /// Maximum calls per second by the users of one tenant, where tokens are required; more are refused with
    /// RATE_LIMITED. Default 200; 0: no limit.
    pub calls_per_second: u32,
    /// Maximum open jobs of a tenant; one more is refused. Default 0: no limit. Operators can set other
    /// limits for single tenants.
    pub tenant_open_jobs: u32,
    /// Maximum tasks of a tenant that run at a time; others wait. Default 0: no limit.
    pub tenant_parallel: u32,
    /// Maximum bytes of a tenant's photographs, checkpoints and results; beyond it, uploads and new jobs are
    /// refused. Default 0: no limit.
    pub tenant_bytes: u64,
    /// Maximum log of one attempt, bytes; a longer log loses its middle. Default 4 MiB, at least 64 KiB.
    pub attempt_log_bytes: u64,
    /// Minimum free disk space for uploads and new jobs, bytes. Default 1 GiB; 0 disables the check.
    pub min_free_bytes: u64,
}

impl Default for CoordinatorConfig {
    fn default() -> Self {
        Self {
            data_dir: PathBuf::from("fathom-data"),
            store: None,
            store_connections: 32,
            objects: None,
            direct_transfers: true,
            direct_uploads_from_bytes: 8 << 20,
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 7420)),
            metrics_listen: None,
            web: None,
            own_page: false,
            webhook: None,
            webhook_secret: None,
            scaler_listen: None,
            scaler_client_ca: None,
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
            attempt_log_bytes: crate::logs::ATTEMPT_BYTES,
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
        let others = [
            ("metrics_listen", self.metrics_listen),
            ("scaler_listen", self.scaler_listen),
            ("web", self.web),
        ];
        let mut taken = vec![("listen", self.listen)];
        for (name, address) in others.into_iter().filter_map(|(name, of)| Some((name, of?))) {
            // Port 0 takes another port for each.
            let same = taken.iter().find(|(_, other)| address.port() != 0 && *other == address);
            require(
                same.is_none(),
                &format!("{name} must differ from {}", same.map_or("", |(name, _)| name)),
            );
            taken.push((name, address));
        }
        require(
            self.scaler_client_ca.is_none() || (self.tls_cert.is_some() && self.scaler_listen.is_some()),
            "scaler_client_ca needs scaler_listen, tls_cert and tls_key: certificates are sent over TLS only",
        );
        require(
            self.scaler_client_ca.is_some()
                || self.insecure
                || self.scaler_listen.is_none_or(|listen| listen.ip().is_loopback()),
            "scaler_listen is reachable from other machines, and anyone could read how many tasks there are: set tls_cert, \
             tls_key and scaler_client_ca, or insecure = true",
        );
        let webhook = self.webhook.as_deref().map(|url| crate::webhook::check(url, self.insecure));
        require(!matches!(webhook, Some(Err(_))), webhook.and_then(Result::err).unwrap_or_default());
        require(
            self.webhook_secret.is_none() || self.webhook.is_some(),
            "webhook_secret needs webhook, the address that hears of the ends of jobs",
        );
        require(
            self.store_connections >= 2,
            "store_connections must be at least 2: one of them is for renewals",
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
            "straggler_factor must be 0 or at least 1: how many times longer than its siblings a slow task takes",
        );
        require(
            self.keep_unused_hours >= 24,
            "keep_unused_hours must be at least 24: tasks upload for hours before they submit",
        );
        require(
            self.keep_uploads_hours >= 1,
            "keep_uploads_hours must be at least 1: an upload takes time, and may be interrupted",
        );
        require(
            self.tls_cert.is_some() == self.tls_key.is_some(),
            "tls_cert and tls_key belong together: set both or neither",
        );
        require(
            self.client_ca.is_none() || self.tls_cert.is_some(),
            "client_ca needs tls_cert and tls_key: certificates are sent over TLS only",
        );
        let is_safe = self.tls_cert.is_some() && self.tokens;
        require(
            is_safe || self.insecure || self.listen.ip().is_loopback(),
            "listen is reachable from other machines, and anyone could read and control everything: set tls_cert, tls_key and \
             tokens = true, or insecure = true",
        );
        require(
            is_safe || self.insecure || self.web.is_none_or(|web| web.ip().is_loopback()),
            "web is reachable from other machines, and anyone could read and control everything: set tls_cert, tls_key and \
             tokens = true, or insecure = true",
        );
        require(
            (64 << 10..=1 << 30).contains(&self.attempt_log_bytes),
            "attempt_log_bytes must be between 65 536 and 1 073 741 824",
        );
        require(self.backoff_ms <= 60_000, "backoff_ms must be at most 60 000");
        faults
    }

    /// The rules of the scheduler.
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

    /// Retention times; garbage is collected once an hour.
    pub fn housekeeping(&self) -> Housekeeping {
        let hours = |count: u32| Duration::from_secs(60 * 60 * u64::from(count));
        let policy = Policy {
            jobs: (self.keep_jobs_hours > 0).then(|| hours(self.keep_jobs_hours)),
            unused: hours(self.keep_unused_hours),
            uploads: hours(self.keep_uploads_hours),
        };
        Housekeeping { policy, every: hours(1) }
    }

    /// The default quota of tenants.
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
    fn a_scaler_beyond_the_machine_needs_certificates() {
        let everywhere = Some(SocketAddr::from((Ipv4Addr::UNSPECIFIED, 7430)));
        let pem = || Some(PathBuf::from("a.pem"));
        let said = faults(|config| config.scaler_listen = everywhere);
        assert!(said.len() == 1 && said[0].contains("scaler_client_ca"), "{said:?}");
        assert_eq!(
            faults(|config| config.scaler_listen = Some(SocketAddr::from(([127, 0, 0, 1], 7430)))).len(),
            0
        );
        let said = faults(|config| {
            config.scaler_listen = everywhere;
            (config.tls_cert, config.tls_key, config.scaler_client_ca) = (pem(), pem(), pem());
        });
        assert_eq!(said, Vec::<String>::new());
        let said = faults(|config| config.scaler_client_ca = pem());
        assert!(said.len() == 1 && said[0].contains("needs scaler_listen"), "{said:?}");
        let said = faults(|config| config.scaler_listen = Some(config.listen));
        assert!(said.len() == 1 && said[0].contains("must differ"), "{said:?}");
    }

    #[test]
    fn the_http_interface_needs_an_address_of_its_own() {
        let said = faults(|config| config.web = Some(config.listen));
        assert_eq!(said, ["web must differ from listen"]);
        let free = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        let on_free = |config: &mut CoordinatorConfig| {
            (config.listen, config.web, config.metrics_listen) = (free, Some(free), Some(free));
        };
        assert_eq!(faults(on_free), Vec::<String>::new());
        let everywhere = Some(SocketAddr::from((Ipv4Addr::UNSPECIFIED, 7480)));
        let said = faults(|config| config.web = everywhere);
        assert!(said.len() == 1 && said[0].contains("insecure = true"), "{said:?}");
        assert_eq!(faults(|config| (config.web, config.insecure) = (everywhere, true)).len(), 0);
    }

    #[test]
    fn contradictions_are_reported_together() {
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
