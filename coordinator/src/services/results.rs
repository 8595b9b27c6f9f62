//! Results that name other blobs.

use bytes::Bytes;
use fathom_core::scene::BlobRef;
use fathom_proto::v1;
use fathom_proto::worker::v1::{Evaluation, FirstPartResult};
use prost::Message;

use super::{encode, turn_to_read};
use crate::objects::BlobStore;
use crate::own_tasks::evaluation::MAX_EVALUATION_BYTES;
use crate::own_tasks::exchange::MAX_FIRST_PART_BYTES;
use crate::schedule::Stage;
use crate::service_error::ServiceError;

/// Memory of a result and its references, as a multiple of its length.
const RESULT_TAKES: u64 = 3;

/// Refuses a missing blob: a digest alone proves nothing, and the call must not succeed before the bytes are
/// durable.
///
/// # Errors
/// [`ServiceError::BlobMissing`].
pub async fn require(objects: &BlobStore, blob: &BlobRef) -> Result<(), ServiceError> {
    if objects.contains(blob).await? {
        return Ok(());
    }
    Err(ServiceError::BlobMissing { digest: blob.digest.clone() })
}

/// Refuses a result of `stage` that is missing or names missing blobs. A disconnected worker may have
/// uploaded them so long ago that they were collected as garbage, and the job could never continue. All of
/// them are young when this returns.
///
/// # Errors
/// [`ServiceError::BlobMissing`] with the missing blobs.
pub async fn check(objects: &BlobStore, stage: Stage, result: &BlobRef) -> Result<(), ServiceError> {
    require(objects, result).await?;
    let longest = match stage {
        Stage::Evaluate => MAX_EVALUATION_BYTES,
        Stage::FirstPart => MAX_FIRST_PART_BYTES,
        _ => return Ok(()),
    };
    let _turn = turn_to_read(RESULT_TAKES * result.bytes).await;
    let named = named_in(stage, objects.read_at_most(result, longest).await?);
    for blob in named {
        require(objects, &encode::required_blob("result", Some(blob))?).await?;
    }
    Ok(())
}

/// The blobs that a result names: the images of an evaluation, the state and the Gaussians of a first part.
/// An unreadable result names none here; the task that needs it refuses it.
fn named_in(stage: Stage, result: Bytes) -> Vec<v1::BlobRef> {
    match stage {
        Stage::Evaluate => {
            let views = Evaluation::decode(result).map(|evaluation| evaluation.views).unwrap_or_default();
            views.into_iter().flat_map(|view| [view.side_by_side, view.border]).flatten().collect()
        }
        Stage::FirstPart => {
            let first_part = FirstPartResult::decode(result).unwrap_or_default();
            [first_part.state, first_part.rows].into_iter().flatten().collect()
        }
        _ => Vec::new(),
    }
}

#[cfg(test)]
mod tests {
    use fathom_proto::worker::v1::ViewMetrics;

    use super::*;

    #[test]
    fn results_of_evaluations_and_first_parts_name_their_blobs() {
        let [side, border, state, rows] = ["side", "border", "state", "rows"]
            .map(|digest| v1::BlobRef { digest: digest.into(), size_bytes: 3 });
        let views = vec![
            ViewMetrics {
                side_by_side: Some(side.clone()),
                border: Some(border.clone()),
                ..Default::default()
            },
            ViewMetrics::default(),
        ];
        let evaluation = Bytes::from(Evaluation { views, ..Default::default() }.encode_to_vec());
        assert_eq!(named_in(Stage::Evaluate, evaluation.clone()), [side, border]);
        let first_part =
            FirstPartResult { state: Some(state.clone()), rows: Some(rows.clone()), ..Default::default() };
        assert_eq!(named_in(Stage::FirstPart, first_part.encode_to_vec().into()), [state, rows]);
        assert_eq!(named_in(Stage::FirstPart, FirstPartResult::default().encode_to_vec().into()), []);
        assert_eq!(named_in(Stage::Partition, evaluation), [], "a model names nothing");
        assert_eq!(named_in(Stage::Evaluate, Bytes::from_static(b"\xff")), []);
    }
}
