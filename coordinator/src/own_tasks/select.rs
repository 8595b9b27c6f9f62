//! The selection of cameras by the coarse model: it makes the plan of a job final between the global stage
//! and its partitions.
//!
//! It is a function of the job's input and of committed results alone, so a coordinator that crashes during
//! it produces the same bytes again.

use fathom_plan::{Contributions, PlanInput, plan_by_contribution};
use fathom_proto::worker::v1;
use prost::Message;

use super::OwnTaskError;
use super::input::{JobInput, read_plan};
use super::plan::{Drawn, draw, put_partitions};
use crate::objects::BlobStore;
use crate::schedule::{Artifact, Planned, TaskOutput};
use crate::store::JobView;

/// The layout of [`v1::Contributions`] that this program reads.
const FORMAT: u32 = 1;

/// Makes the plan of a job final, after its global stage.
pub async fn choose(objects: &BlobStore, view: &JobView) -> Result<TaskOutput, OwnTaskError> {
    let contributions = read(objects, view).await?;
    let first = read_plan(objects, &view.job).await?;
    let input = JobInput::read(objects, &view.job).await?;
    let config = input.config.clone();
    let visible = first.clone();
    let by_contribution = move |input: &PlanInput<'_>| plan_by_contribution(input, &visible, &contributions);
    let Drawn { plan, plan_json, plan_png } = draw(objects, &view.job, input, by_contribution).await?;
    for (before, after) in first.partitions.iter().zip(&plan.partitions) {
        tracing::info!(
            job = %view.job.job_id,
            partition = %after.id,
            by_visibility = before.chosen_views.len(),
            by_contribution = after.chosen_views.len(),
            filled = after.filled_views,
            "selected cameras by their contribution"
        );
    }
    let warned = first.warnings(&config.train);
    let mut warnings = plan.warnings(&config.train);
    warnings.retain(|warning| !warned.contains(warning));
    let tasks = put_partitions(objects, &plan, &config).await?;
    let (plan_blob, picture) = (objects.put(plan_json.into()).await?, objects.put(plan_png.into()).await?);
    Ok(TaskOutput::planned(plan_blob, picture, Planned { tasks, warnings }))
}

/// The contributions that the global stage submitted with its model.
async fn read(objects: &BlobStore, view: &JobView) -> Result<Contributions, OwnTaskError> {
    let unread = |why: String| {
        OwnTaskError::failed(format!(
            "the contributions of the global stage: {why}; use workers of the coordinator's version"
        ))
    };
    let blob = view.job.output(Artifact::Contributions).ok_or_else(|| unread("they are missing".into()))?;
    let said = v1::Contributions::decode(objects.read(blob).await?).map_err(|e| unread(e.to_string()))?;
    if said.format != FORMAT {
        return Err(unread(format!("they have format {}", said.format)));
    }
    Contributions::new(said.views, said.partitions, said.shares).map_err(unread)
}
