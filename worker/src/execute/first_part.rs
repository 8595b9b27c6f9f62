//! FIRST_PART: the run of a partition up to the exchange, and its continuation by PARTITION.
//!
//! Both tasks are parts of one run, which starts from the coarse model and its water. The first part submits
//! its checkpoint. If partitions train the water jointly, it adds the water parameters and their evidence. If
//! they end beside their neighbours, it adds the Gaussians of its cell. The second part resumes from that
//! checkpoint, with iteration and moments. It freezes the water at the consensus of all partitions. If
//! partitions end beside their neighbours, it trains its own cell alone, beside their Gaussians.

use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;
use fathom_core::exchange::Exchange;
use fathom_core::gaussians::Gaussians;
use fathom_core::gpu::Gpu;
use fathom_core::train::{MediumRun, Surroundings, TrainRun, Trainer};
use fathom_core::views::ViewSource;
use fathom_core::water::{Water, four_digits};
use fathom_core::{CoreError, ply};
use fathom_proto::v1::BlobRef;
use fathom_proto::worker::v1::{Artifact, FailClass, FirstPartResult, FocusBox, PartitionSpec};
use glam::DVec3;
use prost::Message;

use super::partition::{Inside, OwnPart, own_part};
use super::training::{Parts, Span, advance, finish, go_on, open, output_of_shared, train};
use super::{Control, TaskError, TaskInput, TaskOutput};
use crate::blobs::to_proto;

/// Version of [`FirstPartResult`]'s layout.
const FORMAT: u32 = 1;

pub fn run(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    spec: &PartitionSpec,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let own = own_part(gpu, task, spec, views, control)?.ok_or_else(no_water)?;
    if own.parts.focus.is_empty() {
        // The neighbours' Gaussians take precedence.
        let coarse =
            if refines_water(task) { Some(own.parts.water.ok_or_else(no_water)?.water()) } else { None };
        let found = coarse.map(|water| (water, [0.0; 9]));
        let result = first_part_result(task, spec, None, None, found);
        return Ok(TaskOutput { result, ..TaskOutput::default() });
    }
    let mut trainer = open(gpu, task, first_run(task, &own)?)?;
    let span = Span::of(&task.common);
    let resumed_from = span.done(trainer.progress().iteration);
    let held_out = advance(task, &mut trainer, &own.config, span, control)?;
    let found = if refines_water(task) { Some(found_water(&trainer)?) } else { None };
    let gaussians = trainer.progress().gaussians;
    let cell = spec.cell.as_ref();
    let rows = cell.map(|cell| rows_of(trainer.gaussians()?, cell)).transpose()?.flatten();
    let state = Bytes::from(trainer.checkpoint()?);
    // Free the device during the upload.
    drop(trainer);
    let state = to_proto(&control.upload(state)?);
    let rows = rows.map(|rows| control.upload(rows)).transpose()?.map(|rows| to_proto(&rows));
    let result = first_part_result(task, spec, Some(state), rows, found);
    Ok(TaskOutput { result, gaussians, resumed_from, held_out, further: Vec::new() })
}

/// Whether first parts train the water; jobs with first parts have more than one partition.
fn refines_water(task: &TaskInput) -> bool {
    task.config.water.is_joint_for(2)
}

/// The water as trained by this partition, and the evidence for each of its parameters.
fn found_water(trainer: &Trainer) -> Result<(Water, [f64; 9]), TaskError> {
    let left_out = trainer.water_steps_left_out()?;
    if left_out > 0 {
        tracing::warn!(left_out, "water steps were skipped: their gradients were not finite");
    }
    let water = trainer.water()?.ok_or_else(no_water)?;
    let evidence = trainer.water_evidence()?.ok_or_else(no_water)?;
    tracing::info!(water = ?water.in_short(), evidence = ?evidence.map(four_digits), "water of this \
        partition");
    Ok((water, evidence))
}

