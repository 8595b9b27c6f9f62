//! Every incoming message, by prost: an accepted message reads back from its own bytes.

use fathom_fuzz::{Target, run};
use fathom_proto::{admin::v1 as admin, v1, worker::v1 as worker};
use prost::Message;

use super::calls::{blob, lease, measured, task_stats};

/// A target for one kind of message.
fn fuzz<M: Message + Default>(sound: M) {
    let read = |bytes: &[u8]| {
        let Ok(message) = M::decode(bytes) else { return false };
        let again = message.encode_to_vec();
        // NaN differs from itself, so bytes are compared.
        assert_eq!(M::decode(again.as_slice()).unwrap().encode_to_vec(), again);
        true
    };
    let name = std::any::type_name::<M>().rsplit("::").next().unwrap_or_default();
    run(&Target { inputs: 500, ..Target::new(name, vec![sound.encode_to_vec()], &read) });
}

fn job_id() -> String {
    "0193a5b2c4d100000007".into()
}

#[test]
fn fuzzed_messages_of_users_are_decoded_or_refused() {
    fuzz(v1::CreateJobRequest {
        request_id: "one".into(),
        name: "wreck".into(),
        config_json: "{}".into(),
        manifest: blob(),
        ingest_seconds: 1.5,
        priority: -3,
        max_parallel: 4,
        dataset_id: "reef".into(),
    });
    fuzz(v1::ListJobsRequest {
        page_size: 7,
        page_token: "a-0".into(),
        states: vec![1, 2],
        name_contains: "w".into(),
        tenant: "reef".into(),
    });
    fuzz(v1::StreamLogsRequest { job_id: job_id(), task_id: "merge".into(), ..Default::default() });
    fuzz(v1::GetJobRequest { job_id: job_id() });
    fuzz(v1::GetHistoryRequest { job_id: job_id(), ..Default::default() });
    fuzz(v1::ShareJobRequest { job_id: job_id(), expires_in_seconds: 60 });
    fuzz(v1::WatchJobRequest { job_id: job_id(), after_seq: 7 });
    fuzz(v1::CancelJobRequest { job_id: job_id(), reason: "why".into() });
    fuzz(v1::PauseJobRequest { job_id: job_id(), reason: "why".into() });
    fuzz(v1::ResumeJobRequest { job_id: job_id() });
    fuzz(v1::RetryJobRequest { job_id: job_id() });
    fuzz(v1::UpdateJobRequest { job_id: job_id(), priority: Some(3), max_parallel: Some(2) });
    fuzz(v1::DeleteJobRequest { job_id: job_id() });
    fuzz(v1::ListArtifactsRequest { job_id: job_id(), page_size: 3, page_token: "2-0".into() });
    fuzz(v1::FindMissingBlobsRequest { blobs: vec![blob().unwrap(); 3], job_id: job_id() });
    fuzz(v1::WriteBlobRequest {
        blob: blob(),
        offset_bytes: 3,
        data: vec![1, 2, 3].into(),
        finish: true,
        job_id: job_id(),
    });
    let file = v1::DatasetFile { path: "images/a.jpg".into(), blob: blob() };
    fuzz(v1::BeginUploadRequest {
        dataset_id: "reef".into(),
        request_id: "one".into(),
        files: vec![file; 3],
        list: blob(),
    });
    fuzz(v1::CommitDatasetRequest { dataset_id: "reef".into() });
    fuzz(v1::GetDatasetRequest { dataset_id: "reef".into() });
    fuzz(v1::ListDatasetsRequest { page_size: 7, page_token: "reef/00000000".into() });
    fuzz(v1::InspectDatasetRequest { dataset_id: "reef".into(), config_json: "{}".into() });
    fuzz(v1::DeleteDatasetRequest { dataset_id: "reef".into() });
    fuzz(v1::QueryBlobRequest { blob: blob(), job_id: job_id() });
    fuzz(v1::SignWriteRequest { blob: blob(), job_id: job_id(), offset_bytes: 0, in_parts: true });
    fuzz(v1::FinishWriteRequest {
        blob: blob(),
        upload: "0".repeat(64),
        job_id: job_id(),
        offset_bytes: 1 << 20,
    });
    fuzz(v1::ReadBlobRequest { digest: "0".repeat(64), offset_bytes: 3, job_id: job_id(), direct: true });
}

