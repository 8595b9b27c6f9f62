//! I11: blobs. Every blob that rows reference, directly or through another blob, exists and matches its
//! digest. Unreferenced blobs are removed in time.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use fathom_coordinator::objects::TenantBlobs;
use fathom_coordinator::schedule::Tenant;
use fathom_coordinator::store::export::Export;
use fathom_core::scene::BlobRef;
use serde_json::Value;

use crate::world::{EPOCH_MS, HOUSE, World, tenant_of};

/// A cleanup round may start this much late, because it waits for disks.
const SLACK: Duration = Duration::from_secs(5);

/// Checks all files of all tenants.
pub fn look(world: &World, export: &Export, violations: &mut Vec<String>) {
    // Other runs may end just after faults that interrupted every round.
    let is_cleaned = world.scenario.jobs.iter().any(|job| job.is_deleted);
    // Including tenants with nothing left.
    let users = (0..world.scenario.jobs.len()).map(|user| tenant_of(user).parse().expect("a tenant's name"));
    for tenant in &users.collect::<BTreeSet<Tenant>>() {
        let jobs = export.jobs.iter().filter(|job| job.job.tenant == *tenant);
        let datasets = export.datasets.iter().filter(|dataset| dataset.tenant == *tenant);
        let rows = jobs
            .flat_map(|job| [serde_json::to_value(&job.job), serde_json::to_value(&job.tasks)])
            .chain(datasets.map(serde_json::to_value));
        let rows: Vec<Value> = rows.flatten().collect();
        let mut texts: Vec<Vec<u8>> = rows.iter().map(|row| row.to_string().into_bytes()).collect();
        texts.extend(referred_to(world, tenant, &rows, violations));
        let folder = TenantBlobs::folder(&world.coordinator_config().data_dir, tenant);
        for (path, age) in
            files(world, &folder.join("cas")).into_iter().chain(files(world, &folder.join("uploads")))
        {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let digest = name.trim_end_matches(".part").as_bytes();
            let is_used = name.len() == digest.len()
                && texts.iter().any(|text| text.windows(digest.len()).any(|window| window == digest));
            if is_cleaned && !is_used && age > HOUSE.policy.unused + HOUSE.every + SLACK {
                violations.push(format!("I11: {name} of {tenant} has been unreferenced for {age:?}"));
            }
        }
    }
}

/// The contents of all blobs that rows reference, directly or through another blob.
fn referred_to(world: &World, tenant: &Tenant, rows: &[Value], violations: &mut Vec<String>) -> Vec<Vec<u8>> {
    let mut open = Vec::new();
    rows.iter().for_each(|row| collect(row, &mut open));
    let (mut looked_at, mut contents) = (BTreeSet::new(), Vec::new());
    while let Some(blob) = open.pop() {
        if !looked_at.insert(blob.digest.clone()) {
            continue;
        }
        match std::fs::read(path(world, tenant, &blob.digest)) {
            Err(error) => violations.push(format!("I11: {} of {tenant}: {error}", blob.digest)),
            Ok(bytes) if blake3::hash(&bytes).to_hex().as_str() != blob.digest => {
                violations.push(format!("I11: {} of {tenant} does not match its digest", blob.digest));
            }
            Ok(bytes) => {
                match serde_json::from_slice::<Value>(&bytes) {
                    Ok(json) => collect(&json, &mut open),
                    Err(_) => list(&bytes, &mut open),
                }
                contents.push(bytes);
            }
        }
    }
    contents
}

/// All references in a row or a file.
fn collect(value: &Value, found: &mut Vec<BlobRef>) {
    match value {
        Value::Object(fields) => match serde_json::from_value::<BlobRef>(value.clone()) {
            Ok(blob) => found.push(blob),
            Err(_) => fields.values().for_each(|value| collect(value, found)),
        },
        Value::Array(values) => values.iter().for_each(|value| collect(value, found)),
        _ => {}
    }
}

/// All references in the list of a dataset: DIGEST BYTES PATH.
fn list(bytes: &[u8], found: &mut Vec<BlobRef>) {
    for line in String::from_utf8_lossy(bytes).lines() {
        let mut words = line.splitn(3, ' ');
        if let (Some(digest), Some(bytes), Some(_)) = (words.next(), words.next(), words.next())
            && let Ok(bytes) = bytes.parse()
            && (BlobRef { digest: digest.to_owned(), bytes }).is_well_formed()
        {
            found.push(BlobRef { digest: digest.to_owned(), bytes });
        }
    }
}

/// Path of a blob.
pub fn path(world: &World, tenant: &Tenant, digest: &str) -> PathBuf {
    let folder = TenantBlobs::folder(&world.coordinator_config().data_dir, tenant);
    folder.join("cas").join(&digest[..2]).join(digest)
}

/// All files below a folder, with their simulated ages at the end of the run.
fn files(world: &World, folder: &Path) -> Vec<(PathBuf, Duration)> {
    let now = UNIX_EPOCH + Duration::from_millis(EPOCH_MS) + world.history.now();
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let path = entry.path();
        if path.is_dir() {
            found.append(&mut files(world, &path));
        } else if let Ok(time) = entry.metadata().and_then(|file| file.modified()) {
            found.push((path, now.duration_since(time).unwrap_or_default()));
        }
    }
    found.sort();
    found
}
