//! A coordinator, a small scene and workers with a trainer that needs no GPU.
#![allow(dead_code, reason = "each test file uses a part of this one")]

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use fathom_coordinator::objects::Removed;
use fathom_coordinator::retention::Policy;
use fathom_coordinator::{Coordinator, CoordinatorConfig, serve};
use fathom_core::CoreError;
use fathom_core::config::{Composition, JobConfig, WaterPartitions};
use fathom_core::exchange::Exchange;
use fathom_core::gaussians::Gaussians;
use fathom_core::picture::encode_png;
use fathom_core::ply;
use fathom_core::scene::{BlobRef, Camera, CameraModel, Manifest, ManifestView, Points, Pose};
use fathom_core::water::{StandardErrors, Water, WaterRecord};
use fathom_proto::admin::v1 as admin_v1;
use fathom_proto::admin::v1::admin_service_client::AdminServiceClient;
use fathom_proto::dial::{Dial, Line};
use fathom_proto::v1;
use fathom_proto::v1::job_service_client::JobServiceClient;
use fathom_proto::v1::upload_service_client::UploadServiceClient;
use fathom_proto::worker::v1 as worker_v1;
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use fathom_worker::blobs::{BlobClient, BlobSource, to_proto};
use fathom_worker::execute::{Control, Executor, Stop, TaskError, TaskInput, TaskOutput};
use fathom_worker::{OnGpu, WorkerConfig, WorkerError, run_on};
use glam::{DQuat, DVec3};
use prost::Message;
use serde_json::{Value, json};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tonic::transport::Channel;
use tonic_types::StatusExt;

/// Points of the scene.
pub const POINTS: usize = 400;
/// Renewed four times as often: on a busy machine a thread may stand still for a second.
const LEASE_MS: u32 = 4000;
/// No wait in these tests is longer.
const PATIENCE: Duration = Duration::from_secs(60);

/// A coordinator with an uploaded scene.
pub struct Bench {
    pub dir: tempfile::TempDir,
    pub manifest: Manifest,
    coordinator: Option<Coordinator>,
    config: CoordinatorConfig,
    channel: Line,
}

impl Bench {
    pub async fn start() -> Self {
        Self::with(|_| {}).await
    }

    /// One whose coordinator is set up otherwise.
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

    pub fn jobs(&self) -> JobServiceClient<Line> {
        JobServiceClient::new(self.channel.clone())
    }

    pub fn uploads(&self) -> UploadServiceClient<Line> {
        UploadServiceClient::new(self.channel.clone())
    }

    /// What the coordinator answers over HTTP.
    pub async fn page(&self, path: &str) -> (u16, String) {
        page(self.coordinator.as_ref().unwrap().metrics_address().unwrap(), path).await
    }

    pub fn admin(&self) -> AdminServiceClient<Line> {
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

    /// The lines of a job that a request admits.
    pub async fn logs(&self, request: v1::StreamLogsRequest) -> Vec<v1::LogEntry> {
        let mut stream = self.jobs().stream_logs(request).await.unwrap().into_inner();
        let mut entries = Vec::new();
        while let Some(entry) = stream.message().await.unwrap() {
            entries.push(entry);
        }
        entries
    }

    /// A worker whose calls a test makes by itself, registered, and what it claims a task with.
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

    /// One that reaches the coordinator another way.
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
        let config = WorkerConfig {
            metrics_listen,
            coordinator: Dial::to(url),
            name: name.into(),
            cache_dir: self.dir.path().join("cache"),
            ..WorkerConfig::default()
        };
        let (stop, stopping) = watch::channel(false);
        RunningWorker { stop, running: tokio::spawn(run_on(config, gpus, stopping)) }
    }
}

/// A page over HTTP: its status and its text.
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
    /// Silence from one moment to the next, heartbeat and all.
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
        // Rows are shifted against each other, so that one camera alone stands on the border of a cell.
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

/// The incarnation of a worker that is played by hand.
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

pub fn reason_of(status: &tonic::Status) -> String {
    status.get_details_error_info().map(|info| info.reason).unwrap_or_default()
}

pub fn is_durable(event: &v1::JobEvent) -> bool {
    use v1::job_event::Event;
    !matches!(event.event, Some(Event::Progress(_) | Event::KeepAlive(_)))
}

/// Trains by hashing: the state after an iteration is the hash of the state before it and its number.
pub struct FakeTrainer {
    pause: Duration,
    /// Pause between two looks at whether to stop, when it stands still after its first checkpoint.
    hangs: Option<Duration>,
    /// The only kind of task in which it does so.
    hangs_only_in: Option<v1::TaskKind>,
    failures_left: AtomicU32,
    /// Calls of `prepare` that still fail.
    pub unready: AtomicU32,
    /// Whether every task needs more memory than there is.
    too_small: bool,
    pub started: AtomicBool,
    /// Calls of `train` so far, those that run now, and the most that ever ran at once.
    pub calls: AtomicU32,
    pub running: AtomicU32,
    pub most_at_once: AtomicU32,
}