#[test]
fn fuzzed_messages_of_workers_are_decoded_or_refused() {
    let progress = v1::Progress { iteration: 7, loss: 0.1, ..Default::default() };
    let capabilities = worker::Capabilities {
        adapter: "GPU".into(),
        stages: vec![2, 3],
        memory_bytes: 1 << 33,
        ..Default::default()
    };
    fuzz(worker::RegisterRequest {
        worker_name: "one".into(),
        incarnation: "6f9619ff-8b86-4d01-b42d-00cf4fc964ff".into(),
        build_version: "0.1".into(),
        protocol_version: 3,
        capabilities: Some(capabilities),
        held: vec![lease().unwrap(); 2],
    });
    fuzz(worker::ClaimRequest {
        incarnation: "6f9619ff-8b86-4d01-b42d-00cf4fc964ff".into(),
        request_id: "r".into(),
        wait_ms: 100,
    });
    let renewal = worker::RenewRequest {
        incarnation: "6f9619ff-8b86-4d01-b42d-00cf4fc964ff".into(),
        renewals: vec![worker::Renewal {
            lease: lease(),
            progress: Some(progress),
            measured: vec![measured()],
        }],
    };
    fuzz(worker::SessionRequest { renewal: Some(renewal.clone()) });
    fuzz(renewal);
    fuzz(worker::CheckpointRequest { lease: lease(), blob: blob(), iteration: 7 });
    let named = worker::NamedBlob { artifact: worker::Artifact::Evaluation.into(), blob: blob() };
    fuzz(worker::CompleteRequest {
        lease: lease(),
        result: blob(),
        stats: Some(task_stats()),
        further: vec![named],
    });
    fuzz(worker::FailRequest { lease: lease(), class: 2, message: "why".into() });
    let line = worker::LogLine { number: 1, message: "why".into(), ..Default::default() };
    fuzz(worker::AppendLogsRequest { lease: lease(), lines: vec![line; 2] });
    fuzz(worker::ReleaseRequest { lease: lease(), reason: "why".into() });
}

#[test]
fn fuzzed_messages_of_operators_are_decoded_or_refused() {
    fuzz(admin::CordonWorkerRequest { worker_id: "uuid".into(), reason: "why".into() });
    fuzz(admin::DrainWorkerRequest { worker_id: "uuid".into(), reason: "why".into() });
    fuzz(admin::UncordonWorkerRequest { worker_id: "uuid".into() });
    let quota = Some(admin::Quota { max_open_jobs: 1, max_parallel: 2, max_bytes: 3 });
    fuzz(admin::SetQuotaRequest { tenant: "reef".into(), quota });
    fuzz(admin::IssueTokenRequest {
        name: "ci".into(),
        role: admin::Role::Submitter.into(),
        tenant: "reef".into(),
        expires_in_seconds: 60,
    });
    fuzz(admin::RevokeTokenRequest { token_id: "0123456789ab".into(), even_last: true });
}

/// Messages in blobs are read by prost too; their values are tested in `blobs`.
#[test]
fn fuzzed_specifications_of_tasks_are_decoded_or_refused() {
    use worker::task_spec::Work;
    let common = worker::CommonSpec {
        views: vec![1, 2, 300],
        max_resolution_px: 1600,
        iterations: 7000,
        max_gaussians: 100_000,
        scene_extent: 3.5,
        held_out: vec![0, 8],
        clear_ranges: vec![0.0, 3.5],
        ..Default::default()
    };
    let focus = Some(worker::FocusBox::default());
    for work in [
        Work::Global(worker::GlobalSpec { view_weights: vec![1.0, 2.0] }),
        Work::Partition(worker::PartitionSpec {
            index: 3,
            focus,
            neighbours: vec![1, 2],
            ..Default::default()
        }),
    ] {
        fuzz(worker::TaskSpec { format: 2, common: Some(common.clone()), work: Some(work) });
    }
}

