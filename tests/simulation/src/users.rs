//! Simulated users. Each submits a scene, follows its job across lost connections, controls it, tries to read
//! data of others, and downloads the model. Some then delete everything.

use std::cell::Cell;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use fathom_coordinator::schedule::JobId;
use fathom_invariants::Fact;
use fathom_proto::admin::v1 as admin_v1;
use fathom_proto::admin::v1::admin_service_client::AdminServiceClient;
use fathom_proto::dial::{Connection, reason};
use fathom_proto::v1;
use fathom_proto::v1::job_event::Event;
use fathom_proto::v1::job_service_client::JobServiceClient;
use fathom_proto::v1::upload_service_client::UploadServiceClient;
use fathom_worker::WorkerError;
use fathom_worker::blobs::{BlobClient, BlobSource, from_proto, to_proto};
use futures::future::{join_all, try_join_all};
use prost::Message;
use tonic::{Code, Status};

use crate::network::dial;
use crate::random::Random;
use crate::scene::{Scene, blob_ref, config, scene};
use crate::world::{WantedJob, World, tenant_of};

/// A call is retried after this time.
const CALL_WITHIN: Duration = Duration::from_secs(8);
/// A stream that is silent for this long is reopened; it sends a keep-alive every ten seconds.
const SILENCE: Duration = Duration::from_secs(20);

/// One user of one tenant, with one job.
pub struct User {
    world: Arc<World>,
    index: usize,
    jobs: JobServiceClient<Connection>,
    uploads: UploadServiceClient<Connection>,
    blobs: BlobClient,
}

/// Actions of a user from start to end.
pub async fn user(world: Arc<World>, index: usize) -> turmoil::Result {
    let line = dial(&world.tokens.users[index]).lazily()?;
    let (jobs, uploads) = (JobServiceClient::new(line.clone()), UploadServiceClient::new(line.clone()));
    let user = User { world, index, jobs, uploads, blobs: BlobClient::new(line) };
    let job = user.submit().await?;
    let over = Cell::new(false);
    let (seen, steered) = futures::join!(user.follow(&job, &over), user.steer(&job, &over));
    seen?;
    steered?;
    user.fetch(&job).await?;
    if user.wanted().is_deleted {
        user.delete(&job).await?;
    }
    user.world.history.note(Fact::Finished { user: index });
    user.world.finished(index);
    Ok(())
}

impl User {
    fn random(&self, what: &str) -> Random {
        Random::new(self.world.seed, &format!("user {} {what}", self.index))
    }

    fn wanted(&self) -> &WantedJob {
        &self.world.scenario.jobs[self.index]
    }

    /// Its dataset, if it has one.
    fn dataset(&self) -> String {
        if self.wanted().has_dataset { format!("scene-{}", self.index) } else { String::new() }
    }

    /// Retries a call until it is answered; refusals are answers.
    async fn ask<T, F>(&self, mut call: impl FnMut(JobServiceClient<Connection>) -> F) -> Result<T, Status>
    where
        F: Future<Output = Result<tonic::Response<T>, Status>>,
    {
        self.answer(|| call(self.jobs.clone())).await
    }

    /// The same for a call of any service.
    async fn answer<T, F>(&self, mut call: impl FnMut() -> F) -> Result<T, Status>
    where
        F: Future<Output = Result<tonic::Response<T>, Status>>,
    {
        let mut pauses = self.random("pauses");
        loop {
            match tokio::time::timeout(CALL_WITHIN, call()).await {
                Ok(Ok(answer)) => return Ok(answer.into_inner()),
                Ok(Err(status)) if passes(&status) => {}
                Ok(Err(status)) => return Err(status),
                Err(_) => {}
            }
            tokio::time::sleep(pauses.ms(50, 900)).await;
        }
    }

