//! The services themselves, with a store in memory: the first byte of an input selects the call, the rest is
//! the message.

use std::cell::{Cell, RefCell};
use std::collections::HashMap;
use std::sync::atomic::AtomicU32;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use fathom_core::scene::{BlobRef, Manifest};
use fathom_fuzz::{Folder, Target, run};
use fathom_proto::admin::v1::admin_service_server::AdminService;
use fathom_proto::v1::job_service_server::JobService;
use fathom_proto::v1::upload_service_server::UploadService;
use fathom_proto::worker::v1::worker_service_server::WorkerService;
use fathom_proto::{admin::v1 as admin, v1, worker::v1 as worker};
use prost::Message;
use tokio::sync::watch;
use tonic::Request;

use crate::access::{Access, Principal, Role, Token, TokenRecord};
use crate::clock::Clock;
use crate::datasets::{FileList, ListedFile, MANIFEST_PATH, NewDataset};
use crate::logs::JobLogs;
use crate::objects::{ObjectsAt, TenantBlobs};
use crate::retention::Policy;
use crate::schedule::{JobId, Rules, TaskStats, Tenant};
use crate::services::{Admin, Jobs, Uploads, Workers, encode};
use crate::state::State;
use crate::store::memory::MemoryStore;
use crate::store::{DatasetStore, JobStore, NewJob, Store, record};
use crate::wakeups::Wakeups;
use crate::worker_registry::WorkerRegistry;

/// The content of blobs that are never read.
const ANYTHING: &[u8] = b"the points of a wreck";
/// Number of calls after which a coordinator is replaced: their data would slow down later ones.
const CALLS: u32 = 1000;

pub fn blob() -> Option<v1::BlobRef> {
    let BlobRef { digest, bytes } = BlobRef::of(ANYTHING);
    Some(v1::BlobRef { digest, size_bytes: bytes })
}

/// A manifest without photographs.
fn scene() -> Vec<u8> {
    let points = BlobRef::of(ANYTHING);
    let (cameras, views) = (Vec::new(), Vec::new());
    Manifest { format: Manifest::FORMAT, source: "fuzz".into(), cameras, views, points }.to_json().unwrap()
}

/// The files of the existing dataset: a scene, with its points.
fn dataset() -> FileList {
    let file = |path: &str, content: &[u8]| ListedFile { path: path.into(), blob: BlobRef::of(content) };
    FileList::new(vec![file(MANIFEST_PATH, &scene()), file("points.bin", ANYTHING)]).unwrap()
}

fn job_id() -> JobId {
    JobId::new(1_700_000_000_000, 7)
}

pub fn lease() -> Option<worker::Lease> {
    Some(worker::Lease {
        job_id: job_id().to_string(),
        task_id: "partition-0003".into(),
        attempt: 1,
        fence: 7,
    })
}

pub fn task_stats() -> worker::TaskStats {
    let metrics = v1::HeldOutMetrics { iteration: 9, psnr_db: 20.5, ssim: 0.5, views: 3 };
    worker::TaskStats {
        seconds: 12.5,
        iterations: 700,
        gaussians: 1000,
        adapter: "GPU".into(),
        resumed_from_iteration: 3,
        held_out: vec![metrics; 2],
        measured: vec![measured()],
    }
}

/// A point of a curve with a preview.
pub fn measured() -> worker::Measured {
    let progress = v1::Progress { iteration: 7, loss: 0.1, ..Default::default() };
    let preview = v1::Preview {
        view: "one.jpg".into(),
        iteration: 7,
        render: blob(),
        clear: blob(),
        psnr_db: Some(21.5),
    };
    worker::Measured { progress: Some(progress), age_ms: 500, previews: vec![preview] }
}

/// A coordinator with one job.
struct Coordinator {
    shared: Arc<State>,
    _stopping: watch::Sender<bool>,
    _folder: Folder,
}

