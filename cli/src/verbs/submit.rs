//! `fathom submit`: submits a scene to a service.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use serde_json::json;

use super::ServiceArgs;
use super::steer::SchedulingArgs;
use crate::config_args::JobArgs;
use crate::error::Result;
use crate::output;
use crate::upload::{self, JobTicket};

/// Arguments of `fathom submit`.
#[derive(Args, Debug)]
pub struct SubmitArgs {
    /// Scene: a folder with images/ and sparse/0, or with a transforms.json
    #[arg(value_name = "DATA", required_unless_present = "dataset")]
    data: Option<PathBuf>,
    /// Dataset from `fathom dataset upload`, instead of a scene
    #[arg(long, value_name = "DATASET", conflicts_with = "data")]
    dataset: Option<String>,
    #[command(flatten)]
    job: JobArgs,
    /// Display name of the job [default: the name of the folder or of the dataset]
    #[arg(long)]
    name: Option<String>,
    /// Makes this command safe to repeat: one id creates at most one job [default: a new id]
    #[arg(long, value_name = "UUID")]
    request_id: Option<String>,
    #[command(flatten)]
    scheduling: SchedulingArgs,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print {"job": ID, ...}
    #[arg(long)]
    json: bool,
}

pub async fn run(args: SubmitArgs) -> Result<()> {
    let begin = Instant::now();
    let config = args.job.resolve()?;
    let client = args.service.client().await?;
    let request_id = args.request_id.unwrap_or_else(|| uuid::Uuid::new_v4().to_string());
    let ticket = |name| JobTicket {
        name,
        request_id: &request_id,
        priority: args.scheduling.priority.unwrap_or_default(),
        max_parallel: args.scheduling.max_parallel.unwrap_or_default(),
    };
    let (job, views) = match (&args.data, &args.dataset) {
        (Some(data), _) => {
            client.may_upload().await?;
            let prepared = upload::prepare(data, &config)?;
            for warning in &prepared.warnings {
                output::remark(warning);
            }
            let name = args.name.unwrap_or_else(|| folder_name(data));
            let job = upload::submit(&client, &prepared, &config, ticket(&name), begin).await?;
            (job, Some(prepared.manifest.views.len()))
        }
        (None, dataset) => {
            let dataset = dataset.clone().unwrap_or_default();
            let name = args.name.unwrap_or_else(|| dataset.clone());
            (upload::submit_dataset(&client, &dataset, &config, ticket(&name)).await?, None)
        }
    };
    if args.json {
        return output::json(&json!({
            "job": job.job_id,
            "name": job.name,
            "request_id": request_id,
            "views": views,
            "dataset": args.dataset,
            "coordinator": client.url,
        }));
    }
    output::line(&job.job_id);
    Ok(())
}

/// Last component of a path, for display.
pub fn folder_name(path: &Path) -> String {
    let path = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    path.file_name().map_or_else(|| "scene".to_owned(), |name| name.to_string_lossy().into_owned())
}
