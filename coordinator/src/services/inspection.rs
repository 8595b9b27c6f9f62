//! InspectDataset: reads the scene in a dataset, and plans it, before there is a job.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use fathom_core::CoreError;
use fathom_core::config::{JobConfig, Method};
use fathom_core::cover::predicted_unseen;
use fathom_core::scene::{BlobRef, Manifest, ManifestView, Points, Scene, load_foreign_scene};
use fathom_merge::Files;
use fathom_observe::threads;
use fathom_proto::v1;
use tokio::sync::{Semaphore, SemaphorePermit};
use uuid::Uuid;

use super::datasets::Read;
use super::jobs::config_of;
use super::uploads::MAX_BLOBS;
use super::{datasets, encode, manifests, turn_to_read};
use crate::access::Principal;
use crate::datasets::FileList;
use crate::objects::{BlobStore, ObjectError};
use crate::own_tasks::OwnTaskError;
use crate::own_tasks::input::{JobInput, MAX_MANIFEST_BYTES, blocking};
use crate::own_tasks::plan::{planned, warnings_of};
use crate::schedule::FailClass;
use crate::service_error::ServiceError;
use crate::state::State;
use crate::store::StoreError;

/// Scenes that are read at a time, of all callers: each is in memory, and where blobs are in a bucket, a copy
/// of its files is on the disk. A caller that has gone keeps its place until the reading has ended.
static PLACES: Semaphore = Semaphore::const_new(1);
/// Longest wait for a place.
const PLACE_WITHIN: Duration = Duration::from_secs(120);
/// Longest descriptions (cameras, poses, points) of a scene, bytes.
const MAX_DESCRIPTION_BYTES: u64 = 1 << 30;
/// Longest ones in JSON: parsed, these take many times their length.
const MAX_JSON_BYTES: u64 = 64 << 20;
/// Most files of a scene.
const MAX_FILES: usize = 500_000;
/// Longest warning or error, characters: a hostile file may have names of any length.
const MAX_TEXT: usize = 1000;
/// Memory of a description, as a multiple of its length, and how many times more it is for JSON.
const DESCRIPTION_TAKES: u64 = 4;
const JSON_TAKES: u64 = 8;

/// What a job would train on.
pub async fn inspect(
    shared: &State,
    caller: &Principal,
    request: v1::InspectDatasetRequest,
) -> Result<v1::Inspection, ServiceError> {
    let v1::InspectDatasetRequest { dataset_id, config_json } = request;
    let config = config_of(if config_json.is_empty() { "{}" } else { &config_json })?;
    let tenant = caller.home();
    let (record, list) = datasets::committed(shared, &tenant, &dataset_id.parse()?).await?;
    let objects = shared.objects.of(&tenant).await?;
    // It writes small files.
    shared.objects.check_space(0).await?;
    shared.check_bytes(&tenant, 0).await?;
    let (blob, mut warnings) = match datasets::manifest_in(&list.value) {
        Some(blob) => {
            let blob = encode::required_blob("manifest", Some(blob))?;
            manifests::check(&objects, &blob, Some(list)).await?;
            (blob, Vec::new())
        }
        None => read_scene(&objects, list, &config).await?,
    };
    let place = place().await?;
    let turn = turn_to_read(DESCRIPTION_TAKES * blob.bytes).await;
    let bytes = objects.read_at_most(&blob, MAX_MANIFEST_BYTES).await?;
    let input = JobInput::parse(config.clone(), &bytes).map_err(fault_of_plan)?;
    drop(turn);
    let turn = turn_to_read(DESCRIPTION_TAKES * blob.bytes.saturating_add(input.manifest.points.bytes)).await;
    let points = objects.read_at_most(&input.manifest.points, MAX_DESCRIPTION_BYTES).await?;
    let connected = shared.workers.connected(&tenant);
    let planning = blocking(move || {
        let (_place, _turn) = (place, turn);
        let points = Points::from_bytes(&points).map_err(|error| OwnTaskError::input(error.to_string()))?;
        let (plan, views) = planned(&input, &points, connected)?;
        let cameras: Vec<_> = views.iter().map(|view| (view.camera, view.pose)).collect();
        let unseen = predicted_unseen(&cameras, &plan.held_out, &points);
        let json =
            serde_json::to_vec_pretty(&plan).map_err(|error| OwnTaskError::failed(error.to_string()))?;
        Ok((plan, json, input.manifest, unseen))
    });
    let (plan, json, manifest, unseen) = planning.await.map_err(fault_of_plan)?;
    warnings.extend(warnings_of(&plan, &config, connected));
    let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
    tracing::info!(dataset = %record.id, %tenant, views = manifest.views.len(), by = %caller.name, "dataset inspected");
    Ok(v1::Inspection {
        views: count(manifest.views.len()),
        masks: count(manifest.views.iter().filter(|view| view.mask.is_some()).count()),
        held_out: count(plan.held_out.len()),
        cameras: count(manifest.cameras.len()),
        points: u32::try_from(plan.points).unwrap_or(u32::MAX),
        partitions: count(plan.partitions.len()),
        warnings,
        plan: Some(encode::blob(&objects.put(json.into()).await?)),
        manifest: Some(encode::blob(&blob)),
        unseen,
        source: manifest.source,
    })
}