impl Coordinator {
    async fn new(name: &str) -> Self {
        let folder = Folder::new(name);
        let objects = {
            let at = ObjectsAt::Folder(folder.path().to_owned());
            TenantBlobs::open(at, folder.path(), 0, Clock::start(), None).await.unwrap()
        };
        let manifest = objects.of(&Tenant::default()).await.unwrap().put(ANYTHING.into()).await.unwrap();
        let store = MemoryStore::new(Rules::default(), 30_000, 0);
        let new = NewJob {
            job_id: job_id(),
            request_id: "of the job that is there".into(),
            manifest,
            ..NewJob::sample(0)
        };
        store.submit(new, 1_700_000_000_000).await.unwrap();
        let objects_of_all = objects.of(&Tenant::default()).await.unwrap();
        objects_of_all.put(scene().into()).await.unwrap();
        let list = dataset();
        let dataset = NewDataset {
            id: "wreck".parse().unwrap(),
            tenant: Tenant::default(),
            request_id: "of the dataset that is there".into(),
            root: objects_of_all.put(list.text().to_owned().into()).await.unwrap(),
            files: 2,
            bytes: list.bytes(),
        };
        let dataset = store.begin_dataset(dataset, 1_700_000_000_000).await.unwrap();
        store.commit_dataset(&dataset.tenant, &dataset.id, &dataset.root, 1_700_000_000_000).await.unwrap();
        let store: Arc<dyn Store> = Arc::new(store);
        let (stopping, stop_signal) = watch::channel(false);
        let clock = Clock::start();
        let shared = Arc::new(State {
            has_webhook: false,
            jobs: Arc::clone(&store) as Arc<dyn JobStore>,
            store,
            objects,
            access: Arc::new(Access::open()),
            logs: Arc::new(JobLogs::new(&folder.path().join("logs"), 1 << 16)),
            own_lines: Arc::default(),
            history: Default::default(),
            links: Default::default(),
            metrics: Arc::default(),
            clock,
            lease_ms: 30_000,
            wakeups: Wakeups::default(),
            stopping: stop_signal,
            members: Arc::new(AtomicU32::new(1)),
            workers: WorkerRegistry::new(clock, 30_000, HashMap::new()),
            gaps: Mutex::new(HashMap::new()),
            revoking: Default::default(),
            backing_up: Default::default(),
            capacity_timeout_ms: 0,
            policy: Policy {
                jobs: None,
                unused: Duration::from_secs(3600),
                uploads: Duration::from_secs(3600),
            },
        });
        Self { shared, _stopping: stopping, _folder: folder }
    }
}

/// The message of a call, or nothing.
fn message<M: Message + Default>(bytes: &[u8]) -> Option<Request<M>> {
    let mut request = Request::new(M::decode(bytes).ok()?);
    // As the guard does where no tokens are required.
    request.extensions_mut().insert(Principal::anonymous());
    Some(request)
}

/// Runs `call` with inputs for a coordinator that is replaced from time to time.
fn fuzz(name: &str, corpus: &[(u8, Vec<u8>)], call: impl AsyncFn(&Arc<State>, u8, &[u8]) -> Option<()>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let coordinator: RefCell<Option<Coordinator>> = RefCell::new(None);
    let calls = Cell::new(0);
    let read = |bytes: &[u8]| {
        let Some((which, message)) = bytes.split_first() else { return false };
        if calls.replace((calls.get() + 1) % CALLS) == 0 {
            coordinator.take();
            let name = name.replace(' ', "-");
            coordinator.replace(Some(runtime.block_on(Coordinator::new(&name))));
        }
        let coordinator = coordinator.borrow();
        let shared = &coordinator.as_ref().unwrap().shared;
        runtime.block_on(call(shared, *which, message)).is_some()
    };
    let corpus = corpus.iter().map(|(which, message)| [&[*which], &message[..]].concat()).collect();
    let words = ["../", "\0", "partition-4294967295", "first_part-0000", "{\"train\":{}}", "paper"];
    run(&Target { words: &words, ..Target::new(name, corpus, &read) });
}

