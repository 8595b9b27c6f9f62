//! What operators see of workers: their speed, and the latest line that they logged.

use std::time::{SystemTime, UNIX_EPOCH};

use fathom_coordinator::json;
use fathom_proto::v1;
use fathom_proto::worker::v1 as worker_v1;
use serde_json::{Value, json};

use crate::support::TestCluster;

#[tokio::test]
async fn workers_are_listed_with_their_speed_and_last_words() {
    let cluster = TestCluster::start().await;
    cluster.submit("a job", 1).await;
    let (mut worker, claim) = cluster.worker_by_hand("by hand").await;
    let incarnation = claim.incarnation.clone();
    let lease = worker.claim(claim).await.unwrap().into_inner().assignment.unwrap().lease.unwrap();
    let known = async || json::worker(&cluster.workers().await[0]);
    let quiet = known().await;
    assert_eq!((&quiet["name"], &quiet["last_words"]), (&json!("by hand"), &Value::Null));
    assert_eq!(quiet["iterations_per_second"], Value::Null);

    let renew = async |iterations_per_second: f32| {
        let progress =
            v1::Progress { iteration: 5, iterations: 400, iterations_per_second, ..Default::default() };
        let renewal =
            worker_v1::Renewal { lease: Some(lease.clone()), progress: Some(progress), ..Default::default() };
        let renewals = vec![renewal];
        let request = worker_v1::RenewRequest { incarnation: incarnation.clone(), renewals };
        worker.clone().renew(request).await.unwrap();
    };
    renew(12.5).await;
    assert_eq!(known().await["iterations_per_second"], 12.5);
    renew(f32::NAN).await;
    assert_eq!(known().await["iterations_per_second"], Value::Null);

    // The time of the line is that of the coordinator: that of a worker may be anything.
    let far = prost_types::Timestamp { seconds: i64::MAX, nanos: 0 };
    let line = |number: u64, severity: v1::LogSeverity, message: &str| worker_v1::LogLine {
        number,
        time: Some(far),
        severity: severity.into(),
        message: message.to_owned(),
    };
    let lines = vec![
        line(1, v1::LogSeverity::Info, "first"),
        line(2, v1::LogSeverity::Warn, &format!("two\nlines {}", "ä".repeat(400))),
        line(3, v1::LogSeverity::Debug, "a detail"),
    ];
    let request = worker_v1::AppendLogsRequest { lease: Some(lease.clone()), lines };
    worker.append_logs(request).await.unwrap();
    let said = known().await;
    let words = said["last_words"].as_str().unwrap();
    assert!(words.starts_with("two lines ää") && words.ends_with("ä ..."), "{words}");
    assert_eq!(words.chars().count(), 300);
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_secs_f64();
    assert!((said["last_words_unix_seconds"].as_f64().unwrap() - now).abs() < 60.0, "{said}");

    let message = "the GPU was lost".to_owned();
    let class = worker_v1::FailClass::Environment.into();
    worker.fail(worker_v1::FailRequest { lease: Some(lease.clone()), class, message }).await.unwrap();
    assert_eq!(known().await["last_words"], format!("{} failed: the GPU was lost", lease.task_id));
}
