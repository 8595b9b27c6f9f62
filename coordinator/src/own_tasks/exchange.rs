//! The exchange between the two parts of partitions, computed from the results of the first parts. If
//! partitions train the water jointly, it has one water for the rest of the job. If they end beside their
//! neighbours, it has the Gaussians of every cell.
//!
//! It is a function of committed results alone, so a coordinator that crashes during it produces the same
//! bytes again.

use std::collections::BTreeMap;
use std::io::{BufRead as _, BufReader};
use std::sync::Arc;

use fathom_core::exchange::Exchange;
use fathom_core::ply::SplatReader;
use fathom_core::scene::BlobRef;
use fathom_core::water::{Consensus, PartitionEvidence, Water, WaterRecord, consensus, four_digits};
use fathom_proto::worker::v1::FirstPartResult;
use prost::Message;

use super::OwnTaskError;
use super::input::{blocking, config_of, made};
use crate::objects::BlobStore;
use crate::schedule::{Artifact, Stage, TaskId, TaskOutput, TaskState, TaskStats};
use crate::store::JobView;

/// The layout of [`FirstPartResult`] that this program reads.
const FORMAT: u32 = 1;

/// Longest [`FirstPartResult`], bytes: some thirty numbers and a reference.
pub const MAX_FIRST_PART_BYTES: u64 = 64 << 10;

/// Computes the input of the second parts, once all first parts are done.
pub async fn exchange_results(objects: &Arc<BlobStore>, view: &JobView) -> Result<TaskOutput, OwnTaskError> {
    let config = config_of(&view.job)?;
    let mut results = Vec::new();
    let mut rows = BTreeMap::new();
    for (task, _) in &view.tasks {
        let TaskId { stage, part: partition } = task.task;
        let (Stage::FirstPart, Some(partition), TaskState::Done { result, .. }) =
            (stage, partition, &task.state)
        else {
            continue;
        };
        let first_part = FirstPartResult::decode(objects.read_at_most(result, MAX_FIRST_PART_BYTES).await?)
            .map_err(|e| OwnTaskError::failed(format!("the result of {}: {e}", task.task)))?;
        check_first_part(partition, &first_part)?;
        // Detected now, not later by a worker that resumes from it.
        for blob in [&first_part.state, &first_part.rows].into_iter().flatten() {
            objects.require(&of_message(blob)).await?;
        }
        rows.extend(first_part.rows.as_ref().map(|blob| (partition, of_message(blob))));
        results.push((partition, first_part));
    }
    let water = match config.water.is_joint_for(results.len() as u32) {
        true => Some(water_of(objects, view, &results).await?),
        false => None,
    };
    tracing::info!(job = %view.job.job_id, partitions = results.len(), cells = rows.len(), "exchanged the results of the first parts");
    let json = serde_json::to_vec(&Exchange::new(water, rows));
    let json = json.map_err(|e| OwnTaskError::failed(e.to_string()))?;
    Ok(TaskOutput::of(Stage::Exchange, objects.put(json.into()).await?, TaskStats::default()))
}

/// The consensus of the water parameters that the first parts found.
async fn water_of(
    objects: &Arc<BlobStore>,
    view: &JobView,
    results: &[(u32, FirstPartResult)],
) -> Result<Consensus, OwnTaskError> {
    let mut found = Vec::new();
    let mut unit = None;
    for (partition, result) in results {
        found.push(evidence_of(*partition, result)?);
        if *unit.get_or_insert(result.unit) != result.unit {
            return Err(OwnTaskError::failed(format!(
                "the result of {} uses a different unit from those before it; use workers of one version",
                Stage::FirstPart.task_of(*partition)
            )));
        }
    }
    let (files, path) = (objects.files(), objects.path_of(made(&view.job, Artifact::CoarseModel)?)?);
    let coarse = blocking(move || {
        let file = files.open(&path).map(|(file, _)| BufReader::new(file));
        // Its first bytes tell an outage from a damaged header.
        let file = file.and_then(|mut file| file.fill_buf().map(drop).map(|()| file));
        let file = file.map_err(|error| OwnTaskError::of_io(&error))?;
        let header = SplatReader::new(file, "the coarse model");
        let water = header.and_then(|header| WaterRecord::among(header.comments()));
        water.map_err(|e| OwnTaskError::failed(e.to_string()))
    });
    let coarse = coarse.await?;
    let (Some(coarse), Some(unit)) = (coarse, unit) else {
        return Err(OwnTaskError::failed("the coarse model or its partitions have no water".into()));
    };
    let found = consensus(&coarse, unit, &found).map_err(|e| OwnTaskError::failed(e.to_string()))?;
    log(view, &coarse.water(), &found);
    Ok(found)
}

