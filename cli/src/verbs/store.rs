//! `fathom store`: backs up, moves and checks the jobs of a coordinator. On a data directory, all verbs but
//! `backup` need a stopped coordinator; `export` and `verify` open a copy of the store and change nothing.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use fathom_coordinator::maintenance::{self, Counts, Moved, Place};
use serde_json::json;

use super::ServiceArgs;
use crate::error::{CliError, Result};
use crate::output;

/// Arguments of `fathom store`.
#[derive(Args, Debug)]
pub struct StoreArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand, Debug)]
enum What {
    /// Write a consistent copy of a running coordinator's store into one file; then copy the folders
    /// `objects` and `tenants`
    Backup {
        #[command(flatten)]
        service: ServiceArgs,
        /// The file to write; an existing file is replaced once the backup is complete
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
        /// Print as JSON
        #[arg(long)]
        json: bool,
    },
    /// Write all jobs into one file; copy photographs and models from the folder `objects` yourself. The data
    /// directory is only read
    Export {
        #[command(flatten)]
        data: DataDir,
        #[command(flatten)]
        copy: CopyArgs,
        /// The file to write; an existing file is replaced
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
    /// Create the store of a new data directory, or fill an empty database, from an exported file
    Import {
        /// A file written by `fathom store export` or `backup`
        #[arg(value_name = "FILE")]
        file: PathBuf,
        #[command(flatten)]
        data: DataDir,
    },
    /// Copy jobs, files and logs of a stopped coordinator to another data directory, database or bucket, and
    /// verify them there. What it copied stays when it is interrupted, and the next move goes on from there
    Move {
        #[command(flatten)]
        data: DataDir,
        #[command(flatten)]
        files: ObjectsArg,
        #[command(flatten)]
        copy: CopyArgs,
        /// Data directory of the new coordinator [default: the same]
        #[arg(long, value_name = "DIR")]
        to_data_dir: Option<PathBuf>,
        /// PostgreSQL database for the jobs, which must be empty [default: a store in the data directory]
        #[arg(long, value_name = "URL")]
        to_store: Option<String>,
        /// Bucket or folder for the files [default: the data directory]
        #[arg(long, value_name = "URL")]
        to_objects: Option<String>,
    },
    /// Check that everything is present and intact; the data directory is only read. Exits with 1 on a fault
    Verify {
        #[command(flatten)]
        data: DataDir,
        #[command(flatten)]
        files: ObjectsArg,
        #[command(flatten)]
        copy: CopyArgs,
        /// Also hash every file that a job references
        #[arg(long)]
        deep: bool,
    },
}

/// The data directory, and the database if it has the jobs.
#[derive(Args, Debug)]
struct DataDir {
    /// Data directory of the coordinator, which must be stopped, except with --store
    #[arg(long, value_name = "DIR", env = "FATHOM_DATA_DIR", default_value = "fathom-data")]
    data_dir: PathBuf,
    /// PostgreSQL database of the coordinator, which may run [default: its jobs are in the data directory]
    #[arg(long, value_name = "URL", env = "FATHOM_STORE", hide_env_values = true)]
    store: Option<String>,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

/// Where the files of jobs are.
#[derive(Args, Debug)]
struct ObjectsArg {
    /// Bucket or folder of the coordinator's files [default: they are in the data directory]
    #[arg(long, value_name = "URL", env = "FATHOM_OBJECTS")]
    objects: Option<String>,
}

impl DataDir {
    fn place(&self) -> Place {
        Place { data_dir: self.data_dir.clone(), store: self.store.clone(), objects: None }
    }
}

/// Folder for the temporary copy of a store that is only read.
#[derive(Args, Debug)]
pub struct CopyArgs {
    /// Folder for a temporary copy of the store. The copy is opened instead of the store, because opening
    /// changes files [default: the system's temporary folder]
    #[arg(long, value_name = "DIR")]
    pub scratch: Option<PathBuf>,
}

pub async fn run(args: StoreArgs) -> Result<()> {
    let failed = |error: fathom_coordinator::CoordinatorError| CliError::Message(error.to_string());
    match args.what {
        What::Backup { service, output, json } => {
            let backup = service.client().await?.back_up_store().await?;
            let counts = maintenance::keep_backup(&backup, &output).map_err(failed)?;
            print_counts(counts, json, &format!("backed up to {}", output.display()))
        }
        What::Export { data, copy, output } => {
            let counts =
                maintenance::export(&data.place(), copy.scratch.as_deref(), &output).await.map_err(failed)?;
            print_counts(counts, data.json, &format!("exported to {}", output.display()))
        }
        What::Import { file, data } => {
            let counts = maintenance::import(&file, &data.place()).await.map_err(failed)?;
            print_counts(counts, data.json, &format!("imported into {}", data.place()))
        }
        What::Move { data, files, copy, to_data_dir, to_store, to_objects } => {
            let from = Place { objects: files.objects, ..data.place() };
            let data_dir = to_data_dir.unwrap_or_else(|| data.data_dir.clone());
            let to = Place { data_dir, store: to_store, objects: to_objects };
            let moved =
                maintenance::move_service(&from, copy.scratch.as_deref(), &to).await.map_err(failed)?;
            let Moved { counts, blobs, bytes, logs, damaged, faults } = moved;
            if data.json {
                let Counts { jobs, tasks, events, datasets } = counts;
                output::json(&json!({
                    "jobs": jobs, "tasks": tasks, "events": events, "datasets": datasets,
                    "copied_blobs": blobs, "copied_bytes": bytes, "copied_log_lines": logs,
                    "damaged": damaged, "faults": faults,
                }))?;
            } else {
                damaged.iter().for_each(|digest| {
                    output::line(format!("blob {digest} is damaged; it was not copied"));
                });
                faults.iter().for_each(output::line);
                let rest = format!("{blobs} blobs of {bytes} bytes and {logs} log lines copied to {to}");
                print_counts(counts, false, &rest)?;
            }
            match faults.len() {
                0 => Ok(()),
                count => Err(CliError::Message(format!(
                    "{count} faults in {to}; the old service is unchanged: repair it, remove the jobs in {to}, and move again"
                ))),
            }
        }
        What::Verify { data, files, copy, deep } => {
            let place = Place { objects: files.objects, ..data.place() };
            let found = maintenance::verify(&place, copy.scratch.as_deref(), deep).await.map_err(failed)?;
            if data.json {
                let Counts { jobs, tasks, events, datasets } = found.counts;
                output::json(&json!({
                    "jobs": jobs, "tasks": tasks, "events": events, "datasets": datasets,
                    "blobs": found.blobs, "bytes": found.bytes, "faults": found.faults,
                }))?;
            } else {
                found.faults.iter().for_each(output::line);
                let checked = if deep { "all hashed" } else { "present, not hashed (--deep)" };
                let rest = format!("{} blobs of {} bytes, {checked}", found.blobs, found.bytes);
                print_counts(found.counts, false, &rest)?;
            }
            match found.faults.len() {
                0 => Ok(()),
                count => Err(CliError::Message(format!(
                    "{count} faults in {}; restore it from an export and a copy of its folder objects",
                    data.place()
                ))),
            }
        }
    }
}

fn print_counts(counts: Counts, json: bool, rest: &str) -> Result<()> {
    let Counts { jobs, tasks, events, datasets } = counts;
    if json {
        return output::json(
            &json!({ "jobs": jobs, "tasks": tasks, "events": events, "datasets": datasets }),
        );
    }
    output::line(format!("{jobs} jobs, {tasks} tasks, {events} events, {datasets} datasets; {rest}"));
    Ok(())
}
