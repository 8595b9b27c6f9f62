//! `fathom cancel`: stops a job.

use clap::Args;
use fathom_coordinator::json;
use fathom_proto::v1::JobState;

use super::ServiceArgs;
use super::show::state_word;
use crate::error::Result;
use crate::output;

/// Arguments of `fathom cancel`.
#[derive(Args, Debug)]
pub struct CancelArgs {
    /// Id of the job
    #[arg(value_name = "JOB")]
    job: String,
    /// The reason, shown with the job
    #[arg(long, default_value = "", hide_default_value = true)]
    reason: String,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print the job as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: CancelArgs) -> Result<()> {
    let client = args.service.client().await?;
    let job = client.cancel(&args.job, &args.reason).await?;
    if args.json {
        return output::json(&json::job(&job));
    }
    if job.state() == JobState::Cancelled {
        output::line(format!("job {}: {}", job.job_id, state_word(&job)));
    } else {
        output::line(format!(
            "job {} had already ended ({}); nothing was cancelled",
            job.job_id,
            state_word(&job)
        ));
    }
    Ok(())
}