    /// Uploads the scene and creates the job; repeats the call like a client that lost the answer.
    async fn submit(&self) -> turmoil::Result<JobId> {
        let mut random = self.random("creation");
        tokio::time::sleep(random.ms(0, 6000)).await;
        let scene = scene();
        // Before the first job exists, uploads expire after a while and are repeated.
        loop {
            let uploaded = if self.wanted().has_dataset {
                self.upload_dataset(&scene).await
            } else {
                self.upload(&scene).await.map_err(Into::into)
            };
            match uploaded {
                Err(error) if is_gone(&*error) => continue,
                uploaded => uploaded?,
            }
            // A committed dataset stays.
            let may_be_gone = !self.wanted().has_dataset;
            let request = self.request(&scene)?;
            let create = |after: Duration| {
                let request = request.clone();
                async move {
                    tokio::time::sleep(after).await;
                    let job = self.ask(|mut jobs| {
                        let request = request.clone();
                        async move { jobs.create_job(request).await }
                    });
                    let job: JobId = job.await?.job_id.parse()?;
                    let request = request.request_id;
                    self.world.history.note(Fact::Created { user: self.index, request, job: job.clone() });
                    turmoil::Result::Ok(job)
                }
            };
            let times = [Duration::ZERO, random.ms(0, 100), random.ms(0, 5000)];
            let mut created = Vec::new();
            for job in join_all(times.map(create)).await {
                match job {
                    Err(error) if may_be_gone && is_gone(&*error) => {}
                    job => created.push(job?),
                }
            }
            if let Some(job) = created.pop() {
                return Ok(job);
            }
        }
    }

    fn request(&self, scene: &Scene) -> turmoil::Result<v1::CreateJobRequest> {
        let wanted = self.wanted();
        Ok(v1::CreateJobRequest {
            request_id: format!("request of user {}", self.index),
            name: format!("job {}", self.index),
            config_json: serde_json::to_string(&config(wanted.partitions, wanted.variety))?,
            manifest: (!wanted.has_dataset).then(|| to_proto(&scene.manifest)),
            dataset_id: self.dataset(),
            max_parallel: wanted.max_parallel,
            ..Default::default()
        })
    }

    async fn upload(&self, scene: &Scene) -> Result<(), WorkerError> {
        let uploads = scene.blobs.iter().map(|blob| {
            let source = BlobSource::Bytes(blob.clone().into());
            async move { self.blobs.upload(&source).await }
        });
        try_join_all(uploads).await?;
        Ok(())
    }

    /// Uploads the scene as a dataset, which exists before its files, and commits it.
    async fn upload_dataset(&self, scene: &Scene) -> turmoil::Result {
        let file = |(index, blob): (usize, &Vec<u8>)| {
            let blob = blob_ref(blob);
            let path =
                if blob == scene.manifest { "manifest.json".to_owned() } else { format!("files/{index}") };
            v1::DatasetFile { path, blob: Some(to_proto(&blob)) }
        };
        let request = v1::BeginUploadRequest {
            dataset_id: self.dataset(),
            request_id: format!("dataset of user {}", self.index),
            files: scene.blobs.iter().enumerate().map(file).collect(),
            list: None,
        };
        let begun = self.answer(|| {
            let (mut uploads, request) = (self.uploads.clone(), request.clone());
            async move { uploads.begin_upload(request).await }
        });
        let dataset_id = begun.await?.dataset.unwrap_or_default().dataset_id;
        self.upload(scene).await?;
        let frozen = self.answer(|| {
            let (mut uploads, dataset_id) = (self.uploads.clone(), dataset_id.clone());
            async move { uploads.commit_dataset(v1::CommitDatasetRequest { dataset_id }).await }
        });
        let frozen = frozen.await?;
        let (dataset, root) = (frozen.dataset_id, frozen.root.unwrap_or_default().digest);
        self.world.history.note(Fact::Committed { user: self.index, dataset, root });
        Ok(())
    }

