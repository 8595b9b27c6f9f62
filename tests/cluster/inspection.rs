//! A folder of photographs and cameras as it is on a user's disk, sent as a dataset: the coordinator reads
//! it, plans it, and makes jobs of it.

use crate::callers::{is, said};
use crate::support::{FakeTrainer, TestCluster};
use fathom_core::picture::encode_png;
use fathom_core::scene::{BlobRef, Manifest};
use fathom_proto::v1;
use fathom_worker::blobs::{BlobSource, to_proto};
use tonic::Code;

/// A dataset of these files.
async fn dataset(cluster: &TestCluster, id: &str, files: &[(String, Vec<u8>)]) {
    let mut listed = Vec::new();
    for (path, bytes) in files {
        let blob = cluster.blobs().upload(&BlobSource::Bytes(bytes.clone().into())).await.unwrap();
        listed.push(v1::DatasetFile { path: path.clone(), blob: Some(to_proto(&blob)) });
    }
    let begin = v1::BeginUploadRequest {
        dataset_id: id.into(),
        request_id: id.into(),
        files: listed,
        ..Default::default()
    };
    cluster.uploads().begin_upload(begin).await.unwrap();
    cluster.uploads().commit_dataset(v1::CommitDatasetRequest { dataset_id: id.into() }).await.unwrap();
}

async fn inspect(cluster: &TestCluster, id: &str, config: &str) -> Result<v1::Inspection, tonic::Status> {
    let request = v1::InspectDatasetRequest { dataset_id: id.into(), config_json: config.into() };
    cluster.uploads().inspect_dataset(request).await.map(tonic::Response::into_inner)
}

