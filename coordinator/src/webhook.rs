//! Tells an address of the operator when a job has ended, by a signed POST request (Standard Webhooks 1.0).
//!
//! The row of a job says whether that was done ([`Announcement`]), so a crash of coordinator or receiver
//! loses no end. A coordinator that announces holds the row for a minute, so that several do not repeat each
//! other. An answer can be lost: then the same message is sent again, under the same id.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use reqwest::header::CONTENT_TYPE;
use ring::hmac;
use ring::rand::{SecureRandom as _, SystemRandom};
use serde_json::json;
use url::Url;

use crate::access::write_secret;
use crate::config::CoordinatorConfig;
use crate::error::CoordinatorError;
use crate::json;
use crate::rate_limited_log::RateLimitedLog;
use crate::schedule::{Announcement, Event, JobRecord, JobState, Outcome};
use crate::services::encode;
use crate::state::{State, stopped};
use crate::store::{JobFilter, StoreError};

/// Time between two looks for jobs that have ended.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// Longest time between two reads of all ended jobs: another coordinator may have given up.
const READ_EVERY: Duration = Duration::from_secs(60);
/// Time limit of a request.
const ANSWER_WITHIN: Duration = Duration::from_secs(10);
/// For how long a coordinator that announces keeps others from it.
const HELD_FOR_MS: u64 = 60_000;
/// Pauses between requests that fail, and the longest of them.
const FIRST_PAUSE: Duration = Duration::from_secs(2);
const LONGEST_PAUSE: Duration = Duration::from_secs(600);
/// An end is announced no longer after this time.
const GIVE_UP_AFTER_MS: u64 = 3 * 24 * 3600 * 1000;
/// Jobs per page.
const PAGE: usize = 256;
/// Begins a secret.
const PREFIX: &str = "whsec_";
/// Bytes of a secret.
const SECRET_BYTES: std::ops::RangeInclusive<usize> = 24..=64;

/// Refuses an address that cannot be called, or to which jobs would travel in plain text over a network.
///
/// # Errors
/// What is wrong with it.
pub fn check(url: &str, insecure: bool) -> Result<(), &'static str> {
    let Ok(url) = Url::parse(url) else {
        return Err("webhook is no URL; set for example https://example.org/fathom");
    };
    match (url.scheme(), url.host()) {
        ("https", Some(_)) => Ok(()),
        ("http", Some(host)) if insecure || is_loopback(&host) => Ok(()),
        ("http", Some(_)) => {
            Err("webhook gets jobs in plain text over the network: use https, or insecure = true")
        }
        _ => Err("webhook must begin with https:// (or http:// on this machine)"),
    }
}

fn is_loopback(host: &url::Host<&str>) -> bool {
    match host {
        url::Host::Domain(name) => *name == "localhost",
        url::Host::Ipv4(address) => address.is_loopback(),
        url::Host::Ipv6(address) => address.is_loopback(),
    }
}

/// The webhook of a coordinator.
pub struct Webhook {
    url: Url,
    key: hmac::Key,
    client: reqwest::Client,
    failures: RateLimitedLog,
}

