//! The choice of cameras by the coarse model: the plan of a job made final between the global stage and its partitions.
//!
//! It is a function of the job's input and of committed results alone, so a coordinator that dies in it finds the same bytes
//! again.

use fathom_core::scene::BlobRef;
use fathom_proto::worker::v1;
use prost::Message;

use crate::launcher::OwnTaskError;
use crate::objects::BlobStore;
use crate::pipeline::{Drawn, JobInput, draw, put_partitions, read_plan};
use crate::schedule::{Chosen, TaskId, TaskOutput, TaskState};
use crate::store::JobView;
use fathom_plan::{Contributions, PlanInput, plan_by_contribution};

/// The layout of [`v1::Contributions`] that this program reads.
const FORMAT: u32 = 1;

/// Makes the plan of a job final, whose global stage is done.
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
            "cameras by what they show of the coarse model"
        );
    }
    let told = first.warnings(&config.train);
    let mut warnings = plan.warnings(&config.train);
    warnings.retain(|warning| !told.contains(warning));
    let (refine, partitions) = put_partitions(objects, &plan, &config).await?;
    Ok(TaskOutput::Chosen(Box::new(Chosen {
        plan: objects.put(plan_json.into()).await?,
        picture: objects.put(plan_png.into()).await?,
        refine,
        partitions,
        warnings,
    })))
}

/// What the global stage handed in beside its model.
async fn read(objects: &BlobStore, view: &JobView) -> Result<Contributions, OwnTaskError> {
    let unread = |why: String| {
        OwnTaskError::failed(format!(
            "what the global stage says of its views: {why}; use workers of the coordinator's version"
        ))
    };
    let blob = blob_of(view).ok_or_else(|| unread("there is nothing".into()))?;
    let said = v1::Contributions::decode(objects.read(blob).await?).map_err(|e| unread(e.to_string()))?;
    if said.format != FORMAT {
        return Err(unread(format!("it has format {}", said.format)));
    }
    Contributions::new(said.views, said.partitions, said.shares).map_err(unread)
}

fn blob_of(view: &JobView) -> Option<&BlobRef> {
    view.tasks.iter().find_map(|(task, _)| match &task.state {
        TaskState::Done { stats, .. } if task.task == TaskId::Global => stats.contributions.as_ref(),
        _ => None,
    })
}
