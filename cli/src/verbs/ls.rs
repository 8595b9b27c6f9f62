//! `fathom ls`: the jobs of a service, newest first.

use clap::{Args, ValueEnum};
use fathom_coordinator::json;
use fathom_proto::v1::{JobState, ListJobsRequest};

use super::ServiceArgs;
use super::show::state_word;
use crate::error::Result;
use crate::output;

/// Arguments of `fathom ls`.
#[derive(Args, Debug)]
pub struct LsArgs {
    #[command(flatten)]
    service: ServiceArgs,
    /// Only jobs in this state; may be repeated
    #[arg(long = "state", value_name = "STATE", value_enum)]
    states: Vec<State>,
    /// Only jobs with this text in their names
    #[arg(long, value_name = "TEXT", default_value = "", hide_default_value = true)]
    name: String,
    /// Only jobs of this tenant
    #[arg(long, value_name = "TENANT", default_value = "", hide_default_value = true)]
    tenant: String,
    /// At most this many jobs
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..))]
    limit: u32,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

/// States to filter by.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum State {
    Running,
    Paused,
    Succeeded,
    Failed,
    Cancelled,
}

impl State {
    fn sent(self) -> JobState {
        match self {
            Self::Running => JobState::Running,
            Self::Paused => JobState::Paused,
            Self::Succeeded => JobState::Succeeded,
            Self::Failed => JobState::Failed,
            Self::Cancelled => JobState::Cancelled,
        }
    }
}

pub async fn run(args: LsArgs) -> Result<()> {
    let client = args.service.client().await?;
    let states = args.states.iter().map(|state| state.sent().into()).collect();
    let filter = ListJobsRequest {
        states,
        name_contains: args.name.clone(),
        tenant: args.tenant.clone(),
        ..Default::default()
    };
    let mut jobs = client.list(filter, args.limit as usize).await?;
    jobs.truncate(args.limit as usize);
    if args.json {
        return output::json(&jobs.iter().map(json::job).collect::<Vec<_>>());
    }
    if jobs.is_empty() {
        let which = if args.states.is_empty() && args.name.is_empty() && args.tenant.is_empty() {
            "no jobs"
        } else {
            "no such jobs"
        };
        output::line(format!("{which} at {}", client.url));
        return Ok(());
    }
    for job in &jobs {
        output::line(format!(
            "{}  {:<10} {:>4.0} %  {}{}",
            job.job_id,
            state_word(job),
            100.0 * job.progress,
            job.name,
            if job.tenant == "default" { String::new() } else { format!(" (of {})", job.tenant) }
        ));
    }
    Ok(())
}