/// A message that was not taken.
#[derive(Debug, thiserror::Error)]
enum Failure {
    #[error("it answers {0}")]
    Status(reqwest::StatusCode),
    #[error("it cannot be reached: {0}")]
    Http(String),
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl Webhook {
    /// The webhook of a configuration; `None` without one. Makes the secret where there is none.
    ///
    /// # Errors
    /// When the secret cannot be read or made.
    pub fn of(config: &CoordinatorConfig) -> Result<Option<Self>, CoordinatorError> {
        let Some(url) = &config.webhook else { return Ok(None) };
        let url = Url::parse(url).map_err(|error| CoordinatorError::Config(format!("webhook: {error}")))?;
        let path = match &config.webhook_secret {
            Some(path) => path.clone(),
            None => made_secret(&config.data_dir)?,
        };
        let failed =
            |what: &str| CoordinatorError::Config(format!("webhook_secret: {}: {what}", path.display()));
        let text = std::fs::read_to_string(&path).map_err(|error| failed(&error.to_string()))?;
        let key = key_of(text.trim()).ok_or_else(|| {
            failed("it must hold whsec_ and 24 to 64 bytes in base64; `openssl rand -base64 32` makes them")
        })?;
        // It fails when the process has named one before.
        let _ = tokio_rustls::rustls::crypto::ring::default_provider().install_default();
        let client = reqwest::Client::builder()
            .timeout(ANSWER_WITHIN)
            // The operator named one address, and no other.
            .redirect(reqwest::redirect::Policy::none())
            .no_proxy()
            .build()
            .map_err(|error| CoordinatorError::Server(format!("webhook: {error}")))?;
        Ok(Some(Self { url, key, client, failures: RateLimitedLog::default() }))
    }

    /// Announces ends until the coordinator stops.
    pub async fn run(self, shared: Arc<State>) {
        let mut stopping = shared.stopping.clone();
        tokio::select! {
            () = stopped(&mut stopping) => {}
            never = self.announce_all(&shared) => match never {},
        }
    }

    async fn announce_all(&self, shared: &State) -> std::convert::Infallible {
        let mut known = None;
        let mut since_read = READ_EVERY;
        let mut pause = FIRST_PAUSE;
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            since_read += LOOK_EVERY;
            // Reading all jobs is dear, so it happens when a job has ended, and rarely otherwise.
            let ended = shared.jobs.levels().await.ok().map(|levels| {
                [JobState::Succeeded, JobState::Failed, JobState::Cancelled]
                    .map(|state| levels.jobs.get(&state).copied().unwrap_or_default())
            });
            if ended == known && since_read < READ_EVERY {
                continue;
            }
            match self.announce_ended(shared).await {
                Ok(()) => (known, since_read, pause) = (ended, Duration::ZERO, FIRST_PAUSE),
                Err(error) => {
                    if let Some(failures) = self.failures.count() {
                        tracing::warn!(%error, url = %self.address(), failures, "the webhook did not take the end of a job; it is tried again");
                    }
                    tokio::time::sleep(pause).await;
                    pause = (2 * pause).min(LONGEST_PAUSE);
                }
            }
        }
    }

    /// Announces all jobs that have ended, the oldest end first. Ends early when nobody answers; a message
    /// that is refused holds up no other.
    async fn announce_ended(&self, shared: &State) -> Result<(), Failure> {
        let states = vec![JobState::Succeeded, JobState::Failed, JobState::Cancelled];
        let filter = JobFilter { states, ..JobFilter::default() };
        let (mut before, mut due) = (None, Vec::new());
        loop {
            let page = shared.jobs.list(&filter, before.as_ref(), PAGE).await?;
            let Some(last) = page.last() else { break };
            before = Some(last.job_id.clone());
            let is_due = |job: &JobRecord| match job.announcement {
                Announcement::Due { not_before_ms } => {
                    Some((job.ended_ms?, job.job_id.clone(), not_before_ms))
                }
                Announcement::NotWanted | Announcement::Made => None,
            };
            due.extend(page.iter().filter_map(is_due));
        }
        due.sort();
        let mut refused = Ok(());
        for (ended_ms, id, known_ms) in due {
            let now_ms = shared.clock.now_ms();
            if known_ms > now_ms {
                // Another coordinator is at it.
                continue;
            }
            let until_ms = now_ms + HELD_FOR_MS;
            let hold = Event::Announce { ended_ms, known_ms, until_ms };
            let job = match shared.jobs.apply(&id, hold, now_ms).await {
                Ok(Outcome::Changed(_)) => shared.jobs.job_row(&id).await,
                // Another coordinator was faster.
                Ok(Outcome::Already) => continue,
                Err(error) => Err(error),
            };
            let job = match job {
                Ok(job) => job,
                // Its user was faster.
                Err(StoreError::JobNotFound(_)) => continue,
                Err(error) => return Err(error.into()),
            };
            if job.ended_ms != Some(ended_ms) {
                // Its user has retried it.
                continue;
            }
            let announced = match self.send(&job, ended_ms).await {
                Err(error) if now_ms.saturating_sub(ended_ms) > GIVE_UP_AFTER_MS => {
                    tracing::error!(job = %id, %error, url = %self.address(), "gave up telling the webhook of the end of a job");
                    Ok(())
                }
                sent => sent,
            };
            if let Err(error) = announced {
                // The next try does not wait for the minute to end.
                let back = Event::Announce { ended_ms, known_ms: until_ms, until_ms: 0 };
                let _ = shared.jobs.apply(&id, back, now_ms).await;
                if matches!(error, Failure::Status(_)) {
                    refused = Err(error);
                    continue;
                }
                return Err(error);
            }
            match shared.jobs.apply(&id, Event::Announced { ended_ms }, shared.clock.now_ms()).await {
                Ok(_) | Err(StoreError::JobNotFound(_)) => {}
                Err(error) => return Err(error.into()),
            }
        }
        refused
    }

