//! `fathom ls`: the jobs of a service, the newest first.

use clap::Args;

use super::ServiceArgs;
use super::show::{job_json, state_word};
use crate::error::Result;
use crate::output;

/// Arguments of `fathom ls`.
#[derive(Args, Debug)]
pub struct LsArgs {
    #[command(flatten)]
    service: ServiceArgs,
    /// At most so many
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..))]
    limit: u32,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: LsArgs) -> Result<()> {
    let client = args.service.client().await?;
    let mut jobs = client.list(args.limit as usize).await?;
    jobs.truncate(args.limit as usize);
    if args.json {
        return output::json(&jobs.iter().map(job_json).collect::<Vec<_>>());
    }
    if jobs.is_empty() {
        output::line(format!("no jobs at {}", client.url));
        return Ok(());
    }
    for job in &jobs {
        output::line(format!(
            "{}  {:<10} {:>4.0} %  {}",
            job.job_id,
            state_word(job),
            100.0 * job.progress,
            job.name
        ));
    }
    Ok(())
}