    /// Deletes the job and its dataset; acknowledged deletions are permanent.
    async fn delete(&self, job: &JobId) -> turmoil::Result {
        self.world.history.note(Fact::Deleting { user: self.index, job: job.clone() });
        let (job_id, dataset_id) = (job.to_string(), self.dataset());
        let deleted = self.ask(|mut jobs| {
            let job_id = job_id.clone();
            async move { jobs.delete_job(v1::DeleteJobRequest { job_id }).await }
        });
        is_absent(deleted.await)?;
        if self.wanted().has_dataset {
            let deleted = self.answer(|| {
                let (mut uploads, dataset_id) = (self.uploads.clone(), dataset_id.clone());
                async move { uploads.delete_dataset(v1::DeleteDatasetRequest { dataset_id }).await }
            });
            is_absent(deleted.await)?;
        }
        self.world.history.note(Fact::Deleted { user: self.index, job: job.clone() });
        self.world.counts(|counts| counts.deleted += 1);
        let revived = |how: String| Fact::Revived { user: self.index, job: job.clone(), how };
        let looked = self.ask(|mut jobs| {
            let job_id = job_id.clone();
            async move { jobs.get_job(v1::GetJobRequest { job_id }).await }
        });
        if let Ok(job) = looked.await {
            self.world.history.note(revived(format!("{job:?}")));
        }
        // The request has created a job, and creates no other.
        let request = self.request(&scene())?;
        let again = self.ask(|mut jobs| {
            let request = request.clone();
            async move { jobs.create_job(request).await }
        });
        if let Ok(job) = again.await {
            self.world.history.note(revived(format!("its request made {}", job.job_id)));
        }
        Ok(())
    }

    /// Follows the job from its first event to the last, each time from where the last stream ended.
    async fn follow(&self, job: &JobId, over: &Cell<bool>) -> turmoil::Result {
        let mut random = self.random("watching");
        let mut seq = 0;
        loop {
            let is_last = over.get();
            let drops_after = if random.permille(300) { random.within(1, 12) } else { u64::MAX };
            self.watch(job, &mut seq, drops_after, |seq, digest| {
                let job = job.clone();
                self.world.history.note(Fact::Seen { user: self.index, job, seq, digest });
            })
            .await?;
            if is_last && self.job(job).await?.last_seq == seq {
                break;
            }
            tokio::time::sleep(random.ms(10, 600)).await;
        }
        // Then again from the first event: the events must be the same.
        let mut seq = 0;
        while seq < self.job(job).await?.last_seq {
            self.watch(job, &mut seq, u64::MAX, |seq, digest| {
                let job = job.clone();
                self.world.history.note(Fact::Reread { user: self.index, job, seq, digest });
            })
            .await?;
        }
        Ok(())
    }

    /// Reads one stream until it ends, breaks, or has sent this many events.
    async fn watch(
        &self,
        job: &JobId,
        seq: &mut u64,
        drops_after: u64,
        seen: impl Fn(u64, String),
    ) -> turmoil::Result {
        let request = v1::WatchJobRequest { job_id: job.to_string(), after_seq: *seq };
        let mut jobs = self.jobs.clone();
        let opened = tokio::time::timeout(CALL_WITHIN, jobs.watch_job(request)).await;
        let mut stream = match opened {
            Ok(Ok(stream)) => stream.into_inner(),
            Ok(Err(status)) if !passes(&status) => return Err(self.denied(job, status)),
            _ => return Ok(()),
        };
        let mut count = 0;
        while count < drops_after
            && let Ok(Ok(Some(event))) = tokio::time::timeout(SILENCE, stream.message()).await
        {
            if matches!(event.event, Some(Event::Progress(_) | Event::KeepAlive(_))) {
                continue;
            }
            *seq = event.seq;
            seen(event.seq, blake3::hash(&event.encode_to_vec()).to_hex()[..16].to_owned());
            count += 1;
        }
        Ok(())
    }

    async fn job(&self, job: &JobId) -> turmoil::Result<v1::Job> {
        let request = v1::GetJobRequest { job_id: job.to_string() };
        let answer = self.ask(|mut jobs| {
            let request = request.clone();
            async move { jobs.get_job(request).await }
        });
        answer.await.map_err(|status| self.denied(job, status))
    }