/// The manifest of the scene in a dataset that has no manifest of its own.
pub async fn manifest_of(
    objects: &Arc<BlobStore>,
    list: Read<FileList>,
    config: &JobConfig,
) -> Result<BlobRef, ServiceError> {
    Ok(read_scene(objects, list, config).await?.0)
}

/// A place to read a scene.
async fn place() -> Result<SemaphorePermit<'static>, ServiceError> {
    let waited = tokio::time::timeout(PLACE_WITHIN, PLACES.acquire()).await;
    // It is never closed.
    waited.ok().and_then(Result::ok).ok_or(ServiceError::ReadsOtherScenes)
}

/// Reads the scene in a dataset and stores its points and its manifest; returns the manifest and the warnings
/// of the reader.
async fn read_scene(
    objects: &Arc<BlobStore>,
    list: Read<FileList>,
    config: &JobConfig,
) -> Result<(BlobRef, Vec<String>), ServiceError> {
    let (mut described_bytes, mut json_bytes, mut all_bytes) = (0_u64, 0_u64, 0_u64);
    let mut files: HashMap<String, BlobRef> = HashMap::new();
    for file in list.value.files() {
        match kind_of(file.path) {
            Kind::Other => continue,
            Kind::Picture => {}
            Kind::Description => described_bytes = described_bytes.saturating_add(file.bytes),
            Kind::Json => json_bytes = json_bytes.saturating_add(file.bytes),
        }
        all_bytes = all_bytes.saturating_add(file.bytes);
        files.insert(file.path.to_owned(), file.blob());
    }
    // Its memory is needed by others while this one waits.
    drop(list);
    let refuse = |what: String| {
        let advice = "upload the scene with `fathom dataset upload`, which reads it before";
        Err(ServiceError::BadScene(format!("{what}; {advice}")))
    };
    if described_bytes > MAX_DESCRIPTION_BYTES {
        return refuse(format!(
            "its cameras, poses and points have {described_bytes} bytes, and a coordinator reads at most \
             {MAX_DESCRIPTION_BYTES}"
        ));
    }
    if json_bytes > MAX_JSON_BYTES {
        return refuse(format!(
            "its JSON files have {json_bytes} bytes, and a coordinator reads at most {MAX_JSON_BYTES}"
        ));
    }
    if files.len() > MAX_FILES {
        return refuse(format!("it has {} files, and a coordinator reads at most {MAX_FILES}", files.len()));
    }
    let place = place().await?;
    objects.check_staging(all_bytes).await?;
    require(objects, &files).await?;
    let described_bytes = described_bytes.saturating_add(JSON_TAKES * json_bytes);
    let turn = turn_to_read(DESCRIPTION_TAKES * described_bytes).await;
    let folder = objects.staging_path(&format!("scene-{}", Uuid::new_v4()));
    let mut from = Vec::with_capacity(files.len());
    for (path, blob) in &files {
        from.push((path.clone(), objects.path_of(blob)?));
    }
    let (readable, on_disk) = (objects.files(), objects.is_on_disk());
    let (data, method) = (config.data.clone(), config.method);
    let read = threads::blocking(move || {
        let (_place, _turn) = (place, turn);
        let staged = Staged::new(folder)?;
        for (path, blob) in from {
            staged.add(&path, &*readable, &blob, on_disk)?;
        }
        let scene = load_foreign_scene(&staged.0, &data).map_err(|error| staged.fault(error))?;
        let warnings = scene.warnings.iter().map(|warning| staged.without_folder(warning)).collect();
        let (manifest, points) = manifest_and_points(&staged, scene, &files, method)?;
        Ok((manifest, points, warnings))
    });
    let read: Result<(Manifest, Vec<u8>, Vec<String>), ServiceError> = read
        .await
        .unwrap_or_else(|error| Err(StoreError::Failed(format!("reading a scene: {error}")).into()));
    let (manifest, points, warnings) = read?;
    objects.put(points.into()).await?;
    let json = manifest.to_json().map_err(|error| ServiceError::BadScene(error.to_string()))?;
    if json.len() as u64 > MAX_MANIFEST_BYTES {
        return Err(ServiceError::BadScene(format!(
            "its manifest would have {} bytes, and at most {MAX_MANIFEST_BYTES} are allowed: it has too many photographs",
            json.len()
        )));
    }
    Ok((objects.put(json.into()).await?, warnings))
}