#[test]
fn fuzzed_calls_of_users_are_answered_or_refused() {
    let job_id = job_id().to_string();
    let create = v1::CreateJobRequest {
        request_id: "one".into(),
        name: "wreck".into(),
        config_json: r#"{"train": {"iterations": 7000}, "preset": "paper"}"#.into(),
        manifest: Some(encode::blob(&BlobRef::of(&scene()))),
        ingest_seconds: 1.5,
        priority: -3,
        max_parallel: 4,
        dataset_id: String::new(),
    };
    let of_dataset = v1::CreateJobRequest {
        request_id: "two".into(),
        manifest: None,
        dataset_id: "wreck".into(),
        ..create.clone()
    };
    let artifacts =
        v1::ListArtifactsRequest { job_id: job_id.clone(), page_size: 3, page_token: String::new() };
    let list = v1::ListJobsRequest {
        page_size: 7,
        states: vec![1, 2],
        name_contains: "w".into(),
        ..Default::default()
    };
    let update = v1::UpdateJobRequest { job_id: job_id.clone(), priority: Some(3), max_parallel: Some(2) };
    let corpus = [
        (0, create.encode_to_vec()),
        (0, of_dataset.encode_to_vec()),
        (1, list.encode_to_vec()),
        (2, v1::GetJobRequest { job_id: job_id.clone() }.encode_to_vec()),
        (3, v1::PauseJobRequest { job_id: job_id.clone(), reason: "why".into() }.encode_to_vec()),
        (4, v1::ResumeJobRequest { job_id: job_id.clone() }.encode_to_vec()),
        (5, update.encode_to_vec()),
        (6, artifacts.encode_to_vec()),
        (10, v1::GetHistoryRequest { job_id: job_id.clone(), ..Default::default() }.encode_to_vec()),
        (11, v1::ShareJobRequest { job_id: job_id.clone(), expires_in_seconds: 60 }.encode_to_vec()),
    ];
    fuzz("calls of JobService", &corpus, async |shared, which, bytes| {
        let jobs = Jobs(Arc::clone(shared));
        match which {
            0 => jobs.create_job(message(bytes)?).await.ok().map(drop),
            1 => jobs.list_jobs(message(bytes)?).await.ok().map(drop),
            2 => jobs.get_job(message(bytes)?).await.ok().map(drop),
            3 => jobs.pause_job(message(bytes)?).await.ok().map(drop),
            4 => jobs.resume_job(message(bytes)?).await.ok().map(drop),
            5 => jobs.update_job(message(bytes)?).await.ok().map(drop),
            6 => jobs.list_artifacts(message(bytes)?).await.ok().map(drop),
            7 => jobs.cancel_job(message(bytes)?).await.ok().map(drop),
            8 => jobs.retry_job(message(bytes)?).await.ok().map(drop),
            9 => jobs.delete_job(message(bytes)?).await.ok().map(drop),
            10 => jobs.get_history(message(bytes)?).await.ok().map(drop),
            // No token is required here, so there is no link.
            11 => jobs.share_job(message(bytes)?).await.map_or_else(|_| Some(()), |_| None),
            _ => None,
        }
    });
}

#[test]
fn fuzzed_calls_of_uploads_are_answered_or_refused() {
    let BlobRef { digest, .. } = BlobRef::of(b"abc");
    let new = Some(v1::BlobRef { digest: digest.clone(), size_bytes: 3 });
    let write = v1::WriteBlobRequest {
        blob: new.clone(),
        offset_bytes: 0,
        data: b"abc".as_slice().into(),
        finish: true,
        job_id: job_id().to_string(),
    };
    let corpus = [
        (
            0,
            v1::FindMissingBlobsRequest {
                blobs: vec![blob().unwrap(), new.clone().unwrap()],
                job_id: String::new(),
            }
            .encode_to_vec(),
        ),
        (1, write.encode_to_vec()),
        (2, v1::QueryBlobRequest { blob: new.clone(), job_id: job_id().to_string() }.encode_to_vec()),
        (
            3,
            v1::ReadBlobRequest { digest: blob().unwrap().digest, offset_bytes: 3, ..Default::default() }
                .encode_to_vec(),
        ),
    ];
    let file = v1::DatasetFile { path: "images/täuchung.jpg".into(), blob: new };
    let there = v1::DatasetFile { path: MANIFEST_PATH.into(), blob: blob() };
    let begin = v1::BeginUploadRequest {
        dataset_id: "reef".into(),
        request_id: "one".into(),
        files: vec![there, file],
        list: None,
    };
    let list = BlobRef::of(dataset().text().as_bytes());
    let by_list = v1::BeginUploadRequest {
        dataset_id: String::new(),
        request_id: "two".into(),
        files: Vec::new(),
        list: Some(encode::blob(&list)),
    };
    let page = v1::ListDatasetsRequest { page_size: 1, page_token: String::new() };
    let wreck = v1::CommitDatasetRequest { dataset_id: "wreck".into() }.encode_to_vec();
    let mut corpus = corpus.to_vec();
    corpus.extend([(4, begin.encode_to_vec()), (4, by_list.encode_to_vec()), (5, wreck.clone())]);
    corpus.extend([(6, wreck.clone()), (7, page.encode_to_vec()), (8, wreck)]);
    let sign = v1::SignWriteRequest { blob: blob(), ..Default::default() };
    let finish =
        v1::FinishWriteRequest { blob: blob(), upload: blob().unwrap().digest, ..Default::default() };
    corpus.extend([(9, sign.encode_to_vec()), (10, finish.encode_to_vec())]);
    let inspect = v1::InspectDatasetRequest { dataset_id: "wreck".into(), config_json: "{}".into() };
    corpus.push((11, inspect.encode_to_vec()));
    fuzz("calls of UploadService", &corpus, async |shared, which, bytes| {
        let uploads = Uploads(Arc::clone(shared));
        match which {
            0 => uploads.find_missing_blobs(message(bytes)?).await.ok().map(drop),
            // It does what WriteBlob does with a stream of one message.
            1 => uploads.write_chunk(message(bytes)?).await.ok().map(drop),
            2 => uploads.query_blob(message(bytes)?).await.ok().map(drop),
            3 => uploads.read_blob(message(bytes)?).await.ok().map(drop),
            4 => uploads.begin_upload(message(bytes)?).await.ok().map(drop),
            5 => uploads.commit_dataset(message(bytes)?).await.ok().map(drop),
            6 => uploads.get_dataset(message(bytes)?).await.ok().map(drop),
            7 => uploads.list_datasets(message(bytes)?).await.ok().map(drop),
            8 => uploads.delete_dataset(message(bytes)?).await.ok().map(drop),
            9 => uploads.sign_write(message(bytes)?).await.ok().map(drop),
            // Nothing is in a bucket here, so each of them is refused.
            10 => uploads.finish_write(message(bytes)?).await.map_or_else(|_| Some(()), |_| None),
            // Nor is a scene in the dataset.
            11 => uploads.inspect_dataset(message(bytes)?).await.map_or_else(|_| Some(()), |_| None),
            _ => None,
        }
    });
}

