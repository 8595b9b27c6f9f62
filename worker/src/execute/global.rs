//! GLOBAL: the coarse model of the whole scene, from its sparse points, and the water that all partitions have. Where
//! partitions choose their cameras by it, also what each view shows of each of them.

use std::sync::Arc;

use fathom_core::gpu::Gpu;
use fathom_core::ply;
use fathom_core::views::ViewSource;

use super::contribution;
use super::training::{Span, parts_of_points, train};
use super::{Control, TaskError, TaskInput, TaskOutput};

pub fn run(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let (parts, views) = parts_of_points(task, views)?;
    let span = Span::of(&task.spec);
    let mut output = train(gpu, task, task.train_config(), Arc::clone(&views), parts, span, control)?;
    if !task.spec.regions.is_empty() {
        let model = ply::from_bytes(&output.result, "the coarse model")?;
        output.contributions = Some(contribution::hand_in(gpu, task, &model, views.as_ref(), control)?);
    }
    Ok(output)
}