impl FakeTrainer {
    fn new(pause_ms: u64, hangs_ms: Option<u64>, failures: u32) -> Arc<Self> {
        Arc::new(Self::with(pause_ms, hangs_ms, failures))
    }

    fn with(pause_ms: u64, hangs_ms: Option<u64>, failures: u32) -> Self {
        Self {
            pause: Duration::from_millis(pause_ms),
            hangs: hangs_ms.map(Duration::from_millis),
            hangs_only_in: None,
            failures_left: AtomicU32::new(failures),
            started: AtomicBool::new(false),
            calls: AtomicU32::new(0),
            running: AtomicU32::new(0),
            most_at_once: AtomicU32::new(0),
            unready: AtomicU32::new(0),
            too_small: false,
        }
    }

    pub fn quick() -> Arc<Self> {
        Self::new(0, None, 0)
    }

    /// Takes longer than a lease, so it must be renewed.
    pub fn slow() -> Arc<Self> {
        Self::new(150, None, 0)
    }

    /// Stands still once its first checkpoint is handed over, until it is told to stop.
    pub fn hangs_after_checkpoint() -> Arc<Self> {
        Self::new(0, Some(10), 0)
    }

    /// The same, but only in tasks of one kind.
    pub fn hangs_in(kind: v1::TaskKind) -> Arc<Self> {
        Arc::new(Self { hangs_only_in: Some(kind), ..Self::with(0, Some(10), 0) })
    }

    /// The same, but it looks only twice a second whether to stop, as training does.
    pub fn hangs_and_looks_rarely() -> Arc<Self> {
        Self::new(0, Some(500), 0)
    }

    pub fn fails_once() -> Arc<Self> {
        Self::new(0, None, 1)
    }

    /// Is not ready to take a task before it was asked so many times.
    pub fn ready_after(times: u32) -> Arc<Self> {
        Arc::new(Self { unready: AtomicU32::new(times), ..Self::with(0, None, 0) })
    }

    /// Has no memory for any task.
    pub fn too_small() -> Arc<Self> {
        Arc::new(Self { too_small: true, ..Self::with(0, None, 0) })
    }

    fn train(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        let total = task.spec.own_iterations();
        assert!(total > 20, "{total} iterations are too few for these tests");
        let (mut iteration, mut state) = match (&task.checkpoint, &task.state) {
            (Some(path), _) => (task.checkpoint_iteration, read_state(path)),
            (None, Some(first)) => (0, read_state(first)),
            (None, None) => (0, *blake3::hash(&task.spec.encode_to_vec()).as_bytes()),
        };
        let hangs = self.hangs.filter(|_| self.hangs_only_in.is_none_or(|kind| kind == task.kind));
        let resumed_from = iteration;
        let mut handed_over = false;
        while iteration < total {
            match control.stop_reason() {
                Some(Stop::Abandon) => return Err(TaskError::Stopped { checkpoint: None }),
                Some(Stop::Leave | Stop::GiveBack) => {
                    let checkpoint = Some((Bytes::copy_from_slice(&state), iteration));
                    return Err(TaskError::Stopped { checkpoint });
                }
                None => {}
            }
            if let (Some(pause), true) = (hangs, handed_over) {
                std::thread::sleep(pause);
                continue;
            }
            for _ in 0..10.min(total - iteration) {
                iteration += 1;
                state = *blake3::keyed_hash(&state, &iteration.to_le_bytes()).as_bytes();
            }
            std::thread::sleep(self.pause);
            let progress =
                v1::Progress { iteration, iterations: total, gaussians: POINTS as u32, ..Default::default() };
            control.report(progress);
            if !handed_over && iteration * 10 >= total && iteration < total {
                control.checkpoint(Bytes::copy_from_slice(&state), iteration);
                handed_over = true;
            }
        }
        if task.kind == v1::TaskKind::Refine {
            let result = refined(task, control.upload(Bytes::copy_from_slice(&state))?);
            return Ok(TaskOutput {
                result,
                gaussians: POINTS as u32,
                resumed_from,
                held_out: Vec::new(),
                contributions: None,
            });
        }
        if task.kind == v1::TaskKind::Borders {
            let result = with_other_rows_in_the_band(task, &state)?;
            return Ok(TaskOutput {
                result,
                gaussians: POINTS as u32,
                resumed_from,
                held_out: Vec::new(),
                contributions: None,
            });
        }
        let points = match &task.global_model {
            Some(model) => ply::read_model(model)?.means,
            None => Points::from_bytes(&std::fs::read(task.file(&task.manifest.points)?).unwrap())?.positions,
        };
        let n = points.len();
        let model = Gaussians {
            sh_degree: 0,
            means: points,
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            log_scales: vec![[-2.0; 3]; n],
            opacity_logits: (0..n).map(|i| f32::from(state[i % 32]) / 64.0).collect(),
            sh_coeffs: vec![[0.1, 0.2, 0.3]; n],
        };
        Ok(TaskOutput {
            result: ply::to_bytes(&model, &comments(task))?.into(),
            gaussians: n as u32,
            resumed_from,
            held_out: Vec::new(),
            contributions: contributions(task, control)?,
        })
    }