/// The trained Gaussians in the cell, as PLY; `None` if there are none.
fn rows_of(trained: Gaussians, cell: &FocusBox) -> Result<Option<Bytes>, TaskError> {
    let cell = Inside::new(cell)?;
    let (own, _) = trained.split_by(|mean| cell.contains(DVec3::from(mean.map(f64::from))));
    Ok(if own.is_empty() { None } else { Some(Bytes::from(ply::to_bytes(&own, &[])?)) })
}

/// The second part: the rest of the run, with the data that the partitions exchanged.
pub fn run_rest(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    spec: &PartitionSpec,
    own: OwnPart,
    exchange: Exchange,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let agreed = exchange.water.map(|agreed| agreed.water);
    let frozen = agreed.as_ref().map(|water| MediumRun::of_record(water, &task.config.water, task.unit()));
    let restored = restore(gpu, task, spec, &own, frozen.as_ref())?;
    let water = agreed.or(own.parts.water);
    let mut trainer = match restored {
        Restored::Run(trainer) => *trainer,
        Restored::Nothing => {
            tracing::warn!("no trained Gaussian lies in the cell of this partition");
            return output_of_shared(&own.parts.shared, &own.config, water.as_ref());
        }
        // The checkpoint cannot be used, so train the whole run with the consensus water, as if it had been
        // known from the start.
        Restored::DoesNotFit => {
            let parts = Parts { medium: frozen.or(own.parts.medium), water, ..own.parts };
            return train(gpu, task, own.config, own.views, parts, Span::whole(&task.common), control);
        }
    };
    go_on(task, &mut trainer)?;
    let span = Span::of(&task.common);
    let resumed_from = span.done(trainer.progress().iteration);
    let held_out = advance(task, &mut trainer, &own.config, span, control)?;
    finish(task, &mut trainer, &own.config, &own.parts.shared, water, resumed_from, held_out)
}

/// Outcome of loading the state of the first part.
enum Restored {
    /// The run continues from it.
    Run(Box<Trainer>),
    /// The run has no Gaussians in its own cell.
    Nothing,
    /// There is none, or it belongs to another run.
    DoesNotFit,
}

/// The run as the first part left it, with the water `frozen`, and beside the neighbours if there are any.
fn restore(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    spec: &PartitionSpec,
    own: &OwnPart,
    frozen: Option<&MediumRun>,
) -> Result<Restored, TaskError> {
    let Some(path) = &task.state else {
        tracing::warn!("the first part of this partition has no state; training the whole partition");
        return Ok(Restored::DoesNotFit);
    };
    let state = std::fs::read(path).map_err(CoreError::io("read", path))?;
    let cell = spec.cell.as_ref().map(Inside::new).transpose()?;
    let keeps =
        |mean: [f32; 3]| cell.as_ref().is_none_or(|cell| cell.contains(DVec3::from(mean.map(f64::from))));
    let beside = match &cell {
        None => None,
        Some(_) => Some(Surroundings { keeps: &keeps, context: context_of_neighbours(task, spec, own)? }),
    };
    match Trainer::hand_over(Arc::clone(gpu), first_run(task, own)?, &state, frozen.cloned(), beside) {
        Ok(Some(trainer)) => {
            let progress = trainer.progress();
            tracing::info!(
                iteration = progress.iteration,
                gaussians = progress.gaussians,
                water = ?frozen.map(|frozen| frozen.water),
                neighbours = task.neighbours.len(),
                "resuming from the first part"
            );
            Ok(Restored::Run(Box::new(trainer)))
        }
        Ok(None) => Ok(Restored::Nothing),
        // Another adapter may have selected other views (`LossMask`).
        Err(CoreError::Checkpoint(message)) => {
            tracing::warn!(reason = %message, "the state of the first part does not fit; training the whole \
                partition");
            Ok(Restored::DoesNotFit)
        }
        Err(error) => Err(error.into()),
    }
}

