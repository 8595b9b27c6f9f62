//! The blobs of all tenants.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::{BlobStore, ObjectError, io_error};
use crate::clock::Clock;
use crate::schedule::Tenant;

/// A store for each tenant, in a folder of its own. No tenant can learn which blobs another has, neither by
/// checking for a blob nor by naming its digest.
pub struct TenantBlobs {
    data_dir: PathBuf,
    min_free_bytes: u64,
    clock: Clock,
    open: Mutex<HashMap<Tenant, Arc<BlobStore>>>,
}

impl TenantBlobs {
    /// The stores in a data directory. Writes are refused when less than `min_free_bytes` is free; `clock`
    /// determines the age of files.
    ///
    /// # Errors
    /// When a folder cannot be read or created.
    pub fn open(data_dir: &Path, min_free_bytes: u64, clock: Clock) -> Result<Self, ObjectError> {
        let blobs = Self { data_dir: data_dir.to_owned(), min_free_bytes, clock, open: Mutex::default() };
        blobs.of(&Tenant::default())?;
        Ok(blobs)
    }

    /// The folder of a tenant's blobs. Blobs from before tenants existed belong to the default tenant.
    pub fn folder(data_dir: &Path, tenant: &Tenant) -> PathBuf {
        if tenant.is_default() {
            data_dir.join("objects")
        } else {
            data_dir.join("tenants").join(tenant.as_str()).join("objects")
        }
    }

    /// The blobs of a tenant; its store is created if missing.
    ///
    /// # Errors
    /// When its folder cannot be created.
    pub fn of(&self, tenant: &Tenant) -> Result<Arc<BlobStore>, ObjectError> {
        let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(store) = open.get(tenant) {
            return Ok(Arc::clone(store));
        }
        let store = BlobStore::open(&Self::folder(&self.data_dir, tenant), self.min_free_bytes, self.clock)?;
        let store = Arc::new(store);
        open.insert(tenant.clone(), Arc::clone(&store));
        Ok(store)
    }

    /// Bytes of all blobs of a tenant; nothing is created if it has none.
    ///
    /// # Errors
    /// When its folder cannot be read.
    pub fn used_bytes(&self, tenant: &Tenant) -> Result<u64, ObjectError> {
        if Self::folder(&self.data_dir, tenant).is_dir() { Ok(self.of(tenant)?.used_bytes()) } else { Ok(0) }
    }

    /// Bytes free on the disk, and bytes that must stay free.
    ///
    /// # Errors
    /// When the disk cannot be queried.
    pub async fn space(&self) -> Result<(u64, u64), ObjectError> {
        self.of(&Tenant::default())?.space().await
    }

    /// As [`BlobStore::check_space`]: all tenants have one disk.
    ///
    /// # Errors
    /// When too little is free.
    pub async fn check_space(&self, bytes: u64) -> Result<(), ObjectError> {
        self.of(&Tenant::default())?.check_space(bytes).await
    }

    /// All tenants that have a folder, by name.
    ///
    /// # Errors
    /// When the parent folder cannot be read.
    pub fn all(&self) -> Result<Vec<(Tenant, Arc<BlobStore>)>, ObjectError> {
        let mut tenants = vec![Tenant::default()];
        let folder = self.data_dir.join("tenants");
        match std::fs::read_dir(&folder) {
            Ok(entries) => {
                for entry in entries {
                    let name = entry.map_err(io_error("read", &folder))?.file_name();
                    // Other entries there are not ours.
                    tenants.extend(name.to_str().and_then(|name| name.parse::<Tenant>().ok()));
                }
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => return Err(io_error("read", &folder)(error)),
        }
        tenants.sort();
        tenants.dedup();
        tenants.into_iter().map(|tenant| Ok((tenant.clone(), self.of(&tenant)?))).collect()
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    #[tokio::test]
    async fn blobs_of_a_tenant_are_hidden_from_others_and_persist() {
        let dir = tempfile::tempdir().unwrap();
        let [reef, wreck] = ["reef", "wreck"].map(|name| name.parse::<Tenant>().unwrap());
        let blobs = TenantBlobs::open(dir.path(), 0, Clock::start()).unwrap();
        let blob = blobs.of(&reef).unwrap().put(Bytes::from_static(b"a photograph")).await.unwrap();
        let kelp = "kelp".parse::<Tenant>().unwrap();
        assert_eq!((blobs.used_bytes(&reef).unwrap(), blobs.used_bytes(&kelp).unwrap()), (12, 0));
        assert!(!blobs.of(&wreck).unwrap().contains(&blob).await.unwrap());
        assert!(!blobs.of(&Tenant::default()).unwrap().contains(&blob).await.unwrap());
        drop(blobs);
        std::fs::write(dir.path().join("tenants/README"), "not a tenant").unwrap();
        let blobs = TenantBlobs::open(dir.path(), 0, Clock::start()).unwrap();
        let names: Vec<String> = blobs.all().unwrap().iter().map(|(tenant, _)| tenant.to_string()).collect();
        assert_eq!(names, ["default", "reef", "wreck"]);
        assert!(blobs.of(&reef).unwrap().contains(&blob).await.unwrap());
    }
}
