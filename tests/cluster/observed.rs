//! Metrics and logs of whole runs over loopback, with a trainer that needs no GPU.
#![expect(clippy::unwrap_used, reason = "the helpers of a test fail by panicking")]

#[path = "../support/cluster.rs"]
mod support;

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::Path;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use crate::support::{FakeTrainer, TestCluster, free_address, incarnation_of, page, reason_of, registration};
use fathom_observe::{Guard, LogFormat, Logging};
use fathom_proto::dial::{Connection, Dial};
use fathom_proto::v1;
use fathom_proto::v1::LogSeverity;
use fathom_proto::worker::v1 as worker_v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;

/// Captures the log lines of attempts in this process from now on.
fn capture_lines() {
    static LOG: OnceLock<Guard> = OnceLock::new();
    LOG.get_or_init(|| {
        let logging = Logging {
            format: LogFormat::Text,
            default_filter: "off".into(),
            captures: true,
            service: "fathom-test",
        };
        fathom_observe::init(&logging)
    });
}

/// Series by name and labels, after a check that the text is valid OpenMetrics.
fn parse(text: &str) -> BTreeMap<String, f64> {
    assert!(text.ends_with("# EOF\n"), "the text ends with {:?}", text.lines().last());
    let (mut series, mut families) = (BTreeMap::new(), HashSet::new());
    for line in text.lines() {
        if let Some(comment) = line.strip_prefix("# ") {
            let words: Vec<&str> = comment.split(' ').collect();
            match words[0] {
                "TYPE" => assert!(families.insert(words[1].to_owned()), "{} is there twice", words[1]),
                "HELP" => assert!(words.len() > 3, "{line}"),
                "UNIT" => assert!(words[1].ends_with(words[2]), "{line}"),
                "EOF" => {}
                other => panic!("{other} in {line}"),
            }
            continue;
        }
        let (name, value) = line.rsplit_once(' ').unwrap_or_else(|| panic!("{line}"));
        let family = name.split('{').next().unwrap();
        let known = ["", "_total", "_bucket", "_sum", "_count"]
            .iter()
            .any(|end| family.strip_suffix(end).is_some_and(|family| families.contains(family)));
        assert!(known, "{line} has no type");
        let value = value.parse().unwrap_or_else(|_| panic!("{line}"));
        assert!(series.insert(name.to_owned(), value).is_none(), "{name} is there twice");
    }
    assert!(series.len() > 5, "{text}");
    series
}

