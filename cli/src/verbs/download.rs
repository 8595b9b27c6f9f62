//! `fathom download`: fetches the files of a job that has succeeded.

use std::path::PathBuf;

use clap::Args;
use fathom_proto::v1::JobState;
use serde_json::json;

use super::ServiceArgs;
use super::show::state_word;
use crate::error::{CliError, Result};
use crate::output;

/// Arguments of `fathom download`.
#[derive(Args, Debug)]
pub struct DownloadArgs {
    /// Id of the job
    #[arg(value_name = "JOB")]
    job: String,
    /// Folder to write into
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print the names of the files as JSON
    #[arg(long)]
    json: bool,
}

pub async fn run(args: DownloadArgs) -> Result<()> {
    let client = args.service.client().await?;
    let job = client.job(&args.job).await?;
    if job.state() != JobState::Succeeded {
        let state = state_word(&job);
        return Err(CliError::Message(format!(
            "job {} has no files yet ({state}): files exist once the job has succeeded; `fathom watch {}` \
             waits for it",
            args.job, args.job
        )));
    }
    let files = client.download(&args.job, &args.output).await?;
    if args.json {
        return output::json(&json!({ "job": args.job, "output": args.output, "files": files }));
    }
    output::line(format!("{} in {}", output::count(files.len() as u64, "file"), args.output.display()));
    Ok(())
}