/// Clients and workers read answers, and may have a wrong address.
#[test]
fn fuzzed_answers_of_a_coordinator_are_decoded_or_refused() {
    let time = prost_types::Timestamp { seconds: 1_700_000_000, nanos: 5 };
    let task = v1::Task {
        task_id: "partition-0003".into(),
        progress: Some(v1::Progress { iteration: 7, ..Default::default() }),
        last_errors: vec!["why".into()],
        ..Default::default()
    };
    let job = v1::Job {
        job_id: job_id(),
        name: "wreck".into(),
        create_time: Some(time),
        manifest: blob(),
        tasks: vec![task; 2],
        ..Default::default()
    };
    let changed = v1::TaskChanged { task_id: "merge".into(), message: "why".into(), ..Default::default() };
    fuzz(v1::JobEvent {
        job_id: job_id(),
        seq: 7,
        time: Some(time),
        event: Some(v1::job_event::Event::TaskChanged(changed)),
    });
    fuzz(v1::ListJobsResponse { jobs: vec![job.clone()], next_page_token: "a-0".into() });
    fuzz(job);
    let artifact = v1::Artifact { path: "model.ply".into(), blob: blob() };
    let dataset = v1::Dataset {
        dataset_id: "reef".into(),
        root: blob(),
        files: 3,
        create_time: Some(time),
        ..Default::default()
    };
    fuzz(v1::BeginUploadResponse {
        dataset: Some(dataset.clone()),
        missing: vec![blob().unwrap(); 2],
        missing_count: 2,
    });
    fuzz(v1::ListDatasetsResponse { datasets: vec![dataset.clone(); 2], next_page_token: "reef/0".into() });
    fuzz(dataset);
    fuzz(v1::ListArtifactsResponse { artifacts: vec![artifact; 2], next_page_token: "2-0".into() });
    fuzz(v1::FindMissingBlobsResponse { missing: vec![blob().unwrap(); 2] });
    fuzz(v1::WriteBlobResponse { committed_size_bytes: 7, complete: true });
    fuzz(v1::QueryBlobResponse { committed_size_bytes: 7, complete: true, direct: true });
    fuzz(v1::ReadBlobResponse {
        offset_bytes: 7,
        size_bytes: 9,
        data: vec![1, 2].into(),
        url: "http://reef/1".into(),
    });
    fuzz(worker::RegisterResponse {
        lease_ms: 30_000,
        renew_every_ms: 7500,
        accepted: vec![lease().unwrap()],
        abandon: vec![lease().unwrap()],
    });
    let assignment = worker::Assignment {
        lease: lease(),
        stage: 3,
        lease_ms: 30_000,
        config_json: "{}".into(),
        manifest: blob(),
        spec: blob(),
        inputs: vec![worker::NamedBlob { artifact: 3, blob: blob() }],
        ..Default::default()
    };
    fuzz(worker::ClaimResponse { assignment: Some(assignment) });
    let outcome = worker::RenewOutcome { lease: lease(), verdict: 1, reason: "why".into() };
    let renewed = worker::RenewResponse { outcomes: vec![outcome; 2] };
    fuzz(worker::SessionResponse { renewed: Some(renewed.clone()) });
    fuzz(renewed);
    fuzz(v1::LogEntry {
        time: Some(time),
        task_id: "merge".into(),
        message: "why".into(),
        ..Default::default()
    });
    let token = admin::Token { token_id: "a".into(), create_time: Some(time), ..Default::default() };
    fuzz(admin::IssueTokenResponse { secret: "fathom_a_b".into(), token: Some(token.clone()) });
    fuzz(admin::ListTokensResponse { tokens: vec![token.clone(); 2] });
    fuzz(token);
    let quota = admin::Quota { max_open_jobs: 1, max_parallel: 2, max_bytes: 3 };
    let tenant = admin::Tenant { name: "reef".into(), quota: Some(quota), bytes: 7, ..Default::default() };
    fuzz(admin::ListTenantsResponse { tenants: vec![tenant.clone(); 2] });
    fuzz(tenant);
    let held = admin::HeldTask { job_id: job_id(), task_id: "merge".into(), attempt: 1, since: Some(time) };
    let known = admin::Worker {
        worker_id: "uuid".into(),
        name: "one".into(),
        held: vec![held],
        ..Default::default()
    };
    fuzz(known.clone());
    fuzz(admin::ListWorkersResponse { workers: vec![known; 2] });
}
