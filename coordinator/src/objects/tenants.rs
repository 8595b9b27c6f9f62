//! The blobs of all tenants.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use object_store::ObjectStore;
use object_store::path::Path as ObjectPath;
use object_store::prefix::PrefixStore;
use tokio::sync::OnceCell;

use super::{BlobStore, ObjectError, ObjectsAt, SharedRows, check_disk, free_bytes, io_error};
use crate::clock::Clock;
use crate::schedule::Tenant;
use crate::store::ledger::Ledger;

/// A store for each tenant, in a folder or under a prefix of its own. No tenant can learn which blobs another
/// has, neither by checking for a blob nor by naming its digest.
pub struct TenantBlobs {
    at: ObjectsAt,
    data_dir: PathBuf,
    min_free_bytes: u64,
    clock: Clock,
    /// Counts the blobs of a bucket, if several coordinators may have it.
    ledger: Option<Arc<dyn Ledger>>,
    open: Mutex<HashMap<Tenant, Arc<OnceCell<Arc<BlobStore>>>>>,
}

impl TenantBlobs {
    /// The stores at a place. Writes to the local disk are refused when less than `min_free_bytes` is free;
    /// `clock` determines the age of files. `ledger` counts the blobs of a bucket for several coordinators.
    ///
    /// # Errors
    /// When a folder cannot be read or created, or a bucket is not available.
    pub async fn open(
        at: ObjectsAt,
        data_dir: &Path,
        min_free_bytes: u64,
        clock: Clock,
        ledger: Option<Arc<dyn Ledger>>,
    ) -> Result<Self, ObjectError> {
        let data_dir = data_dir.to_owned();
        let blobs = Self { at, data_dir, min_free_bytes, clock, ledger, open: Mutex::default() };
        blobs.of(&Tenant::default()).await?;
        Ok(blobs)
    }

    /// The blobs of a tenant, read-only; `None` if it has no folder.
    ///
    /// # Errors
    /// When they cannot be read.
    pub fn existing(at: &ObjectsAt, tenant: &Tenant) -> Result<Option<BlobStore>, ObjectError> {
        match at {
            ObjectsAt::Folder(root) => {
                let folder = Self::folder(root, tenant);
                if folder.is_dir() { BlobStore::existing(&folder).map(Some) } else { Ok(None) }
            }
            ObjectsAt::Bucket { store, .. } => Ok(Some(BlobStore::existing_bucket(of_tenant(store, tenant)))),
        }
    }

    /// The folder of a tenant's blobs. Blobs from before tenants existed belong to the default tenant.
    pub fn folder(data_dir: &Path, tenant: &Tenant) -> PathBuf {
        data_dir.join(prefix(tenant))
    }

    /// The blobs of a tenant; its store is created if missing.
    ///
    /// # Errors
    /// When its folder cannot be created, or the bucket is not available.
    pub async fn of(&self, tenant: &Tenant) -> Result<Arc<BlobStore>, ObjectError> {
        // While the bucket is listed for one tenant, the calls of others go on.
        let cell = {
            let mut open = self.open.lock().unwrap_or_else(PoisonError::into_inner);
            Arc::clone(open.entry(tenant.clone()).or_default())
        };
        Ok(Arc::clone(cell.get_or_try_init(|| self.opened(tenant)).await?))
    }

    async fn opened(&self, tenant: &Tenant) -> Result<Arc<BlobStore>, ObjectError> {
        let store = match &self.at {
            ObjectsAt::Folder(root) => {
                BlobStore::open(&Self::folder(root, tenant), self.min_free_bytes, self.clock)?
            }
            ObjectsAt::Bucket { store, signing, .. } => {
                let signing = signing.as_ref().map(|signing| signing.under(&prefix(tenant)));
                let staging = Self::folder(&self.data_dir, tenant).join("staging");
                let shared =
                    self.ledger.as_ref().map(|ledger| SharedRows::new(Arc::clone(ledger), tenant.clone()));
                BlobStore::open_bucket(of_tenant(store, tenant), staging, self.clock, shared, signing).await?
            }
        };
        Ok(Arc::new(store))
    }

    /// Bytes of all blobs of a tenant; nothing is created if it has none.
    ///
    /// # Errors
    /// When they cannot be listed.
    pub async fn used_bytes(&self, tenant: &Tenant) -> Result<u64, ObjectError> {
        match &self.at {
            ObjectsAt::Folder(root) if !Self::folder(root, tenant).is_dir() => Ok(0),
            _ => self.of(tenant).await?.used_bytes().await,
        }
    }

