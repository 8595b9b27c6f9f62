//! `fathom train`: starts a coordinator and workers on a loopback port; submits, watches, downloads.
//!
//! The steps are the same as with a service, so OUT is the same. Until the run succeeds, `OUT/.fathom` holds
//! all state needed to resume it.

use std::collections::BTreeSet;
use std::io::IsTerminal as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;
use fathom_core::config::{JobConfig, PartitionConfig};
use fathom_proto::dial::Dial;
use fathom_proto::v1::Job;
use serde::{Deserialize, Serialize};

use super::submit::folder_name;
use super::watch::follow;
use crate::children::{Children, stop_signal};
use crate::client::Client;
use crate::config_args::JobArgs;
use crate::error::{CliError, Result};
use crate::model::GpuArgs;
use crate::output;
use crate::upload::{self, JobTicket};

/// Arguments of `fathom train`.
#[derive(Args, Debug)]
pub struct TrainArgs {
    /// Scene: a folder with images/ and sparse/0, or with a transforms.json
    #[arg(value_name = "DATA", required_unless_present = "source")]
    data: Option<PathBuf>,
    /// Alias of DATA, as in other trainers
    #[arg(long = "data", short = 's', value_name = "DATA", conflicts_with = "data", hide = true)]
    source: Option<PathBuf>,
    /// Folder for the result
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    #[command(flatten)]
    job: JobArgs,
    /// Workers on this machine; they are assigned to its GPUs round robin
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=256))]
    workers: u32,
    #[command(flatten)]
    gpu: GpuArgs,
    /// Show the run on a page in the browser while it lasts, and print its link; the link is for you alone
    /// [default: true in a terminal]
    #[arg(long, num_args = 0..=1, default_missing_value = "true", require_equals = true, value_name = "BOOL")]
    web: Option<bool>,
    /// Resume the interrupted run in OUT
    #[arg(long)]
    resume: bool,
    /// Print metrics.json at the end
    #[arg(long)]
    json: bool,
}

pub async fn run(args: TrainArgs) -> Result<()> {
    let begin = Instant::now();
    let data = args.data.or(args.source).ok_or_else(|| CliError::Message("DATA is missing".to_owned()))?;
    let mut config = args.job.resolve()?;
    // Everything that can be refused is checked before anything is written.
    let left = RunFolder::check(&args.output, args.resume)?;
    let adapters = args.gpu.share_out(args.workers)?;
    match left.filter(|_| args.resume).and_then(|left| left.planned_for) {
        // The partitioning is part of the job, so a resumed run keeps it.
        Some((workers, memory_gib)) => {
            (config.partition.workers, config.partition.memory_gib) = (workers, memory_gib);
        }
        None => plan_for_own_workers(&mut config.partition, &adapters, args.gpu.gpu_memory_limit),
    }
    let planned_for =
        config.partition.auto.then_some((config.partition.workers, config.partition.memory_gib));
    let prepared = upload::prepare(&data, &config)?;
    let run = RunFolder::open(&args.output, args.resume, planned_for)?;
    for warning in &prepared.warnings {
        output::remark(warning);
    }
    let worker_arguments: Vec<Vec<String>> = (0..)
        .zip(adapters)
        .map(|(index, adapter)| worker_arguments(index, adapter, &args.gpu, &run))
        .collect();
    let with_page = args.web.unwrap_or_else(|| std::io::stderr().is_terminal());
    let mut children = Children::start(&run.store(), &run.logs(), &worker_arguments, with_page).await?;
    if let Some(page) = &children.page {
        output::remark(format!("see the run at {page}"));
        if std::env::var_os("SSH_CONNECTION").is_some() {
            output::remark(from_afar(page));
        }
    }
    let job = Submission { data: &data, prepared: &prepared, config: &config, begin };
    let url = children.url.clone();
    let outcome = tokio::select! {
        outcome = job.through(&url, &run) => outcome,
        failure = children.failure() => Err(failure),
        () = stop_signal() => Err(CliError::Interrupted(format!(
            "interrupted; repeat the command with --resume to continue the run in {}",
            run.out.display()
        ))),
    };
    children.stop().await;
    if matches!(outcome, Err(CliError::Job { .. }))
        && let Err(error) = run.mark_failed()
    {
        // The failure of the job matters more.
        output::remark(format!("fathom: {error}"));
    }
    outcome?;
    run.finish()?;
    report(&run.out, args.json)
}

/// How to open a page of this machine from the one where the user sits.
fn from_afar(page: &str) -> String {
    let port =
        page.split(['/', '#']).nth(2).and_then(|host| host.rsplit_once(':')).map_or("PORT", |(_, port)| port);
    format!(
        "from the machine that you sit at: ssh -L {port}:127.0.0.1:{port} THIS_MACHINE, then open this link there"
    )
}

