//! The scaler as KEDA uses it: a double of KEDA's loop over a ScaledJob starts workers that end when idle.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use fathom_proto::dial::{Connection, Dial};
use fathom_proto::keda::external_scaler_client::ExternalScalerClient;
use fathom_proto::keda::{GetMetricsRequest, ScaledObjectRef};
use fathom_proto::v1;
use fathom_worker::{IdleLimit, OnGpu, WorkerConfig};
use tokio::io::AsyncReadExt as _;
use tokio::net::TcpStream;
use tonic::Code;

use crate::access::Authority;
use crate::support::{FakeTrainer, RunningWorker, TestCluster};

/// The most jobs of the double at a time (maxReplicaCount). With fewer than twice the tasks, `accurate` would
/// fill up to it: KEDA then does not subtract the pending ones.
const MOST: usize = 30;

fn served(config: &mut fathom_coordinator::CoordinatorConfig) {
    config.scaler_listen = Some(([127, 0, 0, 1], 0).into());
}

fn object(metadata: &[(&str, &str)]) -> ScaledObjectRef {
    let metadata = metadata.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
    ScaledObjectRef {
        name: "workers".into(),
        namespace: "fathom".into(),
        scaler_metadata: metadata.collect::<HashMap<_, _>>(),
    }
}

type Client = ExternalScalerClient<Connection>;

fn client(cluster: &TestCluster) -> Client {
    let url = format!("http://{}", cluster.scaler_address());
    ExternalScalerClient::new(Dial::to(&url).lazily().unwrap())
}

/// What KEDA computes from its answers: the number of workers that are wanted, and whether there is work. A
/// ScaledJob takes the first metric alone, and its target.
async fn asked(client: &mut Client, object: &ScaledObjectRef) -> (usize, bool) {
    let spec = client.get_metric_spec(object.clone()).await.unwrap().into_inner().metric_specs;
    assert_eq!(spec.len(), 1);
    let name = spec[0].metric_name.clone();
    assert!(name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'-'), "{name}");
    assert!(spec[0].target_size > 0 && spec[0].target_size_float == spec[0].target_size as f64);
    let request = GetMetricsRequest { scaled_object_ref: Some(object.clone()), metric_name: name.clone() };
    let values = client.get_metrics(request).await.unwrap().into_inner().metric_values;
    assert_eq!((values.len(), values[0].metric_name.as_str()), (1, name.as_str()));
    assert_eq!(values[0].metric_value as f64, values[0].metric_value_float);
    let is_active = client.is_active(object.clone()).await.unwrap().into_inner().result;
    let wanted = (values[0].metric_value_float / spec[0].target_size_float).ceil() as usize;
    (wanted.min(MOST), is_active)
}

/// A double of KEDA and Kubernetes. A job is pending for two polls, then its worker runs until it ends.
struct Keda {
    is_accurate: bool,
    pending: Vec<u32>,
    running: Vec<RunningWorker>,
    started: usize,
    most: usize,
}

impl Keda {
    /// One poll (KEDA's `scale_jobs.go`): jobs to create, by its strategies `default` and `accurate`.
    fn to_create(&self, wanted: usize) -> usize {
        let running = self.running.len() + self.pending.len();
        match self.is_accurate {
            false => wanted.saturating_sub(running),
            true if wanted + running > MOST => MOST.saturating_sub(running),
            true => wanted.saturating_sub(self.pending.len()),
        }
    }

    async fn poll(&mut self, wanted: usize, start: impl Fn() -> RunningWorker) {
        self.running.retain(|worker| !worker.has_ended());
        let created = self.to_create(wanted);
        self.started += created;
        self.pending.extend(vec![2; created]);
        for wait in &mut self.pending {
            *wait -= 1;
        }
        let ready = self.pending.iter().filter(|wait| **wait == 0).count();
        self.pending.retain(|wait| *wait > 0);
        self.running.extend((0..ready).map(|_| start()));
        self.most = self.most.max(self.running.len() + self.pending.len());
    }
}