/// The sum of a family's series that have all of `labels`.
fn sum(series: &BTreeMap<String, f64>, family: &str, labels: &[&str]) -> f64 {
    let of_family = |name: &str| name == family || name.starts_with(&format!("{family}{{"));
    let found =
        series.iter().filter(|(name, _)| of_family(name) && labels.iter().all(|label| name.contains(label)));
    found.map(|(_, value)| value).sum()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn metrics_count_the_work_of_a_whole_run() {
    let cluster = TestCluster::start().await;
    assert_eq!(cluster.page("/healthz").await, (200, "lives\n".into()));
    assert_eq!(cluster.page("/readyz").await, (200, "ready\n".into()));
    assert_eq!(cluster.page("/elsewhere").await.0, 404);
    let empty = parse(&cluster.page("/metrics").await.1);
    assert_eq!(sum(&empty, "fathom_jobs", &[]), 0.0);
    assert!(empty["fathom_disk_free_bytes"] > 0.0);

    let at = free_address();
    let job = cluster.submit("counted", 2).await;
    // Gauges are cached for a second.
    tokio::time::sleep(Duration::from_millis(1100)).await;
    let waits = parse(&cluster.page("/metrics").await.1);
    assert_eq!(sum(&waits, "fathom_jobs", &["state=\"running\""]), 1.0);
    let trainer = FakeTrainer::fails_once();
    let worker = cluster.worker_with_metrics(trainer, Some(at));
    let job = cluster.finished(&job).await;
    assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    tokio::time::sleep(Duration::from_millis(1100)).await;
    let by_coordinator = parse(&cluster.page("/metrics").await.1);
    let by_worker = parse(&page(at, "/metrics").await.1);
    assert_eq!(page(at, "/readyz").await, (200, "ready\n".into()));

    let of_workers = |task: &&v1::Task| !task.worker.starts_with("coordinator");
    let tasks = job.tasks.len() as f64;
    let workers_tasks = job.tasks.iter().filter(of_workers).count() as f64;
    let attempts: u32 = job.tasks.iter().map(|task| task.attempts).sum();
    assert_eq!(attempts as f64, tasks + 1.0, "one attempt fails");
    let c = |family: &str, labels: &[&str]| sum(&by_coordinator, family, labels);
    assert_eq!(c("fathom_attempts_completed_total", &[]), tasks);
    assert_eq!(c("fathom_attempts_completed_total", &["stage=\"partition\""]), 2.0);
    assert_eq!(c("fathom_attempts_granted_total", &[]), tasks + 1.0);
    assert_eq!(c("fathom_retries_total", &[]), 1.0);
    assert_eq!(c("fathom_attempts_failed_total", &["class=\"training\""]), 1.0);
    assert_eq!(c("fathom_jobs_submitted_total", &[]), 1.0);
    assert_eq!((c("fathom_jobs", &["state=\"succeeded\""]), c("fathom_jobs", &[])), (1.0, 1.0));
    for family in ["fathom_leases", "fathom_tasks_ready", "fathom_oldest_ready_seconds"] {
        assert_eq!(c(family, &[]), 0.0, "{family}");
    }
    assert_eq!(c("fathom_workers", &["state=\"active\""]), 1.0);
    // Planning, global, partitions, merge, evaluation, artifacts.
    assert_eq!(c("fathom_stage_seconds_count", &[]), 6.0);
    assert_eq!(c("fathom_stage_seconds_count", &["stage=\"partition\""]), 1.0);
    assert!(c("fathom_stage_seconds_sum", &[]) > 0.0);
    assert!(c("fathom_store_acknowledgement_seconds_count", &[]) > 2.0 * tasks);
    assert_eq!(c("fathom_grpc_calls_total", &["JobService/CreateJob", "code=\"ok\""]), 1.0);
    assert!(c("fathom_grpc_calls_total", &["JobService/GetJob", "code=\"ok\""]) > 1.0);
    assert_eq!(c("fathom_grpc_calls_total", &["WorkerService/Fail", "code=\"ok\""]), 1.0);
    assert_eq!(c("fathom_grpc_call_seconds_count", &["JobService/CreateJob"]), 1.0);

    let w = |family: &str, labels: &[&str]| sum(&by_worker, family, labels);
    assert_eq!(w("fathom_worker_tasks_total", &["outcome=\"done\""]), workers_tasks);
    assert_eq!(w("fathom_worker_tasks_total", &["outcome=\"failed\""]), 1.0);
    let trained: u32 =
        job.tasks.iter().filter_map(|task| task.progress).map(|progress| progress.iterations).sum();
    assert!(trained <= w("fathom_worker_iterations_total", &[]) as u32);
    assert!(w("fathom_worker_iterations_total", &[]) >= 400.0, "{by_worker:?}");
    // Every byte that a worker fetched was served; both ends count all fetched bytes.
    let fetched = w("fathom_worker_fetched_bytes_total", &[]);
    assert!(fetched > 0.0 && c("fathom_served_bytes_total", &[]) >= fetched);
    assert!(c("fathom_uploaded_bytes_total", &[]) > 1000.0);
    assert!(w("fathom_worker_cache_total", &["found=\"hit\""]) > 0.0);
    assert!(w("fathom_worker_cache_total", &["found=\"miss\""]) > 0.0);
    assert_eq!(w("fathom_worker_iterations_per_second", &[]), 0.0);
    worker.leave().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn faults_are_counted_by_class_and_callers_add_no_series() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("faults", 1).await;
    let worker = cluster.worker(FakeTrainer::hangs_after_checkpoint());
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.checkpoint_iteration > 0)).await;
    let live = parse(&cluster.page("/metrics").await.1);
    assert_eq!(sum(&live, "fathom_leases", &["stage=\"partition\""]), 1.0);
    worker.kill();
    cluster.wait_for(&job, |job| job.tasks.iter().any(|task| task.losses > 0)).await;

    let mut client = WorkerServiceClient::new(Dial::to(&cluster.url()).lazily().unwrap());
    let stale =
        worker_v1::Lease { job_id: job.clone(), task_id: "partition-0000".into(), attempt: 1, fence: 1 };
    let refused =
        client.release(worker_v1::ReleaseRequest { lease: Some(stale), reason: String::new() }).await;
    assert_eq!(reason_of(&refused.unwrap_err()), "STALE_FENCE");
    let other = tonic::transport::Endpoint::from_shared(cluster.url()).unwrap().connect().await.unwrap();
    let mut unknown = tonic::client::Grpc::new(other);
    for number in 0..3 {
        unknown.ready().await.unwrap();
        let path = format!("/fathom.v1.JobService/Method{number}").parse().unwrap();
        let codec = tonic_prost::ProstCodec::<v1::GetJobRequest, v1::Job>::default();
        let request = tonic::Request::new(v1::GetJobRequest::default());
        assert_eq!(unknown.unary(request, path, codec).await.unwrap_err().code(), tonic::Code::Unimplemented);
    }

    let series = parse(&cluster.page("/metrics").await.1);
    assert_eq!(sum(&series, "fathom_leases_expired_total", &["why=\"silent\"", "stage=\"partition\""]), 1.0);
    assert_eq!(sum(&series, "fathom_stale_fences_total", &[]), 1.0);
    assert_eq!(
        sum(&series, "fathom_grpc_calls_total", &["WorkerService/Release", "code=\"failed_precondition\""]),
        1.0
    );
    assert_eq!(sum(&series, "fathom_grpc_calls_total", &["method=\"other\"", "code=\"unimplemented\""]), 3.0);
    assert!(!series.keys().any(|name| name.contains("Method")), "a caller made a series");
}

