//! `fathom watch`: follows a job to its end.
//!
//! Events are followed by their number, so a lost connection or a restarted coordinator loses none.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use clap::Args;
use fathom_proto::v1::job_event::Event;
use fathom_proto::v1::{HeldOutMetrics, Job, JobState, TaskState};
use serde_json::json;

use super::ServiceArgs;
use super::show::{job_json, stage_word, task_word};
use crate::client::Client;
use crate::error::{CliError, Result};
use crate::output;
use crate::progress::{Progress, Unit};

/// Arguments of `fathom watch`.
#[derive(Args, Debug)]
pub struct WatchArgs {
    /// Which job
    #[arg(value_name = "JOB")]
    job: String,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print one JSON object a line for every event, and the job at the end
    #[arg(long)]
    json: bool,
}

pub async fn run(args: WatchArgs) -> Result<()> {
    let client = args.service.client().await?;
    let job = follow(&client, &args.job, args.json).await?;
    if args.json {
        output::json(&job_json(&job))?;
    } else {
        output::line(format!("job {} has succeeded", job.job_id));
    }
    Ok(())
}

/// How long a coordinator may be away before a watcher gives up: a restart and a repair of its store.
const PATIENCE: Duration = Duration::from_secs(180);

/// Follows a job with progress on stderr until it has succeeded; every other end is an error.
pub async fn follow(client: &Client, id: &str, print_events: bool) -> Result<Job> {
    let mut view = View::new(id);
    let mut seq = 0;
    let mut away_since: Option<Instant> = None;
    loop {
        match watch_once(client, id, &mut seq, &mut view, print_events).await {
            Ok(()) => away_since = None,
            Err(error @ CliError::Unreachable { .. }) => {
                let since = *away_since.get_or_insert_with(Instant::now);
                if since.elapsed() > PATIENCE {
                    return Err(error);
                }
                tokio::time::sleep(Duration::from_millis(500)).await;
                continue;
            }
            Err(error) => return Err(error),
        }
        let job = client.job(id).await?;
        let end = |outcome| CliError::Job { job: id.to_owned(), outcome, message: job.error.clone() };
        match job.state() {
            JobState::Succeeded => return Ok(job),
            JobState::Failed => return Err(end("failed")),
            JobState::Cancelled => return Err(end("was cancelled")),
            // The stream ended before the job did: it is opened again, not too often.
            JobState::Running | JobState::Paused | JobState::Unspecified => {
                tokio::time::sleep(Duration::from_millis(200)).await
            }
        }
    }
}

async fn watch_once(client: &Client, id: &str, seq: &mut u64, view: &mut View, print: bool) -> Result<()> {
    let mut events = client.watch(id, *seq).await?;
    loop {
        match events.message().await {
            Ok(Some(event)) => {
                *seq = (*seq).max(event.seq);
                if let Some(event) = event.event {
                    if print {
                        print_event(*seq, &event);
                    }
                    view.show(&event);
                }
            }
            Ok(None) => return Ok(()),
            Err(status) => return Err(client.fault("watch the job", &status)),
        }
    }
}

/// What a person sees of a job: one bar for all of it, and a line for what matters.
struct View {
    progress: Progress,
    tasks: BTreeMap<String, String>,
    /// The latest measurement of each task, which every report of it repeats.
    measured: BTreeMap<String, HeldOutMetrics>,
    share: f64,
}

impl View {
    fn new(id: &str) -> Self {
        let progress = Progress::new(format!("job {id}"), 1000, Unit::PerMille);
        Self { progress, tasks: BTreeMap::new(), measured: BTreeMap::new(), share: 0.0 }
    }

    /// A line for a measurement that was not shown yet.
    fn show_measured(&mut self, task: &str, held_out: Option<HeldOutMetrics>) {
        let Some(m) = held_out else { return };
        if self.measured.insert(task.to_owned(), m) != Some(m) {
            let HeldOutMetrics { iteration, psnr_db, ssim, views } = m;
            self.progress.note(&format!(
                "  {task}: iteration {iteration}, held out {psnr_db:.2} dB, SSIM {ssim:.4} ({views} views)"
            ));
        }
    }

