//! The datasets of UploadService: begin, commit, get, list, delete.

use fathom_core::scene::BlobRef;
use fathom_observe::threads;
use fathom_proto::v1;
use prost::Message as _;

use super::uploads::MAX_BLOBS;
use super::{Turn, encode, turn_to_read};
use crate::access::Principal;
use crate::datasets::{DatasetId, DatasetRecord, FileList, ListedFile, MANIFEST_PATH, NewDataset};
use crate::objects::BlobStore;
use crate::schedule::Tenant;
use crate::service_error::{ServiceError, check_request_id};
use crate::state::State;
use crate::store::StoreError;

/// Longest list of files, bytes: some two million files.
pub const MAX_LIST_BYTES: u64 = 256 << 20;

/// Memory of a message's files and their list, as a multiple of its length.
const MESSAGE_TAKES: u64 = 3;

fn bad_argument(field: &'static str, message: impl Into<String>) -> ServiceError {
    ServiceError::BadArgument { field, message: message.into() }
}

/// Begins or resumes a dataset.
pub async fn begin(
    shared: &State,
    caller: &Principal,
    request: v1::BeginUploadRequest,
) -> Result<v1::BeginUploadResponse, ServiceError> {
    let _turn = turn_to_read(MESSAGE_TAKES * request.encoded_len() as u64).await;
    let v1::BeginUploadRequest { dataset_id, request_id, files, list } = request;
    check_request_id(&request_id)?;
    let tenant = caller.home();
    let id = match dataset_id.as_str() {
        "" => DatasetId::of_request(&tenant, &request_id),
        id => id.parse()?,
    };
    let objects = shared.objects.of(&tenant).await?;
    let list = match list {
        Some(_) if !files.is_empty() => {
            return Err(bad_argument("list", "is set together with files; set only one of them"));
        }
        Some(list) => read_list(&objects, &encode::required_blob("list", Some(list))?).await?,
        None if files.len() > MAX_BLOBS => {
            let message = format!(
                "has {} entries; at most {MAX_BLOBS} are allowed; upload the list as a blob and set `list`",
                files.len()
            );
            return Err(bad_argument("files", message));
        }
        None => Read {
            value: FileList::new(files.into_iter().map(listed).collect()).map_err(ServiceError::BadFiles)?,
            _turn: None,
        },
    };
    let (mut missing, mut missing_count) = (Vec::new(), 0);
    // The received parts of missing blobs count already.
    let (mut missing_bytes, mut counted_bytes) = (0_u64, 0_u64);
    for some in chunks(list.value.blobs().map(|file| file.blob())) {
        let absent: Vec<&BlobRef> =
            objects.missing(&some).await?.into_iter().map(|index| &some[index]).collect();
        let digests: Vec<&str> = absent.iter().map(|blob| blob.digest.as_str()).collect();
        counted_bytes = counted_bytes.saturating_add(objects.declared_bytes(&digests).await?);
        for blob in absent {
            missing_count += 1;
            missing_bytes = missing_bytes.saturating_add(blob.bytes);
            if missing.len() < MAX_BLOBS {
                missing.push(encode::blob(blob));
            }
        }
    }
    let (count, bytes) = (list.value.count(), list.value.bytes());
    let root = BlobRef::of(list.value.text().as_bytes());
    let list_bytes = if objects.contains(&root).await? { 0 } else { root.bytes };
    let more = missing_bytes.saturating_add(list_bytes);
    objects.check_space(more).await?;
    shared.check_bytes(&tenant, more.saturating_sub(counted_bytes)).await?;
    let Read { value, _turn } = list;
    objects.put(value.into_text().into()).await?;
    let new = NewDataset { id, tenant, request_id, root, files: count, bytes };
    let record = shared.store.begin_dataset(new, shared.clock.now_ms()).await?;
    tracing::info!(dataset = %record.id, tenant = %record.tenant, files = record.files, missing = missing_count, by = %caller.name, "upload of a dataset");
    Ok(v1::BeginUploadResponse { dataset: Some(encoded(shared, &record)), missing, missing_count })
}

/// Freezes a dataset whose blobs are all present.
pub async fn commit(shared: &State, caller: &Principal, id: &str) -> Result<v1::Dataset, ServiceError> {
    let (tenant, id) = (caller.home(), id.parse::<DatasetId>()?);
    let mut record = shared.store.dataset(&tenant, &id).await?;
    if !record.is_committed() {
        let objects = shared.objects.of(&tenant).await?;
        let list = read_list(&objects, &record.root).await?;
        let (mut count, mut first) = (0, None);
        for some in chunks(list.value.blobs()) {
            // Their content was verified on arrival. From here on they are kept for the dataset.
            let blobs: Vec<BlobRef> = some.iter().map(|file| file.blob()).collect();
            let missing = objects.missing(&blobs).await?;
            count += missing.len() as u64;
            first = first.or(missing.first().map(|&index| some[index]));
        }
        if let Some(file) = first {
            let (path, digest) = (file.path.to_owned(), file.digest.to_owned());
            return Err(ServiceError::FilesMissing { of: "dataset", count, name: path, digest });
        }
        record = shared.store.commit_dataset(&tenant, &id, &record.root, shared.clock.now_ms()).await?;
        tracing::info!(dataset = %id, %tenant, by = %caller.name, "dataset committed");
    }
    Ok(encoded(shared, &record))
}