/// Context of the second part: the coarse model outside this partition's box, and the neighbours' Gaussians
/// inside it. Farther away the coarse model stays, so no task holds more detail than its own box.
fn context_of_neighbours(
    task: &TaskInput,
    spec: &PartitionSpec,
    own: &OwnPart,
) -> Result<Gaussians, TaskError> {
    let focus = spec.focus.as_ref().map(Inside::new).transpose()?;
    let cell = spec.cell.as_ref().map(Inside::new).transpose()?;
    let mut context = own.parts.context.clone();
    for path in &task.neighbours {
        let rows = read_rows(path)?;
        let is_near = |mean: [f32; 3]| {
            let at = DVec3::from(mean.map(f64::from));
            focus.as_ref().is_some_and(|focus| focus.contains(at))
                && !cell.as_ref().is_some_and(|cell| cell.contains(at))
        };
        (0..rows.len()).filter(|row| is_near(rows.means[*row])).for_each(|row| context.push_from(&rows, row));
    }
    Ok(context)
}

fn read_rows(path: &Path) -> Result<Gaussians, TaskError> {
    // Another worker wrote it, possibly of another version.
    ply::read_model(path).map_err(|error| TaskError::Failed {
        class: FailClass::Environment,
        message: format!("the model of a neighbour: {error}; use workers of the same version"),
    })
}

/// The run of both tasks at its start.
fn first_run(task: &TaskInput, own: &OwnPart) -> Result<TrainRun, TaskError> {
    let OwnPart { parts, views, config } = own;
    let water = &task.config.water;
    let mut focus = parts.focus.clone();
    let medium = if refines_water(task) {
        let record = parts.water.as_ref().ok_or_else(no_water)?;
        Some(MediumRun::going_on(record, water, task.unit()))
    } else {
        parts.medium.clone()
    };
    if refines_water(task) && water.sh0_while_free {
        // Colours have SH degree 0 until the water is frozen; the higher harmonics of the coarse model fit
        // only its own water.
        without_view_dependence(&mut focus);
    }
    Ok(TrainRun {
        config: config.clone(),
        extent: task.common.scene_extent,
        views: Arc::clone(views),
        focus,
        context: parts.context.clone(),
        surfaces: parts.surfaces.clone(),
        medium,
        surface: None,
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
        "a partition that trains the water needs its box, and a coarse model with a water".to_owned();
    TaskError::Failed { class: FailClass::Input, message }
}

fn first_part_result(
    task: &TaskInput,
    spec: &PartitionSpec,
    state: Option<BlobRef>,
    rows: Option<BlobRef>,
    found: Option<(Water, [f64; 9])>,
) -> Bytes {
    let numbers =
        |of: fn(&Water) -> [f64; 3]| found.as_ref().map_or(Vec::new(), |(water, _)| of(water).to_vec());
    let result = FirstPartResult {
        format: FORMAT,
        partition: spec.index,
        state,
        beta_d: numbers(|water| water.beta_d),
        beta_b: numbers(|water| water.beta_b),
        b_inf: numbers(|water| water.b_inf),
        evidence: found.as_ref().map_or(Vec::new(), |(_, evidence)| evidence.to_vec()),
        unit: task.unit(),
        rows,
    };
    Bytes::from(result.encode_to_vec())
}

/// The data exchanged by the job's partitions; `None` if their runs have one part.
pub fn read_exchange(task: &TaskInput) -> Result<Option<Exchange>, TaskError> {
    let Some(path) = task.input(Artifact::Exchange) else { return Ok(None) };
    let json = std::fs::read(path).map_err(CoreError::io("read", path))?;
    // The coordinator wrote it, possibly of another version.
    let unread = |error: CoreError| TaskError::Failed {
        class: FailClass::Environment,
        message: format!("{error}; use workers of the coordinator's version"),
    };
    Exchange::from_json(&json).map(Some).map_err(unread)
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