    /// Whether the bucket is there; see [`ObjectsAt::answers`].
    ///
    /// # Errors
    /// When it is not.
    pub async fn answers(&self) -> Result<(), ObjectError> {
        self.at.answers().await
    }

    /// Bytes free on the disk of the data directory, and bytes that must stay free.
    ///
    /// # Errors
    /// When the disk cannot be queried.
    pub async fn space(&self) -> Result<(u64, u64), ObjectError> {
        Ok((free_bytes(&self.data_dir).await?, self.min_free_bytes))
    }

    /// Refuses if writing `bytes` more to the local disk would leave too little free: that of the data
    /// directory, where logs are, or that of the blobs.
    ///
    /// # Errors
    /// When too little is free.
    pub async fn check_space(&self, bytes: u64) -> Result<(), ObjectError> {
        check_disk(&self.data_dir, self.min_free_bytes, bytes).await?;
        match &self.at {
            ObjectsAt::Folder(root) if *root != self.data_dir => {
                check_disk(root, self.min_free_bytes, bytes).await
            }
            _ => Ok(()),
        }
    }

    /// All tenants that have blobs, by name.
    ///
    /// # Errors
    /// When they cannot be listed.
    pub async fn all(&self) -> Result<Vec<(Tenant, Arc<BlobStore>)>, ObjectError> {
        let mut tenants = vec![Tenant::default()];
        // Other entries there are not ours.
        match &self.at {
            ObjectsAt::Folder(root) => tenants.extend(names_in(&root.join("tenants"))?),
            ObjectsAt::Bucket { store, .. } => {
                let listed = store.list_with_delimiter(Some(&ObjectPath::from("tenants"))).await;
                let folders = listed.map_err(ObjectError::Unavailable)?.common_prefixes;
                tenants.extend(folders.iter().filter_map(|folder| folder.filename()?.parse().ok()));
            }
        }
        tenants.sort();
        tenants.dedup();
        let mut all = Vec::with_capacity(tenants.len());
        for tenant in tenants {
            let store = self.of(&tenant).await?;
            all.push((tenant, store));
        }
        Ok(all)
    }
}

/// The path of a tenant's blobs in a data directory or bucket.
fn prefix(tenant: &Tenant) -> String {
    if tenant.is_default() { "objects".to_owned() } else { format!("tenants/{tenant}/objects") }
}

fn of_tenant(store: &Arc<dyn ObjectStore>, tenant: &Tenant) -> Arc<dyn ObjectStore> {
    Arc::new(PrefixStore::new(Arc::clone(store), ObjectPath::from(prefix(tenant))))
}

/// Tenants that have a folder.
fn names_in(folder: &Path) -> Result<Vec<Tenant>, ObjectError> {
    let mut tenants = Vec::new();
    match std::fs::read_dir(folder) {
        Ok(entries) => {
            for entry in entries {
                let name = entry.map_err(io_error("read", folder))?.file_name();
                tenants.extend(name.to_str().and_then(|name| name.parse::<Tenant>().ok()));
            }
        }
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
        Err(error) => return Err(io_error("read", folder)(error)),
    }
    Ok(tenants)
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;

    async fn open(data_dir: &Path) -> TenantBlobs {
        let at = ObjectsAt::Folder(data_dir.to_owned());
        TenantBlobs::open(at, data_dir, 0, Clock::start(), None).await.unwrap()
    }

    #[tokio::test]
    async fn blobs_of_a_tenant_are_hidden_from_others_and_persist() {
        let dir = tempfile::tempdir().unwrap();
        let [reef, wreck] = ["reef", "wreck"].map(|name| name.parse::<Tenant>().unwrap());
        let blobs = open(dir.path()).await;
        let blob = blobs.of(&reef).await.unwrap().put(Bytes::from_static(b"a photograph")).await.unwrap();
        let kelp = "kelp".parse::<Tenant>().unwrap();
        assert_eq!((blobs.used_bytes(&reef).await.unwrap(), blobs.used_bytes(&kelp).await.unwrap()), (12, 0));
        assert!(!blobs.of(&wreck).await.unwrap().contains(&blob).await.unwrap());
        assert!(!blobs.of(&Tenant::default()).await.unwrap().contains(&blob).await.unwrap());
        drop(blobs);
        std::fs::write(dir.path().join("tenants/README"), "not a tenant").unwrap();
        let blobs = open(dir.path()).await;
        let names: Vec<String> =
            blobs.all().await.unwrap().iter().map(|(tenant, _)| tenant.to_string()).collect();
        assert_eq!(names, ["default", "reef", "wreck"]);
        assert!(blobs.of(&reef).await.unwrap().contains(&blob).await.unwrap());
    }
}