/// One dataset.
pub async fn get(shared: &State, caller: &Principal, id: &str) -> Result<v1::Dataset, ServiceError> {
    let record = shared.store.dataset(&caller.home(), &id.parse()?).await?;
    Ok(encoded(shared, &record))
}

/// One page of the datasets of a tenant.
pub async fn list(
    shared: &State,
    caller: &Principal,
    request: &v1::ListDatasetsRequest,
) -> Result<v1::ListDatasetsResponse, ServiceError> {
    let limit = match request.page_size {
        0 => 100,
        size => size.min(1000) as usize,
    };
    let tenant = caller.home();
    let after = match request.page_token.as_str() {
        "" => None,
        token => {
            let id = token.rsplit_once('/').and_then(|(id, _)| id.parse::<DatasetId>().ok());
            let message = "is not from ListDatasets; begin at the first page";
            let known = id.filter(|id| page_token(&tenant, id) == token);
            Some(known.ok_or_else(|| bad_argument("page_token", message))?)
        }
    };
    let after = after.as_ref().map(|id| (&tenant, id));
    let rows = shared.store.datasets(Some(&tenant), after, limit).await?;
    let next_page_token = match rows.last() {
        Some(last) if rows.len() == limit => page_token(&tenant, &last.id),
        _ => String::new(),
    };
    let datasets = rows.iter().map(|row| encoded(shared, row)).collect();
    Ok(v1::ListDatasetsResponse { datasets, next_page_token })
}

/// Deletes a dataset that no job uses.
pub async fn delete(shared: &State, caller: &Principal, id: &str) -> Result<(), ServiceError> {
    let (tenant, id) = (caller.home(), id.parse::<DatasetId>()?);
    shared.store.delete_dataset(&tenant, &id).await?;
    tracing::info!(dataset = %id, %tenant, by = %caller.name, "dataset deleted");
    Ok(())
}

/// A committed dataset with its files, for a job.
pub async fn committed(
    shared: &State,
    tenant: &Tenant,
    id: &DatasetId,
) -> Result<(DatasetRecord, Read<FileList>), ServiceError> {
    let record = shared.store.dataset(tenant, id).await?;
    if !record.is_committed() {
        return Err(StoreError::DatasetNotCommitted(record.id).into());
    }
    let list = read_list(&*shared.objects.of(tenant).await?, &record.root).await?;
    Ok((record, list))
}

/// The manifest in a dataset, if there is one.
pub fn manifest_in(list: &FileList) -> Option<v1::BlobRef> {
    list.find(MANIFEST_PATH).map(|file| encode::blob(&file.blob()))
}

/// Items as lists that are short enough to check at a time.
fn chunks<T>(mut items: impl Iterator<Item = T>) -> impl Iterator<Item = Vec<T>> {
    std::iter::from_fn(move || {
        let some: Vec<T> = items.by_ref().take(MAX_BLOBS).collect();
        (!some.is_empty()).then_some(some)
    })
}

/// A long value in memory, with its memory permit.
pub struct Read<T> {
    /// The value.
    pub value: T,
    _turn: Option<Turn>,
}

async fn read_list(objects: &BlobStore, blob: &BlobRef) -> Result<Read<FileList>, ServiceError> {
    if !objects.contains(blob).await? {
        return Err(ServiceError::BlobMissing { digest: blob.digest.clone() });
    }
    let turn = turn_to_read(blob.bytes).await;
    let text = objects.read_at_most(blob, MAX_LIST_BYTES).await?;
    let parsed = threads::blocking(move || FileList::parse(text.into())).await;
    let list = parsed
        .unwrap_or_else(|error| Err(error.to_string()))
        .map_err(|message| bad_argument("list", message))?;
    Ok(Read { value: list, _turn: Some(turn) })
}

fn listed(file: v1::DatasetFile) -> ListedFile {
    let v1::BlobRef { digest, size_bytes } = file.blob.unwrap_or_default();
    ListedFile { path: file.path, blob: BlobRef { digest, bytes: size_bytes } }
}

/// Where the next page begins; it belongs to a tenant. Names have no slash.
fn page_token(tenant: &Tenant, last: &DatasetId) -> String {
    format!("{last}/{:08x}", crc32c::crc32c(format!("{tenant}/{last}").as_bytes()))
}

fn encoded(shared: &State, record: &DatasetRecord) -> v1::Dataset {
    let state = match record.is_committed() {
        true => v1::DatasetState::Committed,
        false => v1::DatasetState::Uploading,
    };
    let uploads_ms = u64::try_from(shared.policy.uploads.as_millis()).unwrap_or(u64::MAX);
    let expires_ms = (!record.is_committed()).then(|| record.asked_ms.saturating_add(uploads_ms));
    v1::Dataset {
        dataset_id: record.id.to_string(),
        state: state.into(),
        root: Some(encode::blob(&record.root)),
        files: record.files,
        size_bytes: record.bytes,
        create_time: Some(encode::timestamp(record.created_ms)),
        commit_time: record.committed_ms.map(encode::timestamp),
        expire_time: expires_ms.map(encode::timestamp),
        tenant: record.tenant.to_string(),
    }
}