async fn from_zero_to_twelve_and_back(strategy: &str, count: &str) {
    let cluster = TestCluster::with(served).await;
    let trainer = FakeTrainer::slow();
    let start = || {
        let config = WorkerConfig {
            exit_when_idle: Some(IdleLimit(Duration::from_secs(2))),
            ..cluster.worker_settings(&cluster.url(), "started by KEDA")
        };
        TestCluster::start_worker(config, vec![OnGpu { number: 0, executor: Arc::clone(&trainer) as _ }])
    };
    let is_accurate = strategy == "accurate";
    let mut keda = Keda { is_accurate, pending: Vec::new(), running: Vec::new(), started: 0, most: 0 };
    let (mut client, object) = (client(&cluster), object(&[("count", count)]));
    assert_eq!(asked(&mut client, &object).await, (0, false), "work where there is none");

    let job = cluster.submit(strategy, 12).await;
    let mut most_wanted = 0;
    let begin = std::time::Instant::now();
    while cluster.get(&job).await.state() != v1::JobState::Succeeded || !keda.running.is_empty() {
        assert!(begin.elapsed() < Duration::from_secs(180), "{strategy}: the job does not end");
        let (wanted, _) = asked(&mut client, &object).await;
        most_wanted = most_wanted.max(wanted);
        keda.poll(wanted, start).await;
        // Much longer than a worker takes from its start to its claim, as KEDA's 30 seconds are.
        tokio::time::sleep(Duration::from_secs(3)).await;
    }
    // The worker of the coarse model still waits for work when the partitions come, and takes one of them.
    let expected = if is_accurate { 11..=12 } else { 12..=12 };
    assert!(
        expected.contains(&most_wanted),
        "{strategy}: {most_wanted} workers are wanted for 12 partitions"
    );
    assert!((11..=13).contains(&keda.most), "{strategy}: {} workers at a time", keda.most);
    assert!(
        keda.started <= 14,
        "{strategy}: {} workers for 12 partitions and one coarse model",
        keda.started
    );
    assert_eq!(asked(&mut client, &object).await, (0, false), "{strategy}: back to zero");
    assert_eq!(trainer.running.load(Ordering::SeqCst), 0);
    let tasks = cluster.get(&job).await.tasks;
    assert_eq!(tasks.iter().map(|task| task.losses + task.errors).sum::<u32>(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_default_strategy_scales_to_the_demand_and_back() {
    from_zero_to_twelve_and_back("default", "demand").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_accurate_strategy_scales_to_the_backlog_and_back() {
    from_zero_to_twelve_and_back("accurate", "backlog").await;
}

#[tokio::test]
async fn faults_of_a_trigger_are_named_and_streams_say_changes() {
    let cluster = TestCluster::with(served).await;
    let mut client = client(&cluster);
    let refused = client.get_metric_spec(object(&[("tasksPerWorker", "none")])).await.unwrap_err();
    assert_eq!(refused.code(), Code::InvalidArgument);
    assert!(refused.message().contains("tasksPerWorker is \"none\""), "{refused}");

    let mut stream = client.stream_is_active(object(&[])).await.unwrap().into_inner();
    assert!(!stream.message().await.unwrap().unwrap().result);
    let job = cluster.submit("active", 1).await;
    assert!(stream.message().await.unwrap().unwrap().result, "the coarse model waits");
    cluster.jobs().pause_job(v1::PauseJobRequest { job_id: job, ..Default::default() }).await.unwrap();
    assert!(!stream.message().await.unwrap().unwrap().result, "a paused job needs no worker");
}

#[tokio::test]
async fn keda_shows_a_certificate_of_its_own_authority() {
    let dir = tempfile::tempdir().unwrap();
    let (ours, kedas) = (Authority::new(dir.path(), "ours"), Authority::new(dir.path(), "keda"));
    let (server, keda, stranger) = (ours.certify("server"), kedas.certify("keda"), ours.certify("a worker"));
    let config = fathom_coordinator::CoordinatorConfig {
        data_dir: dir.path().join("data"),
        listen: ([127, 0, 0, 1], 0).into(),
        scaler_listen: Some(([127, 0, 0, 1], 0).into()),
        tls_cert: Some(server.0),
        tls_key: Some(server.1),
        scaler_client_ca: Some(kedas.ca()),
        ..Default::default()
    };
    let coordinator = fathom_coordinator::serve(config).await.unwrap();
    let url = format!("https://{}", coordinator.scaler_address().unwrap());
    let ask = |identity| {
        let dial = Dial { tls_ca: Some(ours.ca()), tls_identity: identity, ..Dial::to(&url) };
        async move { ExternalScalerClient::new(dial.lazily().unwrap()).is_active(object(&[])).await }
    };
    // Silent connections are no obstacle to those that speak.
    let mut silent = Vec::new();
    for _ in 0..100 {
        silent.push(TcpStream::connect(coordinator.scaler_address().unwrap()).await.unwrap());
    }
    assert!(!ask(Some(keda)).await.unwrap().into_inner().result);
    assert!(ask(None).await.is_err(), "without a certificate");
    assert!(ask(Some(stranger)).await.is_err(), "with a certificate of another authority");
    let mut byte = [0];
    let cut_off = tokio::time::timeout(Duration::from_secs(30), silent[99].read(&mut byte)).await;
    assert!(matches!(cut_off, Ok(Ok(0) | Err(_))), "a silent connection stays open");
    coordinator.stop().await.unwrap();
}