    async fn send(&self, job: &JobRecord, ended_ms: u64) -> Result<(), Failure> {
        let mut of_job = json::job(&encode::job(job, job.progress(0), None));
        if let Some(of_job) = of_job.as_object_mut() {
            // There are none in it.
            of_job.remove("tasks");
        }
        let body = json!({
            "type": "job.ended",
            "timestamp": encode::timestamp(ended_ms).to_string(),
            "data": of_job,
        })
        .to_string();
        // The clock of this machine as it is now: receivers refuse a message that seems old.
        let at = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs().to_string();
        let id = format!("{}-{ended_ms}", job.job_id);
        let request = self
            .client
            .post(self.url.clone())
            .header(CONTENT_TYPE, "application/json")
            .header("webhook-signature", signature(&self.key, &id, &at, &body))
            .header("webhook-id", id)
            .header("webhook-timestamp", at)
            .body(body);
        let answer = request.send().await.map_err(|error| Failure::Http(cause(error)))?;
        if answer.status().is_success() { Ok(()) } else { Err(Failure::Status(answer.status())) }
    }

    /// The address without what may be secret in it.
    fn address(&self) -> String {
        format!("{}://{}", self.url.scheme(), self.url.host_str().unwrap_or_default())
    }
}

/// The last cause of an error, without the address.
fn cause(error: reqwest::Error) -> String {
    let error = error.without_url();
    let mut cause: &dyn std::error::Error = &error;
    while let Some(source) = cause.source() {
        cause = source;
    }
    cause.to_string()
}

/// The signature of a message.
fn signature(key: &hmac::Key, id: &str, at: &str, body: &str) -> String {
    let tag = hmac::sign(key, format!("{id}.{at}.{body}").as_bytes());
    format!("v1,{}", BASE64_STANDARD.encode(tag))
}

/// The key in the text of a secret.
fn key_of(secret: &str) -> Option<hmac::Key> {
    let bytes = BASE64_STANDARD.decode(secret.strip_prefix(PREFIX)?).ok()?;
    SECRET_BYTES.contains(&bytes.len()).then(|| hmac::Key::new(hmac::HMAC_SHA256, &bytes))
}

/// The path of the secret in a data directory, which is made where there is none.
fn made_secret(data_dir: &Path) -> Result<std::path::PathBuf, CoordinatorError> {
    let path = data_dir.join("webhook.secret");
    if !path.exists() {
        let mut bytes = [0; 32];
        let failed = |error: String| CoordinatorError::Server(format!("{}: {error}", path.display()));
        SystemRandom::new().fill(&mut bytes).map_err(|error| failed(error.to_string()))?;
        let secret = format!("{PREFIX}{}", BASE64_STANDARD.encode(bytes));
        write_secret(&path, &secret).map_err(|error| failed(error.to_string()))?;
        tracing::info!(path = %path.display(), "made the secret of the webhook");
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_signed_as_standard_webhooks_has_it() {
        // The example of its reference implementations.
        let key = key_of("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw").unwrap();
        let of = signature(&key, "msg_p5jXN8AQM9LWM0D4loKWxJek", "1614265330", r#"{"test": 2432232314}"#);
        assert_eq!(of, "v1,g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE=");
        for secret in ["", "whsec_", "whsec_!", "whsec_AAAA", "MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"] {
            assert!(key_of(secret).is_none(), "{secret:?} is a secret");
        }
    }

    #[test]
    fn plain_text_is_for_this_machine() {
        for url in ["https://example.org/a?b", "http://127.0.0.1:80/", "http://localhost/", "http://[::1]:1/"]
        {
            assert_eq!(check(url, false), Ok(()), "{url}");
        }
        assert_eq!(check("http://example.org/", true), Ok(()));
        for url in
            ["http://example.org/", "http://localhost.example.org/", "example.org", "ftp://a/", "https://"]
        {
            assert!(check(url, false).is_err(), "{url}");
        }
    }

    #[test]
    fn the_secret_is_made_once() {
        let dir = tempfile::tempdir().unwrap();
        let path = made_secret(dir.path()).unwrap();
        let secret = std::fs::read_to_string(&path).unwrap();
        assert!(key_of(secret.trim()).is_some());
        made_secret(dir.path()).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), secret);
    }
}