/// Refuses a dataset whose blobs the store has lost.
async fn require(objects: &BlobStore, files: &HashMap<String, BlobRef>) -> Result<(), ServiceError> {
    let named: Vec<(&String, &BlobRef)> = files.iter().collect();
    for some in named.chunks(MAX_BLOBS) {
        let blobs: Vec<BlobRef> = some.iter().map(|(_, blob)| (*blob).clone()).collect();
        let missing = objects.missing(&blobs).await?;
        if let Some(&first) = missing.first() {
            let (name, digest) = (some[first].0.clone(), some[first].1.digest.clone());
            return Err(ServiceError::FilesMissing {
                of: "dataset",
                count: missing.len() as u64,
                name,
                digest,
            });
        }
    }
    Ok(())
}

/// What readers of scenes do with a file.
enum Kind {
    /// They read it into memory: cameras, poses, points.
    Description,
    /// The same, and parse it as JSON.
    Json,
    /// They read its header.
    Picture,
    /// Nothing.
    Other,
}

fn kind_of(path: &str) -> Kind {
    let ending = path.rsplit_once('.').map_or("", |(_, ending)| ending).to_ascii_lowercase();
    match ending.as_str() {
        "bin" | "txt" | "ply" => Kind::Description,
        "json" => Kind::Json,
        "jpg" | "jpeg" | "png" | "tif" | "tiff" => Kind::Picture,
        _ => Kind::Other,
    }
}

/// The manifest of a scene with the digests of its dataset, and the bytes of its points.
fn manifest_and_points(
    staged: &Staged,
    scene: Scene,
    files: &HashMap<String, BlobRef>,
    method: Method,
) -> Result<(Manifest, Vec<u8>), ServiceError> {
    let blob_of = |path: &Path| -> Result<BlobRef, ServiceError> {
        let inside = path.strip_prefix(&staged.0).unwrap_or(path).to_string_lossy().replace('\\', "/");
        let blob = files.get(&inside).cloned();
        blob.ok_or_else(|| ServiceError::BadScene(format!("{inside} is not among the files of the dataset")))
    };
    let mut views = Vec::with_capacity(scene.views.len());
    for view in scene.views {
        let image = view.image.as_deref().ok_or_else(|| {
            ServiceError::BadScene(format!("view {} has no photograph in the dataset", view.name))
        })?;
        views.push(ManifestView {
            image: blob_of(image)?,
            mask: view.mask.as_deref().map(blob_of).transpose()?,
            name: view.name,
            camera_id: view.camera_id,
            pose: view.pose,
        });
    }
    let points = scene.points.to_bytes_for(method);
    let manifest = Manifest {
        format: Manifest::FORMAT,
        source: scene.source.to_owned(),
        cameras: scene.cameras,
        views,
        points: BlobRef::of(&points),
    };
    Ok((manifest, points))
}

/// A folder with the files of a dataset under their names. It is removed at the end.
struct Staged(PathBuf);

impl Staged {
    fn new(folder: PathBuf) -> Result<Self, ServiceError> {
        let made = fs::create_dir_all(&folder).and_then(|()| fs::canonicalize(&folder));
        made.map(Self).map_err(|error| io_fault("create", &folder, error))
    }

    /// Adds a blob: as another name of its file where it is on the same disk, otherwise as a copy.
    fn add(&self, path: &str, files: &dyn Files, blob: &Path, on_disk: bool) -> Result<(), ServiceError> {
        let to = self.0.join(path);
        let add = || -> io::Result<()> {
            if let Some(parent) = to.parent() {
                fs::create_dir_all(parent)?;
            }
            if on_disk && fs::hard_link(blob, &to).is_ok() {
                return Ok(());
            }
            let mut copy = fs::File::create_new(&to)?;
            io::copy(&mut files.open(blob)?.0, &mut copy)?;
            Ok(())
        };
        add().map_err(|error| io_fault("write", &to, error))
    }

    /// A message about a file of the folder, as its owner knows the file.
    fn without_folder(&self, message: &str) -> String {
        let folder = self.0.display().to_string();
        let message = message.replace(&format!("{folder}{}", std::path::MAIN_SEPARATOR), "");
        let message = message.replace(&format!("{folder}: "), "the dataset ").replace(&folder, "the dataset");
        short(message)
    }

    fn fault(&self, error: CoreError) -> ServiceError {
        match error {
            CoreError::Io { action, path, source } => ObjectError::Io { action, path, source }.into(),
            error => ServiceError::BadScene(self.without_folder(&error.to_string())),
        }
    }
}

impl Drop for Staged {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.0) {
            tracing::warn!(%error, path = %self.0.display(), "cannot remove the copy of a scene; the next start does");
        }
    }
}

fn io_fault(action: &'static str, path: &Path, source: io::Error) -> ServiceError {
    ObjectError::Io { action, path: path.to_owned(), source }.into()
}

fn fault_of_plan(error: OwnTaskError) -> ServiceError {
    match error.class {
        FailClass::Input => ServiceError::BadScene(short(error.message)),
        _ => StoreError::Failed(format!("planning a scene: {}", error.message)).into(),
    }
}

/// The beginning of a long text.
fn short(text: String) -> String {
    match text.char_indices().nth(MAX_TEXT) {
        Some((end, _)) => format!("{} ...", &text[..end]),
        None => text,
    }
}
