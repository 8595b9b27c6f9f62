//! REFINE: the first part of a partition, whose water moves; and how PARTITION goes on from there.
//!
//! Both are one run. It starts from the coarse model and its water; where the first task ends, its checkpoint is handed
//! in with the nine numbers and what stands behind them. The second task goes on from that checkpoint, iteration and
//! moments included, with the consensus of all partitions as a water that stays.

use std::sync::Arc;

use bytes::Bytes;
use fathom_core::CoreError;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::Gpu;
use fathom_core::train::{MediumRun, TrainRun, Trainer};
use fathom_core::views::ViewSource;
use fathom_core::water::{Consensus, Water, WaterRecord, four_digits};
use fathom_proto::v1::BlobRef;
use fathom_proto::worker::v1::{FailClass, Refined};
use prost::Message;

use super::partition::{OwnPart, own_part};
use super::training::{Parts, Span, advance, finish, go_on, open, train};
use super::{Control, TaskError, TaskInput, TaskOutput};
use crate::blobs::to_proto;

/// Version of [`Refined`]'s layout.
const FORMAT: u32 = 1;

pub fn run(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let own = own_part(gpu, task, views, control)?.ok_or_else(no_water)?;
    if own.parts.focus.is_empty() {
        // What the neighbours say counts.
        let coarse = own.parts.water.ok_or_else(no_water)?.water();
        let result = refined(task, None, &coarse, [0.0; 9]);
        return Ok(TaskOutput {
            result,
            gaussians: 0,
            resumed_from: 0,
            held_out: Vec::new(),
            contributions: None,
        });
    }
    let mut trainer = open(gpu, task, first_run(task, &own)?)?;
    let span = Span::of(&task.spec);
    let resumed_from = span.done(trainer.progress().iteration);
    let held_out = advance(&mut trainer, &own.config, span, task.held_out()?.as_ref(), control)?;
    let left_out = trainer.water_steps_left_out()?;
    if left_out > 0 {
        tracing::warn!(left_out, "steps of the water were left out: their gradients were not finite");
    }
    let water = trainer.water()?.ok_or_else(no_water)?;
    let evidence = trainer.water_evidence()?.ok_or_else(no_water)?;
    tracing::info!(water = ?water.in_short(), evidence = ?evidence.map(four_digits), "the water by this partition");
    let gaussians = trainer.progress().gaussians;
    let state = Bytes::from(trainer.checkpoint()?);
    // The device is not needed while the state is uploaded.
    drop(trainer);
    let state = to_proto(&control.upload(state)?);
    let result = refined(task, Some(state), &water, evidence);
    Ok(TaskOutput { result, gaussians, resumed_from, held_out, contributions: None })
}

/// The second task: what is left of the run, under the water of all partitions.
pub fn run_rest(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    own: OwnPart,
    water: WaterRecord,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let frozen = MediumRun::of_record(&water, &task.config.water, task.unit());
    let Some(mut trainer) = handed_over(gpu, task, &own, &frozen)? else {
        // It cannot be had from here; so all of the run, under the water that all have, as if it had been known before.
        let parts = Parts { medium: Some(frozen), water: Some(water), ..own.parts };
        return train(gpu, task, own.config, own.views, parts, Span::whole(&task.spec), control);
    };
    go_on(task, &mut trainer)?;
    let span = Span::of(&task.spec);
    let resumed_from = span.done(trainer.progress().iteration);
    let held_out = advance(&mut trainer, &own.config, span, task.held_out()?.as_ref(), control)?;
    finish(task, trainer, &own.config, &own.parts.shared, Some(water), resumed_from, held_out)
}

/// The run where the first task left it, on under the water `frozen`; `None` when its state is of another run.
fn handed_over(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    own: &OwnPart,
    frozen: &MediumRun,
) -> Result<Option<Trainer>, TaskError> {
    let Some(path) = &task.state else {
        tracing::warn!("the first part of this partition left no state; training all of it");
        return Ok(None);
    };
    let state = std::fs::read(path).map_err(CoreError::io("read", path))?;
    match Trainer::hand_over(Arc::clone(gpu), first_run(task, own)?, &state, frozen.clone()) {
        Ok(trainer) => {
            let iteration = trainer.progress().iteration;
            tracing::info!(iteration, water = ?frozen.water, "goes on from the first part");
            Ok(Some(trainer))
        }
        // Another adapter may have chosen other views (`OwnPixels`).
        Err(CoreError::Checkpoint(message)) => {
            tracing::warn!(reason = %message, "the state of the first part does not fit; training all of the partition");
            Ok(None)
        }
        Err(error) => Err(error.into()),
    }
}

/// The run of both tasks, as it begins.
fn first_run(task: &TaskInput, own: &OwnPart) -> Result<TrainRun, TaskError> {
    let OwnPart { parts, views, config } = own;
    let (water, record) = (&task.config.water, parts.water.as_ref().ok_or_else(no_water)?);
    let mut focus = parts.focus.clone();
    if water.plain_colours {
        // They have degree 0 until the water stands still, and those of the coarse model belong to its water.
        without_view_dependence(&mut focus);
    }
    Ok(TrainRun {
        config: config.clone(),
        extent: task.spec.scene_extent,
        views: Arc::clone(views),
        focus,
        context: parts.context.clone(),
        surfaces: parts.surfaces.clone(),
        medium: Some(MediumRun::going_on(record, water, task.unit())),
    })
}

fn without_view_dependence(model: &mut Gaussians) {
    let coefficients = (usize::from(model.sh_degree) + 1).pow(2);
    for (index, coefficient) in model.sh_coeffs.iter_mut().enumerate() {
        if !index.is_multiple_of(coefficients) {
            *coefficient = [0.0; 3];
        }
    }
}

fn no_water() -> TaskError {
    let message =
        "a partition that refines the water needs its box, and a coarse model with a water".to_owned();
    TaskError::Failed { class: FailClass::Input, message }
}

fn refined(task: &TaskInput, state: Option<BlobRef>, water: &Water, evidence: [f64; 9]) -> Bytes {
    let refined = Refined {
        format: FORMAT,
        partition: task.spec.partition,
        state,
        beta_d: water.beta_d.to_vec(),
        beta_b: water.beta_b.to_vec(),
        b_inf: water.b_inf.to_vec(),
        evidence: evidence.to_vec(),
        unit: task.unit(),
    };
    Bytes::from(refined.encode_to_vec())
}

/// What the partitions of the job agreed on; `None` where they did not refine the water.
pub fn read_consensus(task: &TaskInput) -> Result<Option<Consensus>, TaskError> {
    let Some(path) = &task.consensus else { return Ok(None) };
    let json = std::fs::read(path).map_err(CoreError::io("read", path))?;
    // The coordinator wrote it: another version of this program may read it.
    let unread = |error: CoreError| TaskError::Failed {
        class: FailClass::Environment,
        message: format!(
            "the consensus of the partitions: {error}; use workers of the coordinator's version"
        ),
    };
    Consensus::from_json(&json).map(Some).map_err(unread)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_constant_of_each_gaussian_stays() {
        for degree in 0..=3_u8 {
            let count = (usize::from(degree) + 1).pow(2);
            let mut model = Gaussians::empty(degree);
            model.sh_coeffs = (0..3 * count).map(|i| [1.0 + i as f32; 3]).collect();
            without_view_dependence(&mut model);
            let left: Vec<usize> = (0..3 * count).filter(|i| model.sh_coeffs[*i] != [0.0; 3]).collect();
            assert_eq!(left, [0, count, 2 * count], "degree {degree}");
        }
    }
}