    /// The coordinator denies an acknowledged job.
    fn denied(&self, job: &JobId, status: Status) -> Box<dyn std::error::Error> {
        self.world.history.note(Fact::Denied {
            user: self.index,
            job: job.clone(),
            said: status.message().to_owned(),
        });
        status.into()
    }

    /// Sends requests about the job while faults are active, then only waits for its end.
    async fn steer(&self, job: &JobId, over: &Cell<bool>) -> turmoil::Result {
        let mut random = self.random("steering");
        loop {
            tokio::time::sleep(random.ms(300, 3000)).await;
            let state = self.job(job).await?.state();
            match state {
                v1::JobState::Succeeded | v1::JobState::Cancelled => break,
                v1::JobState::Failed => self.want(job, "retry").await?,
                v1::JobState::Paused if !self.world.has_faults() => self.want(job, "resume").await?,
                _ if self.world.has_faults() => self.interfere(job, &mut random).await?,
                _ => {}
            }
        }
        over.set(true);
        Ok(())
    }

    async fn interfere(&self, job: &JobId, random: &mut Random) -> turmoil::Result {
        match random.within(0, 100) {
            0..7 => self.want(job, "pause").await,
            7..16 => self.want(job, "resume").await,
            16..18 if self.wanted().may_be_cancelled => self.want(job, "cancel").await,
            18..25 => self.want(job, "update").await,
            25..40 => self.probe_others(random).await,
            40..48 => self.operate(random).await,
            _ => Ok(()),
        }
    }

    /// One request, sometimes sent twice; a refusal is an answer too.
    async fn want(&self, job: &JobId, what: &'static str) -> turmoil::Result {
        let (job_id, reason) = (job.to_string(), "the user wants it".to_owned());
        for _ in 0..if self.random(what).permille(500) { 2 } else { 1 } {
            let answer = self.ask(|mut jobs| {
                let (job_id, reason) = (job_id.clone(), reason.clone());
                async move {
                    match what {
                        "pause" => jobs.pause_job(v1::PauseJobRequest { job_id, reason }).await,
                        "resume" => jobs.resume_job(v1::ResumeJobRequest { job_id }).await,
                        "cancel" => jobs.cancel_job(v1::CancelJobRequest { job_id, reason }).await,
                        "retry" => jobs.retry_job(v1::RetryJobRequest { job_id }).await,
                        _ => {
                            let (priority, max_parallel) = (Some(7), None);
                            jobs.update_job(v1::UpdateJobRequest { job_id, priority, max_parallel }).await
                        }
                    }
                }
            });
            let answer = match answer.await {
                Ok(job) => format!("{:?}", job.state()),
                Err(status) if status.code() == Code::NotFound => return Err(self.denied(job, status)),
                Err(status) => status.message().to_owned(),
            };
            self.world.history.note(Fact::Steered { user: self.index, job: job.clone(), what, answer });
        }
        Ok(())
    }

    /// Tries to read the jobs of others.
    async fn probe_others(&self, random: &mut Random) -> turmoil::Result {
        let others = self.world.created();
        let others: Vec<&JobId> = others
            .iter()
            .filter(|(user, _)| tenant_of(*user) != tenant_of(self.index))
            .map(|(_, job)| job)
            .collect();
        if others.is_empty() {
            return Ok(());
        }
        let job = random.of(&others).clone();
        let job_id = job.to_string();
        let seen = self.ask(|mut jobs| {
            let job_id = job_id.clone();
            async move { jobs.get_job(v1::GetJobRequest { job_id }).await }
        });
        let betrayed = |how: String| Fact::Betrayed { user: self.index, job: job.clone(), how };
        match seen.await {
            Err(status) if status.code() == Code::NotFound => {}
            answer => self.world.history.note(betrayed(format!("{answer:?}"))),
        }
        let listed = self.ask(|mut jobs| async move { jobs.list_jobs(v1::ListJobsRequest::default()).await });
        if listed.await?.jobs.iter().any(|listed| listed.job_id == job.as_str()) {
            self.world.history.note(betrayed("it is in the list".into()));
        }
        Ok(())
    }