/// Sets the workers that `--partitions auto` plans for, even if they have not registered yet. Workers that
/// share a GPU count as one, because together they are no faster than one.
fn plan_for_own_workers(partition: &mut PartitionConfig, adapters: &[Option<usize>], limit: Option<u64>) {
    if !partition.auto {
        return;
    }
    if partition.workers == 0 {
        partition.workers = adapters.iter().collect::<BTreeSet<_>>().len() as u32;
    }
    if let (0.0, Some(limit)) = (partition.memory_gib, limit) {
        partition.memory_gib = limit as f64 / f64::from(1 << 30);
    }
}

fn worker_arguments(index: usize, adapter: Option<usize>, gpu: &GpuArgs, run: &RunFolder) -> Vec<String> {
    let cache = run.hidden.join("cache");
    let mut arguments = vec!["--name".to_owned(), format!("worker-{index}")];
    arguments.extend(["--cache-dir".to_owned(), cache.to_string_lossy().into_owned()]);
    if let Some(adapter) = adapter {
        arguments.extend(["--gpu".to_owned(), adapter.to_string()]);
    }
    if gpu.allow_cpu == Some(true) {
        arguments.push("--allow-cpu".to_owned());
    }
    if let Some(limit) = gpu.gpu_memory_limit {
        arguments.extend(["--gpu-memory-limit".to_owned(), limit.to_string()]);
    }
    arguments
}

/// A scene submitted to the child processes.
struct Submission<'a> {
    data: &'a Path,
    prepared: &'a upload::Prepared,
    config: &'a JobConfig,
    begin: Instant,
}

impl Submission<'_> {
    async fn through(&self, url: &str, run: &RunFolder) -> Result<()> {
        let client = Client::connect(&Dial::to(url)).await?;
        let job = self.create(&client, run).await?;
        follow(&client, &job.job_id, false).await?;
        client.download(&job.job_id, &run.out).await?;
        Ok(())
    }

    /// Creates the job, or finds that of the resumed run by its request id.
    async fn create(&self, client: &Client, run: &RunFolder) -> Result<Job> {
        let name = folder_name(self.data);
        let ticket =
            JobTicket { name: &name, request_id: &run.request.request_id, priority: 0, max_parallel: 0 };
        upload::submit(client, self.prepared, self.config, ticket, self.begin).await.map_err(|error| {
            match error {
                CliError::Refused { message, .. } if run.goes_on => CliError::Message(format!(
                    "the run in {} cannot continue with this input: {message}; use its original settings, or \
                     start a new run in another folder",
                    run.out.display()
                )),
                other => other,
            }
        })
    }
}

/// Identifies a run to its coordinator.
#[derive(Serialize, Deserialize)]
struct RunRequest {
    request_id: String,
    /// Its job has failed for good and cannot be resumed.
    failed: bool,
    /// With `--partitions auto`: number of workers and memory, GiB, that the partitions are planned for.
    planned_for: Option<(u32, f64)>,
}

/// Files of a result. They are never replaced, so none may exist when a run starts.
const RESULTS: [&str; 12] = [
    "model.ply",
    "model.compressed.ply",
    "model.json",
    "water.json",
    "surface.json",
    "sets",
    "metrics.json",
    "run.json",
    "plan.json",
    "plan.png",
    "cameras.json",
    "renders",
];

/// OUT, and the hidden folder in it that holds an unfinished run.
struct RunFolder {
    out: PathBuf,
    hidden: PathBuf,
    request: RunRequest,
    goes_on: bool,
}

impl RunFolder {
    /// Checks that a run may start or resume in `out`; writes nothing. Returns the request of an earlier run.
    fn check(out: &Path, resume: bool) -> Result<Option<RunRequest>> {
        let note = out.join(".fathom").join("request.json");
        let refuse = |what: &str| Err(CliError::Message(format!("{} {what}", out.display())));
        let left: Option<RunRequest> = if note.is_file() {
            let value = output::read_json(&note)?;
            let left = serde_json::from_value(value)
                .map_err(|error| CliError::Message(format!("{}: {error}", note.display())))?;
            Some(left)
        } else {
            None
        };
        match &left {
            None if resume => return refuse("holds no interrupted run; start without --resume"),
            Some(left) if resume && left.failed => {
                return refuse("holds a run that failed for good; fix the cause and start without --resume");
            }
            Some(left) if !resume && !left.failed => {
                return refuse("holds an interrupted run; continue with --resume, or delete the folder");
            }
            _ => {}
        }
        if let Some(file) = RESULTS.iter().find(|file| !resume && out.join(file).exists()) {
            let what = format!("already holds a result ({file}); choose another folder, or delete this one");
            return refuse(&what);
        }
        Ok(left)
    }

    fn open(out: &Path, resume: bool, planned_for: Option<(u32, f64)>) -> Result<Self> {
        let left = Self::check(out, resume)?;
        let hidden = out.join(".fathom");
        if !resume && hidden.exists() {
            std::fs::remove_dir_all(&hidden).map_err(CliError::io("remove", &hidden))?;
        }
        std::fs::create_dir_all(&hidden).map_err(CliError::io("create", &hidden))?;
        let new = RunRequest { request_id: uuid::Uuid::new_v4().to_string(), failed: false, planned_for };
        let run = Self {
            out: out.to_owned(),
            hidden,
            request: left.filter(|_| resume).unwrap_or(new),
            goes_on: resume,
        };
        if !resume {
            run.write_note(false)?;
        }
        Ok(run)
    }