#[test]
fn fuzzed_calls_of_workers_are_answered_or_refused() {
    let capabilities = worker::Capabilities {
        adapter: "GPU".into(),
        stages: vec![2, 3],
        memory_bytes: 1 << 33,
        ..Default::default()
    };
    let register = worker::RegisterRequest {
        worker_name: "one".into(),
        incarnation: "6f9619ff-8b86-4d01-b42d-00cf4fc964ff".into(),
        build_version: "0.1".into(),
        protocol_version: fathom_proto::WORKER_PROTOCOL_VERSION,
        capabilities: Some(capabilities),
        held: vec![lease().unwrap()],
    };
    let progress = Some(v1::Progress { iteration: 7, loss: 0.1, ..Default::default() });
    let renewals = vec![worker::Renewal { lease: lease(), progress, measured: vec![measured()] }];
    let corpus = [
        (0, register.encode_to_vec()),
        (
            1,
            worker::ClaimRequest {
                incarnation: "6f9619ff-8b86-4d01-b42d-00cf4fc964ff".into(),
                request_id: "r".into(),
                wait_ms: 0,
            }
            .encode_to_vec(),
        ),
        (
            2,
            worker::RenewRequest { incarnation: "6f9619ff-8b86-4d01-b42d-00cf4fc964ff".into(), renewals }
                .encode_to_vec(),
        ),
    ];
    fuzz("calls of WorkerService", &corpus, async |shared, which, bytes| {
        let workers = Workers(Arc::clone(shared));
        match which {
            0 => WorkerService::register(&workers, message(bytes)?).await.ok().map(drop),
            1 => {
                let mut claim = message::<worker::ClaimRequest>(bytes)?;
                // The test does not cover waiting.
                claim.get_mut().wait_ms = 0;
                workers.claim(claim).await.ok().map(drop)
            }
            2 => {
                // Like leases of workers that registered before their coordinator was replaced.
                let first = worker::RegisterRequest::decode(register.encode_to_vec().as_slice()).ok()?;
                workers.register(message(&first.encode_to_vec())?).await.ok()?;
                workers.renew(message(bytes)?).await.ok().map(drop)
            }
            3 => workers.checkpoint(message(bytes)?).await.ok().map(drop),
            4 => workers.complete(message(bytes)?).await.ok().map(drop),
            5 => workers.fail(message(bytes)?).await.ok().map(drop),
            6 => workers.release(message(bytes)?).await.ok().map(drop),
            7 => workers.append_logs(message(bytes)?).await.ok().map(drop),
            _ => None,
        }
    });
}

