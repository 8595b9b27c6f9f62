//! `fathom store`: backups and checks of a coordinator's data directory. All but `backup` want it stopped;
//! `export` and `verify` open a copy of the store, and change nothing.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use fathom_coordinator::maintenance::{self, Counts};
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
    /// Write the store of a running coordinator into one file, as it is at one moment; then copy the folders
    /// `objects` and `tenants`
    Backup {
        #[command(flatten)]
        service: ServiceArgs,
        /// The file to write; replaced when it is there, once the backup is known to be whole
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
        /// Print as JSON
        #[arg(long)]
        json: bool,
    },
    /// Write all jobs into one file; photographs and models stay in the folder `objects`, to be copied as
    /// they are. The data directory is only read
    Export {
        #[command(flatten)]
        data: DataDir,
        #[command(flatten)]
        copy: CopyArgs,
        /// The file to write; replaced when it is there
        #[arg(short, long, value_name = "FILE")]
        output: PathBuf,
    },
    /// Make the store of a new data directory of an exported file
    Import {
        /// What `fathom store export` or `backup` wrote
        #[arg(value_name = "FILE")]
        file: PathBuf,
        #[command(flatten)]
        data: DataDir,
    },
    /// Look whether everything is there and as it must be; the data directory is only read. Exits with 1 when
    /// something is not
    Verify {
        #[command(flatten)]
        data: DataDir,
        #[command(flatten)]
        copy: CopyArgs,
        /// Also hash every file that a job refers to
        #[arg(long)]
        deep: bool,
    },
}

/// Which data directory.
#[derive(Args, Debug)]
struct DataDir {
    /// Folder of the coordinator, which must be stopped
    #[arg(long, value_name = "DIR", env = "FATHOM_DATA_DIR", default_value = "fathom-data")]
    data_dir: PathBuf,
    /// Print as JSON
    #[arg(long)]
    json: bool,
}

/// Where the copy of a store goes that is only looked at.
#[derive(Args, Debug)]
pub struct CopyArgs {
    /// Folder with room for a copy of the store, which is what is opened: opening changes files. The copy
    /// goes in the end [default: where the system has temporary files]
    #[arg(long, value_name = "DIR")]
    pub scratch: Option<PathBuf>,
}

pub async fn run(args: StoreArgs) -> Result<()> {
    let failed = |error: fathom_coordinator::CoordinatorError| CliError::Message(error.to_string());
    match args.what {
        What::Backup { service, output, json } => {
            let backup = service.client().await?.back_up_store().await?;
            let counts = maintenance::keep_backup(&backup, &output).map_err(failed)?;
            tell(counts, json, &format!("backed up to {}", output.display()))
        }
        What::Export { data, copy, output } => {
            let counts = maintenance::export(&data.data_dir, copy.scratch.as_deref(), &output)
                .await
                .map_err(failed)?;
            tell(counts, data.json, &format!("exported to {}", output.display()))
        }
        What::Import { file, data } => {
            let counts = maintenance::import(&file, &data.data_dir).await.map_err(failed)?;
            tell(counts, data.json, &format!("imported into {}", data.data_dir.display()))
        }
        What::Verify { data, copy, deep } => {
            let found =
                maintenance::verify(&data.data_dir, copy.scratch.as_deref(), deep).await.map_err(failed)?;
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
                tell(found.counts, false, &rest)?;
            }
            match found.faults.len() {
                0 => Ok(()),
                count => Err(CliError::Message(format!(
                    "{count} faults in {}; restore it from an export and a copy of its folder objects",
                    data.data_dir.display()
                ))),
            }
        }
    }
}

fn tell(counts: Counts, json: bool, rest: &str) -> Result<()> {
    let Counts { jobs, tasks, events, datasets } = counts;
    if json {
        return output::json(
            &json!({ "jobs": jobs, "tasks": tasks, "events": events, "datasets": datasets }),
        );
    }
    output::line(format!("{jobs} jobs, {tasks} tasks, {events} events, {datasets} datasets; {rest}"));
    Ok(())
}
