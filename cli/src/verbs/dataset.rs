//! `fathom dataset`: scenes that are handed in once, for any number of jobs.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use fathom_core::config::JobConfig;
use fathom_proto::v1::{Dataset, DatasetState};
use serde_json::{Value, json};

use super::ServiceArgs;
use crate::error::{CliError, Result};
use crate::{output, upload};

/// Arguments of `fathom dataset`.
#[derive(Args, Debug)]
pub struct DatasetArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand, Debug)]
enum What {
    /// Hand a scene in; jobs are made of it with `fathom submit --dataset`
    Upload(UploadArgs),
    /// List the datasets of a service
    List(ListArgs),
    /// Show one dataset
    Show(ShowArgs),
    /// Forget a dataset that no job was made of; its files go when nothing else needs them
    Delete(OneDataset),
}

#[derive(Args, Debug)]
struct UploadArgs {
    /// Scene: a folder with images/ and sparse/0, or with a transforms.json
    #[arg(value_name = "DATA")]
    data: PathBuf,
    /// Name of the dataset, lower-case letters, digits, -, _ and . [default: one that the service makes]
    #[arg(long, default_value = "", hide_default_value = true)]
    id: String,
    /// Makes repeating this command harmless: one id begins one dataset [default: a new one]
    #[arg(long, value_name = "UUID")]
    request_id: Option<String>,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print {"dataset": ID, ...}
    #[arg(long)]
    json: bool,
}

#[derive(Args, Debug)]
struct ListArgs {
    #[command(flatten)]
    service: ServiceArgs,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Args, Debug)]
struct ShowArgs {
    #[command(flatten)]
    which: OneDataset,
    /// Print its files too, each with its digest and its length
    #[arg(long)]
    files: bool,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Args, Debug)]
struct OneDataset {
    /// Which dataset
    #[arg(value_name = "DATASET")]
    dataset: String,
    #[command(flatten)]
    service: ServiceArgs,
}

pub async fn run(args: DatasetArgs) -> Result<()> {
    match args.what {
        What::Upload(args) => hand_in(args).await,
        What::List(args) => {
            let client = args.service.client().await?;
            let datasets = client.datasets().await?;
            if args.json {
                return output::json(&datasets.iter().map(dataset_json).collect::<Vec<_>>());
            }
            if datasets.is_empty() {
                output::line(format!("no datasets at {}", client.url));
            }
            datasets.iter().for_each(|dataset| output::line(dataset_line(dataset)));
            Ok(())
        }
        What::Show(args) => {
            let client = args.which.service.client().await?;
            let dataset = client.dataset(&args.which.dataset).await?;
            let root = dataset.root.clone().unwrap_or_default();
            let list = if args.files { Some(client.read(&root).await?) } else { None };
            let list = list.as_ref().map(|list| String::from_utf8_lossy(list));
            if args.json {
                let mut value = dataset_json(&dataset);
                if let Some(list) = list {
                    value["list"] = list.lines().map(file_json).collect::<Option<_>>().ok_or_else(|| {
                        let message = "the coordinator sent a list of files that cannot be read; use programs of one version";
                        CliError::Message(message.to_owned())
                    })?;
                }
                return output::json(&value);
            }
            output::line(dataset_line(&dataset));
            output::line(format!("  root digest {}", root.digest));
            if let Some(list) = list {
                output::lines(list);
            }
            Ok(())
        }
        What::Delete(OneDataset { dataset, service }) => {
            service.client().await?.delete_dataset(&dataset).await?;
            output::line(format!("{dataset} is forgotten"));
            Ok(())
        }
    }
}

async fn hand_in(args: UploadArgs) -> Result<()> {
    // How many views a job holds out is no matter of the files.
    let mut config = JobConfig::default();
    config.data.test_every = 0;
    let client = args.service.client().await?;
    client.may_upload().await?;
    let prepared = upload::prepare(&args.data, &config)?;
    for warning in &prepared.warnings {
        output::remark(warning);
    }
    let request_id = args.request_id.unwrap_or_else(|| uuid::Uuid::new_v4().to_string());
    let dataset = upload::upload_dataset(&client, &prepared, &args.id, &request_id).await?;
    if args.json {
        return output::json(&dataset_json(&dataset));
    }
    output::line(&dataset.dataset_id);
    Ok(())
}

fn state_word(dataset: &Dataset) -> &'static str {
    match dataset.state() {
        DatasetState::Unspecified => "unknown",
        DatasetState::Uploading => "uploading",
        DatasetState::Committed => "committed",
    }
}

fn dataset_line(dataset: &Dataset) -> String {
    format!(
        "{:<24} {:<9} {}, {}",
        dataset.dataset_id,
        state_word(dataset),
        output::count(dataset.files, "file"),
        output::bytes(dataset.size_bytes)
    )
}

/// A line of the list of files: digest, length and path.
fn file_json(line: &str) -> Option<Value> {
    let mut parts = line.splitn(3, ' ');
    let (digest, bytes, path) = (parts.next()?, parts.next()?.parse::<u64>().ok()?, parts.next()?);
    Some(json!({ "path": path, "digest": digest, "bytes": bytes }))
}

fn dataset_json(dataset: &Dataset) -> Value {
    let seconds = output::unix_seconds;
    json!({
        "dataset": dataset.dataset_id,
        "state": state_word(dataset),
        "tenant": dataset.tenant,
        "root_digest": dataset.root.as_ref().map(|root| &root.digest),
        "files": dataset.files,
        "bytes": dataset.size_bytes,
        "created_unix_seconds": seconds(&dataset.create_time),
        "committed_unix_seconds": seconds(&dataset.commit_time),
        "ends_unix_seconds": seconds(&dataset.expire_time),
    })
}
