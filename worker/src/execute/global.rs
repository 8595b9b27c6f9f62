//! GLOBAL: trains the coarse model of the whole scene from its sparse points, and the water shared by all
//! partitions.

use std::sync::Arc;

use fathom_core::gpu::Gpu;
use fathom_core::train::MediumRun;
use fathom_core::views::ViewSource;

use super::training::{Span, parts_of_points, train};
use super::{Control, TaskError, TaskInput, TaskOutput};

pub fn run(
    gpu: &Arc<Gpu>,
    task: &TaskInput,
    views: Arc<dyn ViewSource>,
    control: &dyn Control,
) -> Result<TaskOutput, TaskError> {
    let (mut parts, views) = parts_of_points(task, views)?;
    parts.medium = parts.medium.map(of_coarse_run);
    let span = Span::of(&task.common);
    train(gpu, task, task.train_config(), views, parts, span, control)
}

/// The medium of the coarse run. Its view-dependent colours learn no faster than its constant colours;
/// partitions fit moving light, at full size. On fox in 2x2 this limit gains 0.39 dB at full size (one seed)
/// and 0.06 dB at 240 px (the mean of five seeds). On reef-clip it gains -0.03 dB (one seed; `fox` and `reef`
/// in bench/history.jsonl).
fn of_coarse_run(mut medium: MediumRun) -> MediumRun {
    medium.config.clear_harmonics = medium.config.clear_harmonics.min(1.0);
    medium
}

#[cfg(test)]
mod tests {
    use fathom_core::config::{Composition, WaterConfig};

    use super::*;

    #[test]
    fn the_coarse_run_only_limits_the_rate_of_harmonics() {
        for (asked, given) in [(4.0, 1.0), (1.0, 1.0), (0.5, 0.5)] {
            let config = WaterConfig { clear_harmonics: asked, ..WaterConfig::default() };
            let found = of_coarse_run(MediumRun::fixed(&config, Composition::PixelsSrgb, 7.0));
            let expected = WaterConfig { clear_harmonics: given, ..config };
            assert_eq!(found, MediumRun::fixed(&expected, Composition::PixelsSrgb, 7.0));
        }
    }
}
