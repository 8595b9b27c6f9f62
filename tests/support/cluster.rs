//! A coordinator in this process, a small scene, and workers whose trainer needs no GPU.
#![allow(dead_code, reason = "each test program uses a part of this file")]

mod fake_trainer;

use bytes::Bytes;
use fathom_coordinator::objects::Removed;
use fathom_coordinator::retention::Policy;
use fathom_coordinator::{Coordinator, CoordinatorConfig, serve};
use fathom_core::config::JobConfig;
use fathom_core::picture::encode_png;
use fathom_core::scene::{Camera, CameraModel, Manifest, ManifestView, Points, Pose};
use fathom_proto::admin::v1 as admin_v1;
use fathom_proto::admin::v1::admin_service_client::AdminServiceClient;
use fathom_proto::dial::{Connection, Dial};
use fathom_proto::v1;
use fathom_proto::v1::job_service_client::JobServiceClient;
use fathom_proto::v1::upload_service_client::UploadServiceClient;
use fathom_proto::worker::v1 as worker_v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use fathom_worker::blobs::{BlobClient, BlobSource, to_proto};
use fathom_worker::execute::Executor;
use fathom_worker::{OnGpu, WorkerConfig, WorkerError, run_on};
use glam::DVec3;
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tonic::transport::Channel;
use tonic_types::StatusExt as _;

pub use fake_trainer::*;

/// Points of the scene.
pub const POINTS: usize = 400;
/// Renewals are four times as frequent: on a busy machine a thread may stall for a second.
const LEASE_MS: u32 = 4000;
/// Longest wait in these tests.
const PATIENCE: Duration = Duration::from_secs(60);

/// A coordinator with an uploaded scene.
pub struct TestCluster {
    pub dir: tempfile::TempDir,
    pub manifest: Manifest,
    coordinator: Option<Coordinator>,
    config: CoordinatorConfig,
    channel: Connection,
}

impl TestCluster {
    pub async fn start() -> Self {
        Self::with(|_| {}).await
    }

