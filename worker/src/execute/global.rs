//! GLOBAL: the coarse model of the whole scene, from its sparse points, and the water that all partitions have.

use std::sync::Arc;

use fathom_core::gpu::Gpu;
use fathom_core::views::ViewSource;

use super::training::{Span, parts_of_points, train};
use super::{Control, TaskError, TaskInput, TaskOutput};

pub fn run(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let parts = parts_of_points(task, views.as_ref())?;
    train(gpu, task, task.train_config(), views, parts, Span::of(&task.spec), control)
}