    fn show(&mut self, event: &Event) {
        match event {
            Event::JobStage(stage) => self.progress.note(stage_word(stage.stage())),
            Event::TaskChanged(task) => {
                if task.state() != TaskState::Leased {
                    self.tasks.remove(&task.task_id);
                }
                let mut line = format!("  {}: {}", task.task_id, task_word(task.state()));
                if task.attempt > 1 {
                    line += &format!(", attempt {}", task.attempt);
                }
                if task.resumed_from_iteration > 0 {
                    line += &format!(", goes on from iteration {}", task.resumed_from_iteration);
                }
                if !task.message.is_empty() {
                    line += &format!(" ({})", task.message);
                }
                if !matches!(task.state(), TaskState::Blocked | TaskState::Ready) || !task.message.is_empty()
                {
                    self.progress.note(&line);
                }
            }
            Event::Progress(update) => {
                if let Some(p) = &update.progress {
                    let text = format!(
                        "{} {}/{}, {:.1} it/s, {} Gaussians",
                        update.task_id, p.iteration, p.iterations, p.iterations_per_second, p.gaussians
                    );
                    self.tasks.insert(update.task_id.clone(), text);
                    self.show_measured(&update.task_id, p.held_out);
                }
                self.share = self.share.max(update.job_progress);
            }
            Event::Warning(warning) => self.progress.note(&warning.message),
            Event::JobState(change) => {
                if change.state() == JobState::Paused {
                    self.progress.note("paused; `fathom resume` goes on");
                } else if change.state() == JobState::Running && !change.message.is_empty() {
                    self.progress.note(&change.message);
                }
            }
            Event::Updated(_) | Event::Checkpoint(_) | Event::KeepAlive(_) => {}
        }
        let running = self.tasks.values().cloned().collect::<Vec<_>>().join("; ");
        self.progress.set((1000.0 * self.share) as u64, &running);
    }
}

fn print_event(seq: u64, event: &Event) {
    let value = match event {
        Event::JobState(change) => {
            json!({"event": "job_state", "state": change.state().as_str_name(), "message": change.message})
        }
        Event::JobStage(change) => {
            json!({"event": "job_stage", "stage": stage_word(change.stage()), "tasks": change.tasks})
        }
        Event::TaskChanged(task) => json!({
            "event": "task",
            "task": task.task_id,
            "state": task_word(task.state()),
            "attempt": task.attempt,
            "worker": task.worker,
            "message": task.message,
            "resumed_from_iteration": task.resumed_from_iteration,
        }),
        Event::Progress(update) => json!({
            "event": "progress",
            "task": update.task_id,
            "iteration": update.progress.map_or(0, |p| p.iteration),
            "iterations": update.progress.map_or(0, |p| p.iterations),
            "gaussians": update.progress.map_or(0, |p| p.gaussians),
            "loss": update.progress.map(|p| p.loss),
            "held_out": update.progress.and_then(|p| p.held_out).map(|m| json!({
                "iteration": m.iteration, "psnr": m.psnr_db, "ssim": m.ssim, "views": m.views,
            })),
            "job_progress": update.job_progress,
        }),
        Event::Checkpoint(checkpoint) => json!({
            "event": "checkpoint",
            "task": checkpoint.task_id,
            "attempt": checkpoint.attempt,
            "iteration": checkpoint.iteration,
        }),
        Event::Warning(warning) => json!({"event": "warning", "message": warning.message}),
        Event::Updated(now) => {
            json!({"event": "updated", "priority": now.priority, "max_parallel": now.max_parallel})
        }
        Event::KeepAlive(_) => return,
    };
    let mut value = value;
    value["seq"] = seq.into();
    output::line(value);
}