    /// The same with another configuration of the coordinator.
    pub async fn with(change: impl FnOnce(&mut CoordinatorConfig)) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut config = CoordinatorConfig {
            data_dir: dir.path().join("data"),
            listen: ([127, 0, 0, 1], 0).into(),
            lease_ms: LEASE_MS,
            backoff_ms: 50,
            min_free_bytes: 0,
            metrics_listen: Some(([127, 0, 0, 1], 0).into()),
            ..CoordinatorConfig::default()
        };
        change(&mut config);
        let coordinator = serve(config.clone()).await.unwrap();
        config.listen = coordinator.address();
        config.web = coordinator.web_address();
        let channel = Dial::to(&coordinator.url()).lazily().unwrap();
        let manifest = upload_scene(&BlobClient::new(channel.clone())).await;
        Self { dir, manifest, coordinator: Some(coordinator), config, channel }
    }

    pub fn address(&self) -> SocketAddr {
        self.config.listen
    }

    pub fn url(&self) -> String {
        format!("http://{}", self.address())
    }

    pub fn jobs(&self) -> JobServiceClient<Connection> {
        JobServiceClient::new(self.channel.clone())
    }

    pub fn uploads(&self) -> UploadServiceClient<Connection> {
        UploadServiceClient::new(self.channel.clone())
    }

    /// Where the coordinator serves KEDA.
    pub fn scaler_address(&self) -> SocketAddr {
        self.coordinator.as_ref().unwrap().scaler_address().unwrap()
    }

    /// Where the coordinator serves the HTTP interface.
    pub fn web_address(&self) -> SocketAddr {
        self.coordinator.as_ref().unwrap().web_address().unwrap()
    }

    /// A response of the coordinator over HTTP.
    pub async fn page(&self, path: &str) -> (u16, String) {
        page(self.coordinator.as_ref().unwrap().metrics_address().unwrap(), path).await
    }

    pub fn admin(&self) -> AdminServiceClient<Connection> {
        AdminServiceClient::new(self.channel.clone())
    }

    pub async fn workers(&self) -> Vec<admin_v1::Worker> {
        self.admin().list_workers(admin_v1::ListWorkersRequest {}).await.unwrap().into_inner().workers
    }

    pub async fn collect(&self, policy: Policy) -> Removed {
        self.coordinator.as_ref().unwrap().collect(policy).await.unwrap()
    }

    pub fn blobs(&self) -> BlobClient {
        BlobClient::new(self.channel.clone())
    }

    /// Stops the coordinator and starts another on the same directory and port.
    pub async fn restart(&mut self) {
        self.coordinator.take().unwrap().stop().await.unwrap();
        self.coordinator = Some(serve(self.config.clone()).await.unwrap());
    }

    pub async fn request(&self, name: &str, columns: u32) -> v1::CreateJobRequest {
        self.request_for(&self.manifest, name, columns).await
    }

    pub async fn request_for(&self, manifest: &Manifest, name: &str, columns: u32) -> v1::CreateJobRequest {
        let mut config = JobConfig::default();
        config.partition.columns = columns;
        config.data.test_every = 5;
        config.train.iterations = 400;
        self.request_with(manifest, name, &config).await
    }

    pub async fn request_with(
        &self,
        manifest: &Manifest,
        name: &str,
        config: &JobConfig,
    ) -> v1::CreateJobRequest {
        let json = Bytes::from(serde_json::to_vec(manifest).unwrap());
        let manifest = self.blobs().upload(&BlobSource::Bytes(json)).await.unwrap();
        v1::CreateJobRequest {
            request_id: format!("request of {name}"),
            name: name.into(),
            config_json: serde_json::to_string(config).unwrap(),
            manifest: Some(to_proto(&manifest)),
            ingest_seconds: 0.25,
            priority: 0,
            max_parallel: 0,
            dataset_id: String::new(),
        }
    }

    pub async fn submit(&self, name: &str, columns: u32) -> String {
        let request = self.request(name, columns).await;
        self.jobs().create_job(request).await.unwrap().into_inner().job_id
    }

    pub async fn get(&self, job_id: &str) -> v1::Job {
        self.jobs().get_job(v1::GetJobRequest { job_id: job_id.into() }).await.unwrap().into_inner()
    }

    pub async fn wait_for(&self, job_id: &str, holds: impl Fn(&v1::Job) -> bool) -> v1::Job {
        let since = Instant::now();
        loop {
            let job = self.get(job_id).await;
            if holds(&job) {
                return job;
            }
            assert!(since.elapsed() < PATIENCE, "waited in vain: {job:#?}");
            tokio::time::sleep(Duration::from_millis(30)).await;
        }
    }

    pub async fn finished(&self, job_id: &str) -> v1::Job {
        use v1::JobState::{Paused, Running};
        self.wait_for(job_id, |job| !matches!(job.state(), Running | Paused)).await
    }

    pub async fn events(&self, job_id: &str, after_seq: u64) -> Vec<v1::JobEvent> {
        let request = v1::WatchJobRequest { job_id: job_id.into(), after_seq };
        let mut stream = self.jobs().watch_job(request).await.unwrap().into_inner();
        let mut events = Vec::new();
        while let Some(event) = stream.message().await.unwrap() {
            events.push(event);
        }
        events
    }

    pub async fn artifacts(&self, job_id: &str) -> BTreeMap<String, Vec<u8>> {
        let mut files = BTreeMap::new();
        for (index, artifact) in self.list_artifacts(job_id, 0).await.concat().into_iter().enumerate() {
            let target = self.dir.path().join(format!("artifact-{job_id}-{index}"));
            let blob = fathom_worker::blobs::from_proto(artifact.blob.unwrap());
            self.blobs().download(&blob, &target).await.unwrap();
            files.insert(artifact.path, std::fs::read(target).unwrap());
        }
        files
    }

    /// The pages of a job's artifacts.
    pub async fn list_artifacts(&self, job_id: &str, page_size: u32) -> Vec<Vec<v1::Artifact>> {
        let mut request = v1::ListArtifactsRequest { job_id: job_id.into(), page_size, ..Default::default() };
        let mut pages = Vec::new();
        loop {
            let page = self.jobs().list_artifacts(request.clone()).await.unwrap().into_inner();
            pages.push(page.artifacts);
            if page.next_page_token.is_empty() {
                return pages;
            }
            request.page_token = page.next_page_token;
        }
    }

    /// The log lines of a job that match a request.
    pub async fn logs(&self, request: v1::StreamLogsRequest) -> Vec<v1::LogEntry> {
        let mut stream = self.jobs().stream_logs(request).await.unwrap().into_inner();
        let mut entries = Vec::new();
        while let Some(entry) = stream.message().await.unwrap() {
            entries.push(entry);
        }
        entries
    }

    /// A registered worker whose calls the test makes itself, and its claim request.
    pub async fn worker_by_hand(
        &self,
        name: &str,
    ) -> (WorkerServiceClient<Channel>, worker_v1::ClaimRequest) {
        let mut worker = WorkerServiceClient::connect(self.url()).await.unwrap();
        let registration = registration(name);
        worker.register(registration.clone()).await.unwrap();
        let incarnation = registration.incarnation;
        (worker, worker_v1::ClaimRequest { incarnation, request_id: "once".into(), wait_ms: 30_000 })
    }

    pub fn worker(&self, trainer: Arc<impl Executor>) -> RunningWorker {
        self.worker_named("fake", trainer)
    }

    pub fn worker_named(&self, name: &str, trainer: Arc<impl Executor>) -> RunningWorker {
        self.worker_as(&self.url(), name, vec![OnGpu { number: 0, executor: trainer }], None)
    }

    /// The same with another address of the coordinator.
    pub fn worker_at(&self, url: &str, trainer: Arc<impl Executor>) -> RunningWorker {
        self.worker_as(url, "fake", vec![OnGpu { number: 0, executor: trainer }], None)
    }

    pub fn worker_with_metrics(
        &self,
        trainer: Arc<impl Executor>,
        metrics_listen: Option<SocketAddr>,
    ) -> RunningWorker {
        let gpus = vec![OnGpu { number: 0, executor: trainer }];
        self.worker_as(&self.url(), "fake", gpus, metrics_listen)
    }

    pub fn worker_on(&self, gpus: Vec<OnGpu>, metrics_listen: Option<SocketAddr>) -> RunningWorker {
        self.worker_as(&self.url(), "fake", gpus, metrics_listen)
    }

    fn worker_as(
        &self,
        url: &str,
        name: &str,
        gpus: Vec<OnGpu>,
        metrics_listen: Option<SocketAddr>,
    ) -> RunningWorker {
        let settings = WorkerConfig { metrics_listen, ..self.worker_settings(url, name) };
        Self::start_worker(settings, gpus)
    }

    /// Settings of a worker with its cache beside the coordinator's data.
    pub fn worker_settings(&self, url: &str, name: &str) -> WorkerConfig {
        WorkerConfig {
            coordinator: Dial::to(url),
            name: name.into(),
            cache_dir: self.dir.path().join("cache"),
            ..WorkerConfig::default()
        }
    }

    pub fn start_worker(config: WorkerConfig, gpus: Vec<OnGpu>) -> RunningWorker {
        let (stop, stopping) = watch::channel(false);
        RunningWorker { stop, running: tokio::spawn(run_on(config, gpus, stopping)) }
    }
}