#[test]
fn fuzzed_calls_of_operators_are_answered_or_refused() {
    let cordon = admin::CordonWorkerRequest {
        worker_id: "6f9619ff-8b86-4d01-b42d-00cf4fc964ff".into(),
        reason: "why".into(),
    };
    let quota = Some(admin::Quota { max_open_jobs: 1, max_parallel: 2, max_bytes: 3 });
    let issue = admin::IssueTokenRequest {
        name: "ci".into(),
        role: admin::Role::Submitter.into(),
        tenant: "reef".into(),
        expires_in_seconds: 60,
    };
    let corpus = [
        (3, admin::SetQuotaRequest { tenant: "reef".into(), quota }.encode_to_vec()),
        (4, issue.encode_to_vec()),
        (6, Vec::new()),
        (0, cordon.encode_to_vec()),
        (
            2,
            admin::UncordonWorkerRequest { worker_id: "6f9619ff-8b86-4d01-b42d-00cf4fc964ff".into() }
                .encode_to_vec(),
        ),
    ];
    fuzz("calls of AdminService", &corpus, async |shared, which, bytes| {
        let first = worker::RegisterRequest {
            incarnation: "6f9619ff-8b86-4d01-b42d-00cf4fc964ff".into(),
            protocol_version: fathom_proto::WORKER_PROTOCOL_VERSION,
            ..Default::default()
        };
        WorkerService::register(&Workers(Arc::clone(shared)), message(&first.encode_to_vec())?).await.ok()?;
        let admin = Admin(Arc::clone(shared));
        match which {
            0 => admin.cordon_worker(message(bytes)?).await.ok().map(drop),
            1 => admin.drain_worker(message(bytes)?).await.ok().map(drop),
            2 => admin.uncordon_worker(message(bytes)?).await.ok().map(drop),
            3 => AdminService::set_quota(&admin, message(bytes)?).await.ok().map(drop),
            4 => admin.issue_token(message(bytes)?).await.ok().map(drop),
            5 => admin.revoke_token(message(bytes)?).await.ok().map(drop),
            6 => admin.list_tenants(message(bytes)?).await.ok().map(drop),
            _ => None,
        }
    });
}

/// A worker's report about a task goes into its row, and an unreadable row means a damaged store.
#[test]
fn fuzzed_results_of_workers_make_rows_that_read_back() {
    let sound = worker::CompleteRequest {
        lease: lease(),
        result: blob(),
        stats: Some(task_stats()),
        further: Vec::new(),
    };
    let read = |bytes: &[u8]| {
        let Ok(request) = worker::CompleteRequest::decode(bytes) else { return false };
        let lease = encode::required_lease(request.lease);
        let stats = request.stats.as_ref().map(encode::stats).unwrap_or_default();
        match record::encode("tasks", &stats) {
            Ok(row) => assert_eq!(record::decode::<TaskStats>("tasks", &row).unwrap(), stats),
            Err(error) => assert!(error.to_string().contains("bytes"), "{error}"),
        }
        lease.is_ok()
    };
    run(&Target::new("result of a worker", vec![sound.encode_to_vec()], &read));
}

#[test]
fn a_manifest_that_is_too_large_is_refused_before_a_job_exists() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async {
        let Coordinator { shared, .. } = &Coordinator::new("large-manifest").await;
        let create = |bytes: u64| v1::CreateJobRequest {
            request_id: format!("of {bytes}"),
            config_json: "{}".into(),
            manifest: Some(v1::BlobRef { digest: BlobRef::of(&scene()).digest, size_bytes: bytes }),
            ..Default::default()
        };
        let jobs = Jobs(Arc::clone(shared));
        let refused = jobs.create_job(message(&create(1 << 40).encode_to_vec()).unwrap()).await.unwrap_err();
        assert_eq!(refused.code(), tonic::Code::InvalidArgument);
        assert!(refused.message().contains("manifest: has 1099511627776 bytes"), "{refused}");
        jobs.create_job(message(&create(scene().len() as u64).encode_to_vec()).unwrap()).await.unwrap();
    });
}

/// The first bytes of an unauthenticated client.
#[test]
fn fuzzed_tokens_open_no_door() {
    let token = Token::random();
    let record = TokenRecord::new(&token, "ci".into(), Role::Viewer, None, 0, None);
    let access = Access::by_tokens(vec![record]);
    let sound = format!("Bearer {}", token.reveal());
    let read = |bytes: &[u8]| {
        let shown = String::from_utf8_lossy(bytes);
        let is_let_in = access.principal(Some(&shown), 1).is_ok();
        // White space around a token and the case of "bearer" do not matter.
        let is_same = shown.split_whitespace().last() == sound.split_whitespace().last();
        assert!(!is_let_in || is_same, "{shown}");
        is_let_in
    };
    run(&Target::new("authorization", vec![sound.clone().into_bytes()], &read));
}