/// The scene of the cluster as COLMAP writes it.
fn colmap(scene: &Manifest) -> Vec<(String, Vec<u8>)> {
    let mut files = Vec::new();
    let mut images = String::new();
    for (index, view) in scene.views.iter().enumerate() {
        let (q, t) = (view.pose.rotation, view.pose.translation);
        images.push_str(&format!(
            "{} {} {} {} {} {} {} {} 1 {}\n\n",
            index + 1,
            q.w,
            q.x,
            q.y,
            q.z,
            t.x,
            t.y,
            t.z,
            view.name
        ));
        let picture = encode_png(64, 48, &[100 + index as u8; 64 * 48 * 3]).unwrap();
        files.push((format!("images/{}", view.name), picture));
    }
    let points: String = (0..400)
        .map(|i| format!("{} {} 0 {} 120 130 140 0.5\n", i + 1, i % 20 - 10, f64::from(i) / 20.0 - 10.0))
        .collect();
    for (name, text) in
        [("cameras", "1 PINHOLE 64 48 50 50 32 24\n".to_owned()), ("images", images), ("points3D", points)]
    {
        files.push((format!("sparse/0/{name}.txt"), text.into_bytes()));
    }
    files
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_folder_is_checked_planned_and_trained_from_its_dataset() {
    let cluster = TestCluster::start().await;
    let mut files = colmap(&cluster.manifest);
    files.push(("notes/read me.md".into(), b"of no use".to_vec()));
    dataset(&cluster, "wreck", &files).await;
    let config = r#"{"partition": {"columns": 2}, "train": {"iterations": 400}}"#;
    let found = inspect(&cluster, "wreck", config).await.unwrap();
    assert_eq!(found.source, "COLMAP text");
    assert_eq!((found.views, found.masks, found.cameras, found.points), (16, 0, 1, 400));
    assert_eq!((found.partitions, found.held_out), (2, 2));
    assert!((0.0..=1.0).contains(&found.unseen.unwrap()));

    let read = async |blob: &v1::BlobRef| {
        let to = cluster.dir.path().join(&blob.digest);
        let blob = BlobRef { digest: blob.digest.clone(), bytes: blob.size_bytes };
        cluster.blobs().download(&blob, &to).await.unwrap();
        std::fs::read(to).unwrap()
    };
    let manifest = Manifest::from_json(&read(found.manifest.as_ref().unwrap()).await).unwrap();
    assert_eq!(manifest.cameras, cluster.manifest.cameras);
    for (ours, theirs) in manifest.views.iter().zip(&cluster.manifest.views) {
        assert_eq!((&ours.name, &ours.image), (&theirs.name, &theirs.image));
        assert!(ours.pose.translation.distance(theirs.pose.translation) < 1e-9);
    }
    let plan = read(found.plan.as_ref().unwrap()).await;
    let create = |request: &str, manifest| v1::CreateJobRequest {
        request_id: request.into(),
        name: request.into(),
        config_json: config.into(),
        dataset_id: "wreck".into(),
        manifest,
        ..Default::default()
    };
    // With the manifest of the check, and without: the coordinator reads the scene again.
    let _worker = cluster.worker(FakeTrainer::quick());
    for (request, given) in [("checked", found.manifest.clone()), ("at once", None)] {
        let job = cluster.jobs().create_job(create(request, given)).await.unwrap().into_inner();
        assert_eq!(job.manifest, found.manifest, "{request}");
        let job = cluster.finished(&job.job_id).await;
        assert_eq!(job.state(), v1::JobState::Succeeded, "{}", job.error);
        assert_eq!(read(job.plan.as_ref().unwrap()).await.len(), plan.len(), "another plan than the check's");
    }
    let staged = std::fs::read_dir(cluster.dir.path().join("data/objects/staging")).unwrap();
    assert_eq!(staged.count(), 0, "a copy of the scene is still there");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dataset_without_a_scene_is_refused_with_the_reason() {
    let cluster = TestCluster::start().await;
    let good = colmap(&cluster.manifest);
    let refused = async |id: &str, files: Vec<(String, Vec<u8>)>, parts: &[&str]| {
        dataset(&cluster, id, &files).await;
        let status = inspect(&cluster, id, "").await.unwrap_err();
        for part in parts {
            assert!(status.message().contains(part), "{id}: {:?} does not say {part:?}", status.message());
        }
        assert!(!status.message().contains("staging"), "a path of the coordinator: {}", status.message());
        assert_eq!(said(Err::<(), _>(status)), is(Code::FailedPrecondition, "BAD_SCENE"), "{id}");
    };
    refused("notes", vec![("a.txt".into(), b"hello".to_vec())], &["the dataset holds no scene"]).await;
    let mut cut = good.clone();
    cut[3].1.truncate(20);
    refused("cut", cut, &["images/view_03.png"]).await;
    let mut unposed = good.clone();
    unposed.retain(|(path, _)| !path.starts_with("images/"));
    refused("unposed", unposed, &["sparse/0/images.txt", "none of its 16 images exists"]).await;

    // Files beside the dataset exist for this process; a path to them is refused before it is followed.
    let beside = cluster.dir.path().join("secret.png");
    std::fs::write(&beside, encode_png(64, 48, &[7; 64 * 48 * 3]).unwrap()).unwrap();
    for path in [beside.to_str().unwrap(), "../../../../secret.png", "images/../../../../secret.png"] {
        let frame = |path: &str| {
            serde_json::json!({
                "file_path": path, "mask_path": null,
                "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
            })
        };
        for (of, transforms) in [
            ("file_path", serde_json::json!({"fl_x": 50, "w": 64, "h": 48, "frames": [frame(path)]})),
            (
                "ply_file_path",
                serde_json::json!({"fl_x": 50, "w": 64, "h": 48, "ply_file_path": path, "frames": [frame("a.png")]}),
            ),
        ] {
            let id = format!("leaves-{}-{of}", path.len());
            let files = vec![
                ("transforms.json".to_owned(), transforms.to_string().into_bytes()),
                ("a.png".to_owned(), std::fs::read(&beside).unwrap()),
            ];
            refused(&id.replace('_', "-"), files, &["transforms.json", of, "inside the dataset"]).await;
        }
    }
    let unknown = inspect(&cluster, "nowhere", "").await;
    assert_eq!(said(unknown), is(Code::NotFound, "DATASET_NOT_FOUND"));
    let setting = inspect(&cluster, "notes", r#"{"no": 1}"#).await;
    assert_eq!(said(setting), is(Code::InvalidArgument, "BAD_ARGUMENT"));
}