    /// As an operator: drains a worker and puts it back. Answers may be lost; a mark ends with its worker's
    /// process.
    async fn operate(&self, random: &mut Random) -> turmoil::Result {
        let mut admin = AdminServiceClient::new(dial(&self.world.tokens.operator).lazily()?);
        let listed =
            tokio::time::timeout(CALL_WITHIN, admin.list_workers(admin_v1::ListWorkersRequest {})).await;
        let Ok(Ok(listed)) = listed else { return Ok(()) };
        let workers = listed.into_inner().workers;
        if workers.is_empty() {
            return Ok(());
        }
        let worker = workers[random.within(0, workers.len() as u64) as usize].worker_id.clone();
        let (worker_id, reason) = (worker.clone(), "the operator wants it".to_owned());
        let drain = admin.drain_worker(admin_v1::DrainWorkerRequest { worker_id, reason });
        let drained = tokio::time::timeout(CALL_WITHIN, drain).await;
        self.world
            .history
            .note(Fact::Fault(format!("worker {worker} is drained: {}", matches!(drained, Ok(Ok(_))))));
        tokio::time::sleep(random.ms(500, 4000)).await;
        loop {
            let worker_id = worker.clone();
            let call = admin.uncordon_worker(admin_v1::UncordonWorkerRequest { worker_id });
            match tokio::time::timeout(CALL_WITHIN, call).await {
                Ok(Err(status)) if passes(&status) => tokio::time::sleep(random.ms(50, 900)).await,
                Err(_) => {}
                Ok(_) => return Ok(()),
            }
        }
    }

    /// Fetches the model of a job that succeeded.
    async fn fetch(&self, job: &JobId) -> turmoil::Result {
        if self.job(job).await?.state() != v1::JobState::Succeeded {
            return Ok(());
        }
        let request = v1::ListArtifactsRequest { job_id: job.to_string(), ..Default::default() };
        let listed = self.ask(|mut jobs| {
            let request = request.clone();
            async move { jobs.list_artifacts(request).await }
        });
        let artifacts = listed.await?.artifacts;
        let model = artifacts.into_iter().find(|artifact| artifact.path == "model.ply");
        let Some(blob) = model.and_then(|model| model.blob) else {
            return Err(format!("job {job} has succeeded without a model").into());
        };
        let path: PathBuf = self.world.dir().join(format!("model-{}.ply", self.index));
        self.blobs.download(&from_proto(blob), &path).await?;
        let model = blake3::hash(&std::fs::read(path)?).to_hex().to_string();
        self.world.history.note(Fact::Fetched { user: self.index, job: job.clone(), model });
        Ok(())
    }
}

/// "Not found" means success: an earlier call whose answer was lost has deleted it.
fn is_absent<T>(answer: Result<T, Status>) -> Result<(), Status> {
    match answer {
        Err(status) if status.code() != Code::NotFound => Err(status),
        _ => Ok(()),
    }
}

/// Whether unreferenced uploads have been removed in the meantime.
fn is_gone(error: &(dyn std::error::Error + 'static)) -> bool {
    let status = match error.downcast_ref::<WorkerError>() {
        Some(WorkerError::Refused(status)) => Some(&**status),
        _ => error.downcast_ref::<Status>(),
    };
    let reason = status.and_then(reason);
    matches!(reason.as_deref(), Some("BLOB_NOT_FOUND" | "DATASET_NOT_FOUND"))
}

/// Whether a retry may get another answer: the coordinator or the network failed.
fn passes(status: &Status) -> bool {
    matches!(
        status.code(),
        Code::Unavailable
            | Code::Unknown
            | Code::Internal
            | Code::Cancelled
            | Code::DeadlineExceeded
            | Code::Aborted
    )
}