    fn evaluate(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        let model = ply::read_model(task.merged_model.as_ref().unwrap())?;
        let mut views = Vec::new();
        for &index in &task.spec.views {
            let name = task.manifest.views[index as usize].name.clone();
            let png = control.upload(Bytes::from(format!("the render of {name}")))?;
            let border = control.upload(Bytes::from(format!("the borders of {name}")))?;
            views.push(worker_v1::ViewMetrics {
                name,
                psnr_db: 20.0 + f64::from(index),
                ssim: 0.9,
                side_by_side: Some(to_proto(&png)),
                border: task.spec.seams.is_some().then(|| to_proto(&border)),
            });
        }
        let seams_json =
            task.spec.seams.as_ref().map_or_else(String::new, |lines| seams_of(lines, views.len()));
        let gaussians = model.len() as u32;
        let cover_json = cover_of(views.len());
        let adapter = "fake".into();
        let evaluation = worker_v1::Evaluation {
            format: 1,
            views,
            gaussians,
            adapter,
            seams_json,
            cover_json,
            clear_gains: Vec::new(),
        };
        Ok(TaskOutput {
            result: evaluation.encode_to_vec().into(),
            gaussians,
            resumed_from: 0,
            held_out: Vec::new(),
            contributions: None,
        })
    }
}

/// What the views show of each partition, where the spec asks: the same of all for views of one parity, nothing for others.
fn contributions(task: &TaskInput, control: &dyn Control) -> Result<Option<BlobRef>, TaskError> {
    let (views, partitions) = (task.spec.views.clone(), task.spec.regions.len());
    if partitions == 0 {
        return Ok(None);
    }
    let share =
        |view: u32, partition: usize| if (view as usize + partition).is_multiple_of(2) { 0.5 } else { 0.0 };
    let shares = views.iter().flat_map(|&view| (0..partitions).map(move |k| share(view, k))).collect();
    let said = worker_v1::Contributions { format: 1, views, partitions: partitions as u32, shares };
    control.upload(Bytes::from(said.encode_to_vec())).map(Some)
}

/// What the fake evaluation says of borders: a band of as many pixels as there are lines.
fn seams_of(lines: &worker_v1::SeamLines, views: usize) -> String {
    let band = |psnr: f64, lines: &[worker_v1::SeamLine]| json!({ "views": views, "psnr": psnr, "interior_psnr": 30.0, "pixels": lines.len() });
    let steps = json!({ "pairs": 0, "beside_pairs": 0 });
    let of_view = |index: usize| json!({ "border_pixels": index, "border_psnr": 20.0 + index as f64 });
    json!({
        "band": lines.band,
        "border": band(27.0, &lines.borders),
        "control": band(28.0, &lines.controls),
        "interior": { "pixels": 0 },
        "seam_db": 1.0,
        "range_step": { "border": steps, "control": steps },
        "views": (0..views).map(of_view).collect::<Vec<_>>(),
    })
    .to_string()
}

/// What the fake evaluation says of cover: the first view has no holes, each after it a tenth more.
fn cover_of(views: usize) -> String {
    let of_view = |index: usize| json!({ "holes": 0.1 * index as f64, "open_water": null, "unseen": 0.25 });
    let views: Vec<Value> = (0..views).map(of_view).collect();
    json!({ "holes": 0.15, "open_water": null, "unseen": 0.25, "views": views }).to_string()
}

/// The water that the fake coarse model has.
pub fn coarse_water() -> WaterRecord {
    let acts = Composition::GaussiansSrgb;
    WaterRecord::new(&Water::COASTAL, acts, StandardErrors::from_array([1e-3; 9]), "descended", 0.0)
}

/// The water that a fake partition finds: the higher its number, the murkier, and the surer.
pub fn found_water(partition: u32) -> Water {
    let murkier = 1.0 + 0.1 * f64::from(partition + 1);
    Water { beta_d: Water::COASTAL.beta_d.map(|beta| murkier * beta), ..Water::COASTAL }
}