fn of_job(job: &str) -> v1::StreamLogsRequest {
    v1::StreamLogsRequest { job_id: job.into(), ..Default::default() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_log_keeps_all_attempts_after_their_workers_left() {
    capture_lines();
    let mut cluster = TestCluster::start().await;
    let job = cluster.submit("logged", 2).await;
    let follower = {
        let request = v1::StreamLogsRequest { follow: true, ..of_job(&job) };
        let mut stream = cluster.jobs().stream_logs(request).await.unwrap().into_inner();
        tokio::spawn(async move {
            let mut entries = Vec::new();
            while let Some(entry) = stream.message().await.unwrap() {
                entries.push(entry);
            }
            entries
        })
    };
    let worker = cluster.worker(FakeTrainer::fails_once());
    let done = cluster.finished(&job).await;
    worker.leave().await;
    let followed = tokio::time::timeout(Duration::from_secs(20), follower).await.unwrap().unwrap();
    let all = cluster.logs(of_job(&job)).await;
    assert_eq!(followed, all, "a follower saw other lines");
    assert!(all.windows(2).all(|pair| pair[0].number < pair[1].number));
    for task in &done.tasks {
        let of_task: Vec<_> = all.iter().filter(|entry| entry.task_id == task.task_id).collect();
        let says = |text: &str| of_task.iter().any(|entry| entry.message.starts_with(text));
        assert!(says("task taken") && says("task done"), "{}: {of_task:#?}", task.task_id);
        assert!(of_task.iter().all(|entry| entry.worker == task.worker));
    }
    assert!(all.iter().any(|entry| entry.message.starts_with("a virtual trainer begins")));
    assert!(!all.iter().any(|entry| entry.message.contains("t0p-secret")), "a secret is in the log");
    // The lines of the failed attempt alone.
    let errors = v1::StreamLogsRequest { min_severity: LogSeverity::Error.into(), ..of_job(&job) };
    let failures = cluster.logs(errors).await;
    assert_eq!(failures.len(), 1, "{failures:#?}");
    assert!(failures[0].message.contains("virtual fault") && failures[0].attempt == 1);
    let of_attempt = v1::StreamLogsRequest {
        task_id: failures[0].task_id.clone(),
        attempt: 2,
        after_number: failures[0].number,
        ..of_job(&job)
    };
    let second = cluster.logs(of_attempt).await;
    assert!(!second.is_empty() && second.iter().all(|entry| entry.attempt == 2));

    cluster.restart().await;
    assert_eq!(cluster.logs(of_job(&job)).await, all, "a restart lost lines");
    let after = v1::StreamLogsRequest { after_number: all[4].number, ..of_job(&job) };
    assert_eq!(cluster.logs(after).await, all[5..]);
    cluster.jobs().delete_job(v1::DeleteJobRequest { job_id: job.clone() }).await.unwrap();
    let gone = cluster.jobs().stream_logs(of_job(&job)).await.unwrap_err();
    assert_eq!(reason_of(&gone), "JOB_NOT_FOUND");
    assert!(!cluster.dir.path().join("data/logs").join(&job).exists(), "a deleted job left its log");
}

/// A hand-driven worker with a lease on a job's only partition.
async fn lease_by_hand(
    cluster: &TestCluster,
    name: &str,
) -> (WorkerServiceClient<Connection>, worker_v1::Lease) {
    let mut worker = WorkerServiceClient::new(Dial::to(&cluster.url()).lazily().unwrap());
    worker.register(registration(name)).await.unwrap();
    let claim = worker_v1::ClaimRequest {
        incarnation: incarnation_of(name),
        request_id: format!("claim of {name}"),
        wait_ms: 20_000,
    };
    let since = Instant::now();
    loop {
        let granted = worker.claim(claim.clone()).await.unwrap().into_inner().assignment;
        if let Some(assignment) = granted {
            return (worker, assignment.lease.unwrap());
        }
        assert!(since.elapsed() < Duration::from_secs(60), "no task");
    }
}

fn line(number: u64, message: &str) -> worker_v1::LogLine {
    let severity = LogSeverity::Info.into();
    worker_v1::LogLine { number, time: None, severity, message: message.into() }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn late_log_lines_are_stored_once_under_their_own_lease() {
    let cluster = TestCluster::start().await;
    let job = cluster.submit("by hand", 1).await;
    let (mut worker, lease) = lease_by_hand(&cluster, "first").await;
    let append = async |worker: &mut WorkerServiceClient<Connection>, lease: &worker_v1::Lease, lines| {
        let request = worker_v1::AppendLogsRequest { lease: Some(lease.clone()), lines };
        worker.append_logs(request).await.map(drop).map_err(|status| reason_of(&status))
    };
    let hostile = "Authorization: Bearer abc123 \u{1b}[2J".to_owned() + &"x".repeat(10_000);
    let lines = || vec![line(1, "one"), line(2, &hostile)];
    for _ in 0..2 {
        append(&mut worker, &lease, lines()).await.unwrap();
    }
    let messages = async || {
        let entries = cluster.logs(of_job(&job)).await;
        let own: Vec<_> = entries.into_iter().filter(|entry| entry.worker == "first").collect();
        own.into_iter().map(|entry| entry.message).collect::<Vec<_>>()
    };
    let kept = messages().await;
    assert_eq!((kept.len(), kept[0].as_str()), (2, "one"));
    assert!(
        kept[1].len() <= 4096 && !kept[1].contains("abc123") && !kept[1].contains('\u{1b}'),
        "{}",
        kept[1]
    );

    for (wrong, reason) in [
        (worker_v1::Lease { fence: lease.fence + 1, ..lease.clone() }, "STALE_FENCE"),
        (worker_v1::Lease { attempt: 7, ..lease.clone() }, "STALE_FENCE"),
        (worker_v1::Lease { fence: 0, attempt: 0, task_id: "merge".into(), ..lease.clone() }, "STALE_FENCE"),
        (worker_v1::Lease { task_id: "partition-0099".into(), ..lease.clone() }, "TASK_NOT_FOUND"),
        (worker_v1::Lease { job_id: "0".repeat(20), ..lease.clone() }, "JOB_NOT_FOUND"),
        (worker_v1::Lease { task_id: "../../x".into(), ..lease.clone() }, "BAD_ARGUMENT"),
    ] {
        assert_eq!(append(&mut worker, &wrong, lines()).await, Err(reason.to_owned()), "{wrong:?}");
    }
    let many = (1..=257).map(|number| line(number, "x")).collect();
    assert_eq!(append(&mut worker, &lease, many).await, Err("BAD_ARGUMENT".to_owned()));
    assert_eq!(append(&mut worker, &lease, vec![line(0, "x")]).await, Err("BAD_ARGUMENT".to_owned()));

    // Its last lines arrive after another worker has the task, and after the job has ended.
    let release = worker_v1::ReleaseRequest { lease: Some(lease.clone()), reason: "leaves".into() };
    worker.release(release).await.unwrap();
    append(&mut worker, &lease, vec![line(2, "again"), line(3, "after the release")]).await.unwrap();
    let (mut successor, second) = lease_by_hand(&cluster, "second").await;
    append(&mut worker, &lease, vec![line(4, "after the next grant")]).await.unwrap();
    append(&mut successor, &second, vec![line(1, "of the successor")]).await.unwrap();
    let cancel = v1::CancelJobRequest { job_id: job.clone(), reason: String::new() };
    cluster.jobs().cancel_job(cancel).await.unwrap();
    append(&mut successor, &second, vec![line(2, "after the end")]).await.unwrap();
    assert_eq!(messages().await[2..], ["after the release", "after the next grant"]);
    let of_successor = v1::StreamLogsRequest { attempt: 2, task_id: lease.task_id.clone(), ..of_job(&job) };
    let of_successor: Vec<String> =
        cluster.logs(of_successor).await.into_iter().map(|entry| entry.message).collect();
    assert_eq!(of_successor, ["of the successor", "after the end"]);
}

/// Names of metrics in a text, without the endings that a histogram or a counter gives its series.
fn metrics_in(text: &str) -> BTreeSet<String> {
    let is_part = |c: char| c.is_ascii_lowercase() || c == '_';
    let names = text.split(|c: char| !is_part(c)).filter(|word| word.starts_with("fathom_"));
    let plain = |name: &str| {
        let ends = ["_bucket", "_sum", "_count", "_total"];
        ends.iter().find_map(|end| name.strip_suffix(end)).unwrap_or(name).to_owned()
    };
    names.map(plain).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_metric_has_its_line_and_dashboards_name_no_others() {
    let read = |file: &str| {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(file);
        std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{file}: {error}"))
    };
    let documented = metrics_in(&read("docs/operating/metrics.md"));
    for file in ["deploy/grafana-dashboard.json", "deploy/prometheus-alerts.yaml"] {
        let named = metrics_in(&read(file));
        assert!(named.len() > 5, "{file} names {named:?}");
        let unknown: Vec<_> = named.difference(&documented).collect();
        assert!(unknown.is_empty(), "{file} names {unknown:?}, which docs/operating/metrics.md lacks");
    }
    serde_json::from_str::<serde_json::Value>(&read("deploy/grafana-dashboard.json")).expect("JSON");

    let cluster = TestCluster::start().await;
    let at = free_address();
    let _worker = cluster.worker_with_metrics(FakeTrainer::quick(), Some(at));
    let job = cluster.submit("all metrics", 2).await;
    cluster.finished(&job).await;
    let pages = cluster.page("/metrics").await.1 + &page(at, "/metrics").await.1;
    let served: BTreeSet<String> = pages
        .lines()
        .filter_map(|line| line.strip_prefix("# TYPE ")?.split(' ').next())
        .flat_map(metrics_in)
        .collect();
    assert!(served.len() > 20, "{served:?}");
    let undocumented: Vec<_> = served.difference(&documented).collect();
    assert!(undocumented.is_empty(), "docs/operating/metrics.md lacks {undocumented:?}");
}
