//! The ends of jobs reach the webhook of the operator: signed, over restarts, once.

use std::sync::Arc;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use fathom_proto::v1;
use ring::hmac;
use serde_json::Value;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};

use crate::support::{FakeTrainer, TestCluster};

/// A request: its head and its body.
type Request = (String, String);

/// A receiver that keeps what it gets, and answers with a status.
struct Receiver {
    url: String,
    status: Arc<AtomicU16>,
    requests: Arc<Mutex<Vec<Request>>>,
}

impl Receiver {
    async fn start(status: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/ends?key=secret", listener.local_addr().unwrap());
        let (status, requests) = (Arc::new(AtomicU16::new(status)), Arc::<Mutex<Vec<Request>>>::default());
        let (of_answers, of_requests) = (Arc::clone(&status), Arc::clone(&requests));
        tokio::spawn(async move {
            while let Ok((stream, _)) = listener.accept().await {
                let Some(request) = read(stream, of_answers.load(Ordering::Relaxed)).await else { continue };
                of_requests.lock().unwrap().push(request);
            }
        });
        Self { url, status, requests }
    }

    /// The requests so far, once there are this many.
    async fn at_least(&self, count: usize) -> Vec<Request> {
        let since = Instant::now();
        loop {
            let requests = self.requests.lock().unwrap().clone();
            if requests.len() >= count {
                return requests;
            }
            assert!(since.elapsed().as_secs() < 60, "waited in vain: {requests:?}");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }
}

/// Reads one request and answers it.
async fn read(mut stream: TcpStream, status: u16) -> Option<Request> {
    let mut bytes = Vec::new();
    let request = loop {
        let mut piece = [0; 4096];
        let count = stream.read(&mut piece).await.ok().filter(|count| *count > 0)?;
        bytes.extend_from_slice(&piece[..count]);
        let text = String::from_utf8_lossy(&bytes);
        let Some((head, body)) = text.split_once("\r\n\r\n") else { continue };
        let length: usize = header(head, "content-length").parse().unwrap();
        if body.len() == length {
            break (head.to_owned(), body.to_owned());
        }
    };
    let answer = format!("HTTP/1.1 {status} X\r\ncontent-length: 0\r\nconnection: close\r\n\r\n");
    stream.write_all(answer.as_bytes()).await.ok()?;
    Some(request)
}

fn header<'a>(head: &'a str, name: &str) -> &'a str {
    let of = |line: &'a str| line.split_once(": ").filter(|(key, _)| key.eq_ignore_ascii_case(name));
    head.lines().find_map(of).unwrap_or_else(|| panic!("no {name} in {head}")).1
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_webhook_learns_of_each_end_once_and_signed() {
    let receiver = Receiver::start(503).await;
    let url = receiver.url.clone();
    let mut cluster = TestCluster::with(|config| config.webhook = Some(url)).await;
    let cancelled = cluster.submit("cancelled", 1).await;
    let stop = v1::CancelJobRequest { job_id: cancelled.clone(), reason: "enough".into() };
    cluster.jobs().cancel_job(stop).await.unwrap();
    // It is down; the coordinator tries again, also after a restart.
    receiver.at_least(1).await;
    cluster.restart().await;
    let before = receiver.at_least(2).await.len();
    receiver.status.store(204, Ordering::Relaxed);
    let _worker = cluster.worker(FakeTrainer::quick());
    let succeeded = cluster.submit("succeeded", 1).await;
    assert_eq!(cluster.finished(&succeeded).await.state(), v1::JobState::Succeeded);
    let requests = receiver.at_least(before + 2).await;

    let secret = std::fs::read_to_string(cluster.dir.path().join("data/webhook.secret")).unwrap();
    let key = BASE64_STANDARD.decode(secret.trim().strip_prefix("whsec_").unwrap()).unwrap();
    let key = hmac::Key::new(hmac::HMAC_SHA256, &key);
    for (head, body) in &requests {
        assert!(head.starts_with("POST /ends?key=secret HTTP/1.1"), "{head}");
        let (id, at) = (header(head, "webhook-id"), header(head, "webhook-timestamp"));
        let signature = header(head, "webhook-signature").strip_prefix("v1,").unwrap();
        let signature = BASE64_STANDARD.decode(signature).unwrap();
        hmac::verify(&key, format!("{id}.{at}.{body}").as_bytes(), &signature).unwrap();
    }
    let of = |job: &str| -> Vec<(&str, Value)> {
        let of_job = requests.iter().filter(|(_, body)| body.contains(job));
        of_job.map(|(head, body)| (header(head, "webhook-id"), serde_json::from_str(body).unwrap())).collect()
    };
    // Repeated messages have one id, by which a receiver knows them.
    let ends = of(&cancelled);
    assert!(ends.len() > before && ends.iter().all(|(id, _)| *id == ends[0].0), "{ends:?}");
    let (_, said) = &ends[0];
    assert_eq!((&said["type"], &said["data"]["state"]), (&"job.ended".into(), &"cancelled".into()));
    assert_eq!((&said["data"]["job"], &said["data"]["error"]), (&cancelled.into(), &"enough".into()));
    let ends = of(&succeeded);
    assert!(ends.len() == 1 && ends[0].1["data"]["state"] == "succeeded", "{ends:?}");

    // Nothing is announced again, not even after a restart.
    cluster.restart().await;
    tokio::time::sleep(Duration::from_secs(3)).await;
    assert_eq!(receiver.at_least(0).await.len(), requests.len());
}