/// Evidence for `beta_d` alone.
fn refined(task: &TaskInput, state: BlobRef) -> Bytes {
    let Water { beta_d, beta_b, b_inf } = found_water(task.spec.partition);
    let weight = f64::from(task.spec.partition + 1);
    let refined = worker_v1::Refined {
        format: 1,
        partition: task.spec.partition,
        state: Some(to_proto(&state)),
        beta_d: beta_d.to_vec(),
        beta_b: beta_b.to_vec(),
        b_inf: b_inf.to_vec(),
        evidence: [[weight; 3], [0.0; 3], [0.0; 3]].concat(),
        unit: 1.0,
        rows: None,
    };
    refined.encode_to_vec().into()
}

/// The merged model, whose Gaussians in the band have opacities that follow from `state`.
fn with_other_rows_in_the_band(task: &TaskInput, state: &[u8; 32]) -> Result<Bytes, TaskError> {
    let mut model = std::fs::read(task.merged_model.as_ref().unwrap()).unwrap();
    let merged = ply::from_bytes(&model, "merged")?;
    // The scene's frame is the aligned one but for a turn about y, which the test of the plan is about.
    let is_near = |row: &usize| {
        task.spec.band.iter().any(|band| {
            let [w, x, y, z] = band.align_quat_wxyz[..] else { panic!("no quaternion") };
            let at = DQuat::from_xyzw(x, y, z, w) * DVec3::from(merged.means[*row].map(f64::from));
            at.x > band.min_x && at.x <= band.max_x && at.z > band.min_z && at.z <= band.max_z
        })
    };
    let rows: Vec<usize> = (0..merged.len()).filter(is_near).collect();
    let (mut band, _) = merged.split_where(|index| rows.contains(&index));
    for (index, logit) in band.opacity_logits.iter_mut().enumerate() {
        *logit = -1.0 - f32::from(state[index % 32]) / 64.0;
    }
    ply::replace_rows(&mut model, "merged", &rows, &band)?;
    Ok(model.into())
}

/// What the header of a model says: a water only where partitions refine it, since the fake knows none.
fn comments(task: &TaskInput) -> Vec<String> {
    let water = match (&task.consensus, task.config.water.partitions) {
        (Some(path), _) => {
            Exchange::from_json(&std::fs::read(path).unwrap()).unwrap().water.expect("no consensus").water
        }
        (None, WaterPartitions::Refine) => coarse_water(),
        (None, WaterPartitions::Frozen) => return Vec::new(),
    };
    vec![water.to_comment().unwrap()]
}

fn read_state(path: &Path) -> [u8; 32] {
    std::fs::read(path).unwrap().try_into().unwrap()
}

impl Executor for FakeTrainer {
    fn capabilities(&self) -> worker_v1::Capabilities {
        use v1::TaskKind::{Borders, Evaluate, Global, Partition, Refine};
        let kinds = [Global, Refine, Partition, Borders, Evaluate].map(Into::into).to_vec();
        worker_v1::Capabilities { kinds, adapter: "fake".into(), ..Default::default() }
    }

    fn prepare(&self) -> Result<(), TaskError> {
        match self.unready.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |left| left.checked_sub(1)) {
            Ok(_) => Err(CoreError::NoAdapter("no virtual adapter".into()).into()),
            Err(_) => Ok(()),
        }
    }

    fn execute(&self, task: &TaskInput, control: &dyn Control) -> Result<TaskOutput, TaskError> {
        self.started.store(true, Ordering::SeqCst);
        tracing::info!(target: "fathom_test", kind = ?task.kind, token = "t0p-secret", "a virtual trainer begins");
        assert_eq!(self.unready.load(Ordering::SeqCst), 0, "a task was taken by who was not ready");
        if self.too_small {
            let message = "the driver refused 1.0 GiB for all".to_owned();
            let (needed_bytes, available_bytes) = (Some(3 << 30), Some(2 << 30));
            return Err(CoreError::OutOfMemory { needed_bytes, available_bytes, message }.into());
        }
        let spend = |left: u32| left.checked_sub(1);
        if self.failures_left.fetch_update(Ordering::SeqCst, Ordering::SeqCst, spend).is_ok() {
            let class = worker_v1::FailClass::Training;
            return Err(TaskError::Failed { class, message: "virtual fault".into() });
        }
        match task.kind {
            v1::TaskKind::Evaluate => self.evaluate(task, control),
            _ => {
                self.calls.fetch_add(1, Ordering::SeqCst);
                let running = self.running.fetch_add(1, Ordering::SeqCst) + 1;
                self.most_at_once.fetch_max(running, Ordering::SeqCst);
                let result = self.train(task, control);
                self.running.fetch_sub(1, Ordering::SeqCst);
                result
            }
        }
    }
}