/// Fetches a page over HTTP: status and text.
pub async fn page(address: SocketAddr, path: &str) -> (u16, String) {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    let mut stream = tokio::net::TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    let (head, text) = answer.split_once("\r\n\r\n").unwrap();
    (head.split(' ').nth(1).unwrap().parse().unwrap(), text.to_owned())
}

pub struct RunningWorker {
    stop: watch::Sender<bool>,
    running: JoinHandle<Result<(), WorkerError>>,
}

impl RunningWorker {
    /// The worker falls silent at once, including its heartbeat.
    pub fn kill(self) {
        self.running.abort();
    }

    pub async fn leave(self) {
        self.stop.send_replace(true);
        self.ended().await.unwrap();
    }

    pub fn ask_to_leave(&self) {
        self.stop.send_replace(true);
    }

    pub fn has_ended(&self) -> bool {
        self.running.is_finished()
    }

    pub async fn ended(self) -> Result<(), WorkerError> {
        tokio::time::timeout(PATIENCE, self.running).await.unwrap().unwrap()
    }
}

async fn upload_scene(blobs: &BlobClient) -> Manifest {
    let mut points = Points::default();
    for index in 0..POINTS {
        let (x, z) = ((index % 20) as f32 / 2.0, (index / 20) as f32 / 2.0);
        points.positions.push([x - 4.75, (index % 3) as f32 * 0.1, z - 4.75]);
        points.colours.push([120, 130, 140]);
    }
    let upload = async |bytes: Vec<u8>| blobs.upload(&BlobSource::Bytes(bytes.into())).await.unwrap();
    let mut views = Vec::new();
    for index in 0..16_u32 {
        let (column, row) = (f64::from(index % 4), f64::from(index / 4));
        // Rows are offset, so that only one camera is on the border of a cell.
        let eye = DVec3::new(column * 3.0 - 4.5 + row * 0.1, -6.0, row * 3.0 - 4.5);
        views.push(ManifestView {
            name: format!("view_{index:02}.png"),
            camera_id: 1,
            pose: Pose::looking_at(eye, eye + DVec3::new(0.0, 1.0, 0.6), DVec3::Y),
            image: upload(encode_png(64, 48, &[100 + index as u8; 64 * 48 * 3]).unwrap()).await,
            mask: None,
        });
    }
    let camera = Camera {
        id: 1,
        model: CameraModel::Pinhole,
        width: 64,
        height: 48,
        params: vec![50.0, 50.0, 32.0, 24.0],
    };
    Manifest {
        format: 1,
        source: "test".into(),
        cameras: vec![camera],
        views,
        points: upload(points.to_bytes()).await,
    }
}

/// The incarnation of a hand-driven worker.
pub fn incarnation_of(name: &str) -> String {
    let digest = blake3::hash(name.as_bytes());
    uuid::Builder::from_random_bytes(std::array::from_fn(|i| digest.as_bytes()[i])).into_uuid().to_string()
}

pub fn registration(name: &str) -> worker_v1::RegisterRequest {
    worker_v1::RegisterRequest {
        worker_name: name.into(),
        incarnation: incarnation_of(name),
        build_version: "test".into(),
        protocol_version: fathom_proto::WORKER_PROTOCOL_VERSION,
        capabilities: Some(FakeTrainer::quick().capabilities()),
        held: Vec::new(),
    }
}

/// A loopback address that was free a moment ago.
pub fn free_address() -> SocketAddr {
    std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap()
}

pub fn reason_of(status: &tonic::Status) -> String {
    status.get_details_error_info().map(|info| info.reason).unwrap_or_default()
}

pub fn is_durable(event: &v1::JobEvent) -> bool {
    use v1::job_event::Event;
    !matches!(event.event, Some(Event::Progress(_) | Event::KeepAlive(_)))
}
