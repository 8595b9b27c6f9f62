//! A coordinator with tokens in this process, and callers.
#![allow(dead_code, reason = "each test program uses a part of it")]

use std::path::Path;

use fathom_coordinator::{Coordinator, CoordinatorConfig, serve};
use fathom_core::scene::{self, Manifest};
use fathom_proto::admin::v1::admin_service_client::AdminServiceClient;
use fathom_proto::admin::v1::{IssueTokenRequest, Role};
use fathom_proto::dial::{Connection, Dial, Secret, reason};
use fathom_proto::v1::job_service_client::JobServiceClient;
use fathom_proto::v1::upload_service_client::UploadServiceClient;
use fathom_proto::v1::{BlobRef, CreateJobRequest, Job, ListJobsRequest, PauseJobRequest, WriteBlobRequest};
use fathom_proto::worker::v1::worker_service_client::WorkerServiceClient;
use tonic::{Code, Status};

/// Of a worker.
pub const INCARNATION: &str = "6f9619ff-8b86-4d01-b42d-00cf4fc964ff";

pub struct GuardedCluster {
    pub dir: tempfile::TempDir,
    pub coordinator: Coordinator,
}

/// A caller with its credentials.
pub struct Caller {
    pub connection: Connection,
}

impl GuardedCluster {
    pub async fn start(change: impl FnOnce(&mut CoordinatorConfig, &Path)) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let mut config = CoordinatorConfig {
            data_dir: dir.path().join("data"),
            listen: ([127, 0, 0, 1], 0).into(),
            min_free_bytes: 0,
            tokens: true,
            ..CoordinatorConfig::default()
        };
        change(&mut config, dir.path());
        let coordinator = serve(config).await.unwrap();
        Self { dir, coordinator }
    }

    pub fn first_token(&self) -> String {
        std::fs::read_to_string(self.dir.path().join("data/operator.token")).unwrap().trim().to_owned()
    }

    pub fn with(&self, token: Option<&str>) -> Caller {
        let dial = Dial { token: token.map(Secret::new), ..Dial::to(&self.coordinator.url()) };
        Caller { connection: dial.lazily().unwrap() }
    }

    pub fn operator(&self) -> Caller {
        self.with(Some(&self.first_token()))
    }

    pub async fn issue(&self, role: Role, tenant: &str) -> (String, String) {
        let request = IssueTokenRequest {
            name: format!("{role:?} of {tenant}"),
            role: role.into(),
            tenant: tenant.to_owned(),
            expires_in_seconds: 0,
        };
        let issued = self.operator().admin().issue_token(request).await.unwrap().into_inner();
        (issued.secret, issued.token.unwrap().token_id)
    }

    /// A job of a tenant that lasts for the whole test: its points are damaged on the disk, so planning fails
    /// and is retried only after a pause (`long_pauses`).
    pub async fn lasting_job(&self, caller: &Caller, tenant: &str, request_id: &str) -> Job {
        let manifest = caller.upload_scene().await.unwrap();
        let points = blob(POINTS).digest;
        let objects = self.dir.path().join("data/tenants").join(tenant).join("objects/cas");
        std::fs::write(objects.join(&points[..2]).join(&points), vec![b' '; POINTS.len()]).unwrap();
        let job = caller.create(request_id, manifest).await.unwrap();
        let pause = PauseJobRequest { job_id: job.job_id.clone(), reason: String::new() };
        caller.jobs().pause_job(pause).await.expect("a job that waits to be planned again").into_inner()
    }

    pub async fn caller(&self, role: Role, tenant: &str) -> Caller {
        self.with(Some(&self.issue(role, tenant).await.0))
    }
}

impl Caller {
    pub fn jobs(&self) -> JobServiceClient<Connection> {
        JobServiceClient::new(self.connection.clone())
    }

    pub fn uploads(&self) -> UploadServiceClient<Connection> {
        UploadServiceClient::new(self.connection.clone())
    }

    pub fn admin(&self) -> AdminServiceClient<Connection> {
        AdminServiceClient::new(self.connection.clone())
    }

    pub fn workers(&self) -> WorkerServiceClient<Connection> {
        WorkerServiceClient::new(self.connection.clone())
    }

    pub async fn upload(&self, content: &[u8]) -> Result<BlobRef, Status> {
        let blob = blob(content);
        let piece = WriteBlobRequest {
            blob: Some(blob.clone()),
            data: content.to_vec().into(),
            finish: true,
            ..Default::default()
        };
        self.uploads().write_blob(futures::stream::iter([piece])).await?;
        Ok(blob)
    }

    /// A scene that can be submitted but not planned; returns its manifest.
    pub async fn upload_scene(&self) -> Result<BlobRef, Status> {
        let BlobRef { digest, size_bytes: bytes } = self.upload(POINTS).await?;
        let (cameras, views, points) = (Vec::new(), Vec::new(), scene::BlobRef { digest, bytes });
        let manifest = Manifest { format: Manifest::FORMAT, source: "test".into(), cameras, views, points };
        self.upload(&manifest.to_json().unwrap()).await
    }

    /// A job that waits to be planned.
    pub async fn job(&self, request_id: &str) -> Result<Job, Status> {
        let manifest = self.upload_scene().await?;
        self.create(request_id, manifest).await
    }

    pub async fn create(&self, request_id: &str, manifest: BlobRef) -> Result<Job, Status> {
        let request = CreateJobRequest {
            request_id: request_id.to_owned(),
            name: "wreck".into(),
            config_json: "{}".into(),
            manifest: Some(manifest),
            ..Default::default()
        };
        Ok(self.jobs().create_job(request).await?.into_inner())
    }

    pub async fn list(&self) -> Result<Vec<String>, Status> {
        let jobs = self.jobs().list_jobs(ListJobsRequest::default()).await?.into_inner().jobs;
        Ok(jobs.into_iter().map(|job| job.job_id).collect())
    }
}

/// An empty one; it is not read before planning.
pub const POINTS: &[u8] = b"points";

pub fn blob(content: &[u8]) -> BlobRef {
    BlobRef { digest: blake3::hash(content).to_hex().to_string(), size_bytes: content.len() as u64 }
}

/// Code and reason of a refusal.
pub fn said<T: std::fmt::Debug>(answer: Result<T, Status>) -> (Code, String) {
    let status = answer.unwrap_err();
    (status.code(), reason(&status).unwrap_or_else(|| status.message().to_owned()))
}

pub fn is(code: Code, reason: &str) -> (Code, String) {
    (code, reason.to_owned())
}
