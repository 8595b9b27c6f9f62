//! Results of the simulated trainer, as functions of a task's input and its final hash.

use bytes::Bytes;
use fathom_core::config::{Composition, WaterPartitions};
use fathom_core::exchange::Exchange;
use fathom_core::gaussians::Gaussians;
use fathom_core::ply;
use fathom_core::scene::{BlobRef, Points};
use fathom_core::water::{StandardErrors, Water, WaterRecord};
use fathom_proto::worker::v1::task_spec::Work;
use fathom_proto::worker::v1::{Artifact, FailClass, FirstPartResult};
use fathom_worker::blobs::to_proto;
use fathom_worker::execute::{TaskError, TaskInput};
use glam::{DQuat, DVec3};
use prost::Message;

use crate::trainer::read;

/// A state of the training.
pub type State = [u8; 32];

fn opacities(state: &State, n: usize, from: f32) -> Vec<f32> {
    (0..n).map(|i| from + f32::from(state[i % 32]) / 64.0).collect()
}

fn unusable(message: String) -> TaskError {
    TaskError::Failed { class: FailClass::Input, message }
}

/// Model of a global stage or a partition: a Gaussian at each point, or at each Gaussian of the coarse model.
pub fn model(task: &TaskInput, state: &State) -> Result<(Bytes, u32), TaskError> {
    let means = match task.input(Artifact::CoarseModel) {
        Some(model) => ply::read_model(model)?.means,
        None => Points::from_bytes(&read(task.file(&task.manifest.points)?)?)?.positions,
    };
    let n = means.len();
    let model = Gaussians {
        sh_degree: 0,
        means,
        quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
        log_scales: vec![[-2.0; 3]; n],
        opacity_logits: opacities(state, n, 0.0),
        sh_coeffs: vec![[0.1, 0.2, 0.3]; n],
    };
    Ok((ply::to_bytes(&model, &water_comment(task)?)?.into(), n as u32))
}

/// A model has a water in its header only if partitions train one.
fn water_comment(task: &TaskInput) -> Result<Vec<String>, TaskError> {
    let agreed = match task.input(Artifact::Exchange) {
        Some(path) => Exchange::from_json(&read(path)?)?.water,
        None => None,
    };
    let water = match (agreed, task.config.water.partitions) {
        (Some(agreed), _) => agreed.water,
        (None, WaterPartitions::Joint) => {
            let (acts, errors) = (Composition::GaussiansSrgb, StandardErrors::from_array([1e-3; 9]));
            WaterRecord::new(&Water::COASTAL, acts, errors, "descended", 0.0)
        }
        (None, WaterPartitions::Frozen) => return Ok(Vec::new()),
    };
    Ok(vec![water.to_comment()?])
}

/// Result of a first part: the higher the partition's number, the murkier its water and the stronger its
/// evidence.
pub fn first_part_result(task: &TaskInput, state: &BlobRef) -> Bytes {
    let partition = task.partition().map_or(0, |spec| spec.index);
    let weight = f64::from(partition + 1);
    let Water { beta_d, beta_b, b_inf } = Water::COASTAL;
    let result = FirstPartResult {
        format: 1,
        partition,
        state: Some(to_proto(state)),
        beta_d: beta_d.map(|beta| (1.0 + 0.1 * weight) * beta).to_vec(),
        beta_b: beta_b.to_vec(),
        b_inf: b_inf.to_vec(),
        evidence: [[weight; 3], [0.0; 3], [0.0; 3]].concat(),
        unit: 1.0,
        rows: None,
    };
    result.encode_to_vec().into()
}

/// Result of border training: the merged model with other opacities in the band.
pub fn with_borders(task: &TaskInput, state: &State) -> Result<(Bytes, u32), TaskError> {
    let (Some(merged), Work::Borders(spec)) = (task.input(Artifact::Model), &task.work) else {
        return Err(unusable("borders without a model".to_owned()));
    };
    let mut bytes = read(merged)?;
    let merged = ply::from_bytes(&bytes, "merged")?;
    let is_near = |row: &usize| {
        spec.band.iter().any(|band| {
            let &[w, x, y, z] = band.align_quat_wxyz.as_slice() else { return false };
            let at = DQuat::from_xyzw(x, y, z, w) * DVec3::from(merged.means[*row].map(f64::from));
            at.x > band.min_x && at.x <= band.max_x && at.z > band.min_z && at.z <= band.max_z
        })
    };
    let rows: Vec<usize> = (0..merged.len()).filter(is_near).collect();
    let (mut band, _) = merged.split_where(|index| rows.contains(&index));
    band.opacity_logits = opacities(state, band.len(), -5.0);
    ply::replace_rows(&mut bytes, "merged", &rows, &band)?;
    Ok((bytes.into(), merged.len() as u32))
}
