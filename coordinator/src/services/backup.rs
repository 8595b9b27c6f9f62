//! Backups of the store while the coordinator runs.

use std::pin::Pin;

use fathom_observe::threads;
use fathom_proto::admin::v1;
use futures::Stream;
use tonic::Status;

use super::admin::Admin;
use crate::access::Principal;
use crate::service_error::ServiceError;
use crate::store::StoreError;

/// Largest piece, bytes.
const PIECE_BYTES: usize = 256 << 10;

/// The pieces of a backup.
pub type BackupStream = Pin<Box<dyn Stream<Item = Result<v1::BackUpStoreResponse, Status>> + Send>>;

impl Admin {
    /// The store at one moment, packed. One at a time: each has all rows in memory until it is packed.
    pub(super) async fn back_up(&self, caller: &Principal) -> Result<BackupStream, ServiceError> {
        let packed = {
            let _alone = self.0.backing_up.lock().await;
            let export = self.0.store.export().await?;
            let packed = threads::blocking(move || export.to_bytes()).await;
            let failed = |error: String| StoreError::Failed(format!("its backup: {error}"));
            packed.map_err(|error| failed(error.to_string()))?.map_err(|error| failed(error.to_string()))?
        };
        tracing::info!(bytes = packed.len(), by = %caller.name, "backed up the store");
        let packed = bytes::Bytes::from(packed);
        let begins = (0..packed.len()).step_by(PIECE_BYTES);
        let pieces = begins.map(move |begin| {
            let data = packed.slice(begin..packed.len().min(begin + PIECE_BYTES));
            Ok(v1::BackUpStoreResponse { data: data.to_vec() })
        });
        Ok(Box::pin(futures::stream::iter(pieces)))
    }
}