    fn write_note(&self, failed: bool) -> Result<()> {
        let note = self.hidden.join("request.json");
        let RunRequest { request_id, planned_for, .. } = &self.request;
        let text =
            serde_json::json!({ "request_id": request_id, "failed": failed, "planned_for": planned_for })
                .to_string();
        // Written atomically: without this file the run cannot be resumed.
        let partial = self.hidden.join("request.json.part");
        std::fs::write(&partial, text).map_err(CliError::io("write", &partial))?;
        std::fs::rename(&partial, &note).map_err(CliError::io("write", &note))
    }

    /// The job has failed for good; the next run here starts over.
    fn mark_failed(&self) -> Result<()> {
        self.write_note(true)
    }

    fn store(&self) -> PathBuf {
        self.hidden.join("coordinator")
    }

    fn logs(&self) -> PathBuf {
        self.out.join("logs")
    }

    /// The result is complete, so the state for resuming is deleted.
    fn finish(&self) -> Result<()> {
        std::fs::remove_dir_all(&self.hidden).map_err(CliError::io("remove", &self.hidden))
    }
}

/// Prints the paths of the result and its metrics.
fn report(out: &Path, json: bool) -> Result<()> {
    let metrics = output::read_json(&out.join("metrics.json"))?;
    if json {
        return output::json(&metrics);
    }
    output::line(format!("model:   {}", out.join("model.ply").display()));
    output::line(format!("plan:    {}", out.join("plan.png").display()));
    output::line(format!("renders: {}", out.join("renders").display()));
    output::lines(crate::eval_summary::summary(&metrics));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(out: &Path, resume: bool) -> String {
        RunFolder::open(out, resume, None).err().map(|error| error.to_string()).unwrap_or_default()
    }

    #[test]
    fn a_user_on_another_machine_gets_the_way_to_the_page() {
        let said = from_afar("http://127.0.0.1:7480/#invitation=fathom_a_b");
        assert!(said.contains("ssh -L 7480:127.0.0.1:7480 "), "{said}");
        assert!(!said.contains("fathom_"), "the secret once more: {said}");
    }

    #[test]
    fn workers_get_the_adapter_and_its_limits() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let run = RunFolder::open(&folder.path().join("out"), false, None).expect("a new run");
        let gpu = GpuArgs { gpu: None, allow_cpu: Some(true), gpu_memory_limit: Some(1 << 30) };
        let arguments = worker_arguments(1, Some(2), &gpu, &run);
        assert_eq!(arguments[..2], ["--name", "worker-1"]);
        assert_eq!(arguments[4..], ["--gpu", "2", "--allow-cpu", "--gpu-memory-limit", "1073741824"]);
        assert_eq!(worker_arguments(1, None, &GpuArgs::default(), &run).len(), 4);
    }

    #[test]
    fn a_choice_of_partitions_is_made_for_the_gpus_of_this_machine() {
        let planned = |auto, adapters: &[Option<usize>], limit| {
            let mut partition = PartitionConfig { auto, ..PartitionConfig::default() };
            plan_for_own_workers(&mut partition, adapters, limit);
            (partition.workers, partition.memory_gib)
        };
        assert_eq!(planned(true, &[Some(0), Some(1), Some(0)], Some(3 << 29)), (2, 1.5));
        assert_eq!(planned(true, &[None, None, None], None), (1, 0.0), "workers on one CPU share it");
        assert_eq!(planned(false, &[Some(0), Some(1)], Some(1 << 30)), (0, 0.0));
    }

    #[test]
    fn a_run_is_resumed_only_where_one_was_interrupted() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let out = folder.path().join("out");
        assert!(refused(&out, true).contains("holds no interrupted run"));
        let first = RunFolder::open(&out, false, Some((3, 1.5))).expect("a new run");
        assert!(refused(&out, false).contains("--resume"));
        let left = RunFolder::check(&out, true).expect("it may go on").expect("it left a note");
        assert_eq!(left.planned_for, Some((3, 1.5)), "what it was cut for");
        let second = RunFolder::open(&out, true, None).expect("the same run");
        assert_eq!(first.request.request_id, second.request.request_id);
        assert_eq!(second.request.planned_for, Some((3, 1.5)));
        second.mark_failed().expect("a note");
        assert!(refused(&out, true).contains("failed for good"));
        let third = RunFolder::open(&out, false, None).expect("a run in place of the failed one");
        assert_ne!(first.request.request_id, third.request.request_id);
        third.finish().expect("a finished run");
        for file in ["plan.json", "model.ply"] {
            std::fs::write(out.join(file), "").expect("a result");
            assert!(refused(&out, false).contains("already holds a result"));
            std::fs::remove_file(out.join(file)).expect("the file is there");
        }
        std::fs::create_dir(out.join("renders")).expect("a folder");
        assert!(refused(&out, false).contains("renders"));
    }
}
