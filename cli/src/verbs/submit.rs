//! `fathom submit`: hands a scene in to a service.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use serde_json::json;

use super::ServiceArgs;
use super::steer::Importance;
use crate::config_args::JobArgs;
use crate::error::Result;
use crate::output;
use crate::upload::{self, JobTicket};

/// Arguments of `fathom submit`.
#[derive(Args, Debug)]
pub struct SubmitArgs {
    /// Scene: a folder with images/ and sparse/0, or with a transforms.json
    #[arg(value_name = "DATA")]
    data: PathBuf,
    #[command(flatten)]
    job: JobArgs,
    /// Name of the job, for people [default: the name of the folder]
    #[arg(long)]
    name: Option<String>,
    /// Makes repeating this command harmless: one id makes one job [default: a new one]
    #[arg(long, value_name = "UUID")]
    request_id: Option<String>,
    #[command(flatten)]
    importance: Importance,
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
    let prepared = upload::prepare(&args.data, &config)?;
    for warning in &prepared.warnings {
        eprintln!("{warning}");
    }
    let name = args.name.unwrap_or_else(|| folder_name(&args.data));
    let request_id = args.request_id.unwrap_or_else(|| uuid::Uuid::new_v4().to_string());
    let ticket = JobTicket {
        name: &name,
        request_id: &request_id,
        priority: args.importance.priority.unwrap_or_default(),
        max_parallel: args.importance.max_parallel.unwrap_or_default(),
    };
    let job = upload::submit(&client, &prepared, &config, ticket, begin).await?;
    if args.json {
        return output::json(&json!({
            "job": job.job_id,
            "name": job.name,
            "request_id": request_id,
            "views": prepared.manifest.views.len(),
            "coordinator": client.url,
        }));
    }
    output::line(&job.job_id);
    Ok(())
}

/// Last component of a path, for people.
pub fn folder_name(path: &Path) -> String {
    let path = std::fs::canonicalize(path).unwrap_or_else(|_| path.to_owned());
    path.file_name().map_or_else(|| "scene".to_owned(), |name| name.to_string_lossy().into_owned())
}