fn of_message(blob: &fathom_proto::v1::BlobRef) -> BlobRef {
    BlobRef { digest: blob.digest.clone(), bytes: blob.size_bytes }
}

fn fault_of(partition: u32, why: &str) -> OwnTaskError {
    OwnTaskError::failed(format!("the result of {}: {why}", Stage::FirstPart.task_of(partition)))
}

/// Refuses a result that does not belong to its task.
fn check_first_part(partition: u32, result: &FirstPartResult) -> Result<(), OwnTaskError> {
    let FirstPartResult { format, partition: named, .. } = result;
    if (*format, *named) == (FORMAT, partition) {
        return Ok(());
    }
    Err(fault_of(partition, &format!("it has format {format} and belongs to partition {named}")))
}

/// The evidence of a first part, checked against its partition.
pub fn evidence_of(partition: u32, result: &FirstPartResult) -> Result<PartitionEvidence, OwnTaskError> {
    check_first_part(partition, result)?;
    let refuse = |why: String| fault_of(partition, &why);
    let FirstPartResult { beta_d, beta_b, b_inf, evidence, unit, .. } = result;
    if !(unit.is_finite() && *unit > 0.0) {
        return Err(refuse(format!("its unit is {unit}")));
    }
    let three = |numbers: &Vec<f64>| {
        let fault = |_| refuse(format!("{} numbers instead of three", numbers.len()));
        <[f64; 3]>::try_from(numbers.as_slice()).map_err(fault)
    };
    let water = Water { beta_d: three(beta_d)?, beta_b: three(beta_b)?, b_inf: three(b_inf)? };
    let evidence = evidence.as_slice().try_into();
    let evidence = evidence
        .map_err(|_| refuse("its evidence does not have one number for each water parameter".into()))?;
    Ok(PartitionEvidence { partition, water, evidence })
}

fn log(view: &JobView, coarse: &Water, found: &Consensus) {
    for gave in found.partitions.iter().filter(|gave| !gave.far_off.is_empty()) {
        let (partition, numbers) = (gave.partition, gave.far_off.join(", "));
        tracing::warn!(job = %view.job.job_id, partition, numbers, "these partitions are far from the others, so they have less weight");
    }
    tracing::info!(
        job = %view.job.job_id,
        partitions = found.partitions.len(),
        coarse = ?coarse.in_short(),
        water = ?found.water.water().in_short(),
        standard_error = ?found.water.standard_error.to_array().map(four_digits),
        "consensus of the partitions' water"
    );
}

/// The consensus of a job's partitions; `None` if they did not train the water.
pub async fn read(objects: &BlobStore, view: &JobView) -> Result<Option<Consensus>, OwnTaskError> {
    let Some(blob) = view.job.output(Artifact::Exchange) else { return Ok(None) };
    let json = objects.read(blob).await?;
    let exchange = Exchange::from_json(&json).map_err(|e| OwnTaskError::failed(e.to_string()))?;
    Ok(exchange.water)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_result_of_another_partition_or_incomplete_is_refused() {
        let three = vec![0.1; 3];
        let sound = FirstPartResult {
            format: 1,
            partition: 3,
            beta_d: three.clone(),
            beta_b: three.clone(),
            b_inf: three,
            evidence: vec![2.0; 9],
            unit: 5.0,
            ..FirstPartResult::default()
        };
        let read = evidence_of(3, &sound);
        assert_eq!(read.map(|read| (read.partition, read.evidence)).ok(), Some((3, [2.0; 9])));
        let refused = |partition: u32, result: FirstPartResult| evidence_of(partition, &result).is_err();
        assert!(refused(2, sound.clone()));
        assert!(refused(3, FirstPartResult { format: 2, ..sound.clone() }));
        assert!(refused(3, FirstPartResult { beta_b: vec![0.1; 2], ..sound.clone() }));
        assert!(refused(3, FirstPartResult { evidence: Vec::new(), ..sound.clone() }));
        assert!(refused(3, FirstPartResult { unit: f64::NAN, ..sound }));
    }
}
