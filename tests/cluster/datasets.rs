//! Datasets over loopback: uploaded once, they are checked, committed, kept, and used by jobs.

use std::time::Duration;

use crate::callers::{is, said};
use crate::support::{FakeTrainer, TestCluster, reason_of};
use bytes::Bytes;
use fathom_coordinator::retention::Policy;
use fathom_core::scene::{BlobRef, Manifest};
use fathom_proto::v1;
use fathom_worker::blobs::{BlobSource, to_proto};
use tonic::Code;
use tonic_types::StatusExt;

fn file(path: &str, blob: &BlobRef) -> v1::DatasetFile {
    v1::DatasetFile { path: path.into(), blob: Some(to_proto(blob)) }
}

fn begin(id: &str, files: Vec<v1::DatasetFile>) -> v1::BeginUploadRequest {
    v1::BeginUploadRequest { dataset_id: id.into(), request_id: format!("begin {id}"), files, list: None }
}

fn commit(id: &str) -> v1::CommitDatasetRequest {
    v1::CommitDatasetRequest { dataset_id: id.into() }
}

/// The files of the cluster's scene, and its manifest beside them.
fn scene(manifest: &Manifest) -> (Bytes, Vec<v1::DatasetFile>) {
    let json = Bytes::from(manifest.to_json().unwrap());
    let mut files = vec![file("points.bin", &manifest.points), file("manifest.json", &BlobRef::of(&json))];
    files.extend(manifest.views.iter().map(|view| file(&format!("images/{}", view.name), &view.image)));
    (json, files)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_complete_dataset_is_committed_and_serves_many_jobs() {
    let mut cluster = TestCluster::start().await;
    let (json, files) = scene(&cluster.manifest);
    let begun = cluster.uploads().begin_upload(begin("wreck", files.clone())).await.unwrap().into_inner();
    let dataset = begun.dataset.unwrap();
    assert_eq!((dataset.state(), dataset.files), (v1::DatasetState::Uploading, 18));
    assert!(dataset.expire_time.is_some() && dataset.commit_time.is_none());
    // The photographs exist already; only the manifest is missing.
    assert_eq!((begun.missing_count, begun.missing), (1, vec![to_proto(&BlobRef::of(&json))]));
    let early = cluster.uploads().commit_dataset(commit("wreck")).await;
    assert_eq!(said(early), is(Code::FailedPrecondition, "BLOB_NOT_FOUND"));
    let create = |request: &str, dataset: &str, manifest| v1::CreateJobRequest {
        request_id: request.into(),
        name: request.into(),
        config_json: r#"{"partition": {"columns": 1}, "train": {"iterations": 400}}"#.into(),
        dataset_id: dataset.into(),
        manifest,
        ..Default::default()
    };
    let early = cluster.jobs().create_job(create("early", "wreck", None)).await;
    assert_eq!(said(early), is(Code::FailedPrecondition, "DATASET_NOT_COMMITTED"));

    cluster.blobs().upload(&BlobSource::Bytes(json.clone())).await.unwrap();
    let frozen = cluster.uploads().commit_dataset(commit("wreck")).await.unwrap().into_inner();
    assert_eq!(frozen.state(), v1::DatasetState::Committed);
    cluster.restart().await;
    // A retry after lost replies, in another order, gives the same dataset.
    let reversed = files.iter().rev().cloned().collect();
    let again = cluster.uploads().begin_upload(begin("wreck", reversed)).await.unwrap().into_inner();
    assert_eq!((again.dataset, again.missing_count), (Some(frozen.clone()), 0));
    assert_eq!(cluster.uploads().commit_dataset(commit("wreck")).await.unwrap().into_inner(), frozen);
    // The root digest is that of the file list, a blob in the format of the proto.
    let list = cluster.dir.path().join("list");
    let root = fathom_worker::blobs::from_proto(frozen.root.clone().unwrap());
    cluster.blobs().download(&root, &list).await.unwrap();
    let mut sorted = files.clone();
    sorted.sort_by(|a, b| a.path.cmp(&b.path));
    let line = |file: &v1::DatasetFile| {
        let blob = file.blob.as_ref().unwrap();
        format!("{} {} {}\n", blob.digest, blob.size_bytes, file.path)
    };
    assert_eq!(std::fs::read_to_string(&list).unwrap(), sorted.iter().map(line).collect::<String>());

    let other = cluster.uploads().begin_upload(begin("wreck", files[..3].to_vec())).await;
    assert_eq!(said(other), is(Code::AlreadyExists, "REQUEST_ID_REUSED"));
    let other =
        v1::BeginUploadRequest { request_id: "another".into(), ..begin("wreck", files[..3].to_vec()) };
    assert_eq!(said(cluster.uploads().begin_upload(other).await), is(Code::AlreadyExists, "DATASET_EXISTS"));

    let _worker = cluster.worker(FakeTrainer::quick());
    for request in ["one", "two"] {
        let job = cluster.jobs().create_job(create(request, "wreck", None)).await.unwrap().into_inner();
        assert_eq!(job.dataset_id, "wreck");
        let job = cluster.finished(&job.job_id).await;
        assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
    }
    // A manifest that names a photograph outside the dataset.
    let mut beyond = cluster.manifest.clone();
    beyond.views[0].image = cluster.blobs().upload(&BlobSource::Bytes("elsewhere".into())).await.unwrap();
    let json = Bytes::from(beyond.to_json().unwrap());
    let beyond = cluster.blobs().upload(&BlobSource::Bytes(json)).await.unwrap();
    let refused = cluster.jobs().create_job(create("beyond", "wreck", Some(to_proto(&beyond)))).await;
    let status = refused.unwrap_err();
    assert_eq!(status.code(), Code::InvalidArgument);
    assert!(status.message().contains("view_00.png, which is not among"), "{status}");
    let nowhere = cluster.jobs().create_job(create("nowhere", "reef", None)).await;
    assert_eq!(said(nowhere), is(Code::NotFound, "DATASET_NOT_FOUND"));
    let delete = v1::DeleteDatasetRequest { dataset_id: "wreck".into() };
    assert_eq!(
        said(cluster.uploads().delete_dataset(delete).await),
        is(Code::FailedPrecondition, "DATASET_IN_USE")
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn datasets_are_never_collected_and_abandoned_uploads_expire() {
    let cluster = TestCluster::start().await;
    let upload =
        async |text: &'static str| cluster.blobs().upload(&BlobSource::Bytes(text.into())).await.unwrap();
    let (kept, given_up) = (upload("kept").await, upload("given up").await);
    for (id, blob) in [("kept", &kept), ("given-up", &given_up)] {
        cluster.uploads().begin_upload(begin(id, vec![file("a.jpg", blob)])).await.unwrap();
    }
    cluster.uploads().commit_dataset(commit("kept")).await.unwrap();
    let is_there =
        async |blob: &BlobRef| cluster.blobs().missing(std::slice::from_ref(blob)).await.unwrap().is_empty();
    let round = async |uploads| {
        // A query refreshes a blob's last-used time; no blob counts as recent here.
        let policy = Policy { jobs: None, unused: Duration::ZERO, uploads };
        tokio::time::sleep(Duration::from_millis(20)).await;
        cluster.collect(policy).await
    };
    round(Duration::from_secs(3600)).await;
    assert!(is_there(&kept).await && is_there(&given_up).await, "an upload lost its received bytes");
    round(Duration::ZERO).await;
    assert!(is_there(&kept).await && !is_there(&given_up).await);
    let gone = v1::GetDatasetRequest { dataset_id: "given-up".into() };
    assert_eq!(said(cluster.uploads().get_dataset(gone).await), is(Code::NotFound, "DATASET_NOT_FOUND"));
    let delete = v1::DeleteDatasetRequest { dataset_id: "kept".into() };
    cluster.uploads().delete_dataset(delete).await.unwrap();
    round(Duration::ZERO).await;
    assert!(!is_there(&kept).await);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn many_files_are_named_by_a_list_and_listed_by_page() {
    let cluster = TestCluster::start().await;
    let blob = cluster.blobs().upload(&BlobSource::Bytes("one for all".into())).await.unwrap();
    let many: Vec<String> = (0..10_001).map(|index| format!("{index:05}.jpg")).collect();
    let files: Vec<_> = many.iter().map(|path| file(path, &blob)).collect();
    let refused = cluster.uploads().begin_upload(begin("many", files)).await.unwrap_err();
    assert!(
        refused.code() == Code::InvalidArgument && refused.message().contains("at most 10000"),
        "{refused}"
    );
    let text: String = many.iter().map(|path| format!("{} {} {path}\n", blob.digest, blob.bytes)).collect();
    let list = BlobRef::of(text.as_bytes());
    let request = || v1::BeginUploadRequest { list: Some(to_proto(&list)), ..begin("", Vec::new()) };
    let early = cluster.uploads().begin_upload(request()).await;
    assert_eq!(said(early), is(Code::FailedPrecondition, "BLOB_NOT_FOUND"));
    cluster.blobs().upload(&BlobSource::Bytes(text.into())).await.unwrap();
    let many = cluster.uploads().begin_upload(request()).await.unwrap().into_inner().dataset.unwrap();
    assert_eq!((many.files, many.size_bytes, many.root), (10_001, 110_011, Some(to_proto(&list))));
    let again = cluster.uploads().begin_upload(request()).await.unwrap().into_inner().dataset.unwrap();
    assert_eq!(again.dataset_id, many.dataset_id, "a repeated request made a second dataset");
    let no_list = v1::BeginUploadRequest { list: Some(to_proto(&blob)), ..begin("x", Vec::new()) };
    let refused = cluster.uploads().begin_upload(no_list).await.unwrap_err();
    assert!(refused.message().contains("list: line 1"), "{refused}");

    for id in ["a", "b", "c"] {
        cluster.uploads().begin_upload(begin(id, vec![file("a.jpg", &blob)])).await.unwrap();
    }
    let page = async |page_token: String| {
        let request = v1::ListDatasetsRequest { page_size: 3, page_token };
        cluster.uploads().list_datasets(request).await.map(tonic::Response::into_inner)
    };
    let first = page(String::new()).await.unwrap();
    let ids: Vec<&str> = first.datasets.iter().map(|dataset| dataset.dataset_id.as_str()).collect();
    assert_eq!(ids, ["a", "b", "c"]);
    let rest = page(first.next_page_token.clone()).await.unwrap();
    assert_eq!((rest.datasets.len(), rest.next_page_token.as_str()), (1, ""));
    for wrong in ["c", "c/00000000", &first.next_page_token.replace('c', "b"), "/", "../x"] {
        assert_eq!(said(page(wrong.to_owned()).await), is(Code::InvalidArgument, "BAD_ARGUMENT"), "{wrong}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_invalid_path_is_a_violation_that_names_its_file() {
    let cluster = TestCluster::start().await;
    let blob = BlobRef::of(b"a");
    let paths = ["good.jpg", "../x", "/x", "a\\x", "a\0x", "e\u{301}.jpg", &"x".repeat(1025), "good.jpg"];
    let mut files: Vec<_> = paths.iter().map(|path| file(path, &blob)).collect();
    files.push(v1::DatasetFile { path: "no blob".into(), blob: None });
    let refused = cluster.uploads().begin_upload(begin("bad", files)).await.unwrap_err();
    assert_eq!((refused.code(), reason_of(&refused).as_str()), (Code::InvalidArgument, "BAD_ARGUMENT"));
    let violations = refused.get_details_bad_request().unwrap().field_violations;
    let fields: Vec<&str> = violations.iter().map(|violation| violation.field.as_str()).collect();
    let mut expected: Vec<String> = (1..=7).map(|index| format!("files[{index}].path")).collect();
    expected.push("files[8].blob".into());
    assert_eq!(fields, expected);
    assert!(
        violations[0].description.contains("../x") && violations[4].description.contains("NFC"),
        "{violations:#?}"
    );
    assert!(refused.message().contains("and 7 more"), "{refused}");
    for (wrong, field) in [
        (v1::BeginUploadRequest { request_id: String::new(), ..begin("x", Vec::new()) }, "request_id"),
        (begin("Upper", vec![file("a", &blob)]), "dataset_id"),
        (begin("empty", Vec::new()), "files[0].path"),
    ] {
        let refused = cluster.uploads().begin_upload(wrong).await.unwrap_err();
        assert_eq!(refused.get_details_bad_request().unwrap().field_violations[0].field, field);
    }
}
