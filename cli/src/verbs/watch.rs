//! `fathom watch`: follows a job to its end.
//!
//! Events are numbered, so a lost connection or a restarted coordinator loses none.

use std::collections::BTreeMap;
use std::time::{Duration, Instant, SystemTime};

use clap::Args;
use fathom_coordinator::json;
use fathom_proto::v1::job_event::Event;
use fathom_proto::v1::{HeldOutMetrics, Job, JobEvent, JobState, TaskState};
use prost_types::Timestamp;
use serde_json::json;

use super::ServiceArgs;
use crate::client::Client;
use crate::error::{CliError, Result};
use crate::output;
use crate::progress::{Progress, Unit};

/// Arguments of `fathom watch`.
#[derive(Args, Debug)]
pub struct WatchArgs {
    /// Id of the job
    #[arg(value_name = "JOB")]
    job: String,
    #[command(flatten)]
    service: ServiceArgs,
    /// Print one JSON object per line for every event, then the job itself; nothing on stderr
    #[arg(long)]
    json: bool,
}

pub async fn run(args: WatchArgs) -> Result<()> {
    let client = args.service.client().await?;
    let job = follow(&client, &args.job, args.json).await?;
    if args.json {
        output::json_line(&json::job(&job));
    } else {
        output::line(format!("job {} has succeeded", job.job_id));
    }
    Ok(())
}

/// Time without an answer before a watcher gives up: enough for a restart and a repair of the store.
const PATIENCE: Duration = Duration::from_secs(180);
/// Pause between two attempts to reach the coordinator.
const TRY_EVERY: Duration = Duration::from_millis(500);
/// After this long without an event, a watcher asks why the job waits. Longer than workers take to start.
const ASK_AFTER: Duration = Duration::from_secs(5);
/// Time limit of that question, so that it does not delay events for long.
const ANSWERED_WITHIN: Duration = Duration::from_secs(2);

/// Follows a job until it succeeds; every other end is an error. Prints progress on stderr, or JSON lines on
/// stdout.
pub async fn follow(client: &Client, id: &str, as_json: bool) -> Result<Job> {
    // Waits for a coordinator to start; fails at once if the server is no coordinator.
    client.job(id).await?;
    let mut watch = Watch {
        client,
        id,
        seq: 0,
        waits_for: String::new(),
        away_since: None,
        printer: if as_json { Printer::Json } else { Printer::Text(Box::new(View::new(id))) },
    };
    loop {
        let job = match watch.once().await {
            Ok(job) => job,
            Err(error @ (CliError::Unreachable { .. } | CliError::TooOften { .. })) => {
                watch.is_away(error)?;
                tokio::time::sleep(TRY_EVERY).await;
                continue;
            }
            Err(error) => return Err(error),
        };
        let end = |outcome| {
            let message = fathom_observe::shown(&job.error).into_owned();
            CliError::Job { job: id.to_owned(), outcome, message }
        };
        match job.state() {
            JobState::Succeeded => return Ok(job),
            JobState::Failed => return Err(end("failed")),
            JobState::Cancelled => return Err(end("was cancelled")),
            // The stream ended before the job: reopen it, but not too often.
            JobState::Running | JobState::Paused | JobState::Unspecified => {
                tokio::time::sleep(Duration::from_millis(200)).await
            }
        }
    }
}

/// Output of a watcher.
enum Printer {
    /// Lines and a progress bar on stderr.
    Text(Box<View>),
    /// One JSON object per line on stdout, and nothing else.
    Json,
}

/// A job being watched.
struct Watch<'a> {
    client: &'a Client,
    id: &'a str,
    /// Number of the last durable event.
    seq: u64,
    /// The reported reason why it waits; empty while it makes progress.
    waits_for: String,
    /// Time since which the coordinator does not answer.
    away_since: Option<Instant>,
    printer: Printer,
}

impl Watch<'_> {
    /// Follows one stream to its end, and returns the job's state then.
    async fn once(&mut self) -> Result<Job> {
        let mut events = self.client.watch(self.id, self.seq).await?;
        let mut silent_since = Instant::now();
        loop {
            let quiet = tokio::time::sleep_until((silent_since + ASK_AFTER).into());
            let event = tokio::select! {
                event = events.message() => event,
                () = quiet => {
                    self.ask_why_it_waits().await;
                    silent_since = Instant::now();
                    continue;
                }
            };
            match event {
                Ok(Some(event)) => {
                    self.away_since = None;
                    if !matches!(event.event, None | Some(Event::KeepAlive(_))) {
                        silent_since = Instant::now();
                    }
                    self.seq = self.seq.max(event.seq);
                    self.print(&event);
                }
                Ok(None) => break,
                Err(status) => return Err(self.client.fault("watch the job", &status)),
            }
        }
        let job = self.client.job_now(self.id).await?;
        self.away_since = None;
        Ok(job)
    }

    fn print(&mut self, event: &JobEvent) {
        match (&mut self.printer, &event.event) {
            (_, None) => {}
            (Printer::Text(view), Some(event)) => view.show(event),
            (Printer::Json, Some(_)) => {
                if let Some(value) = json::event(event) {
                    output::json_line(&value);
                }
            }
        }
    }

    /// Reports why a silent job waits, once per reason.
    async fn ask_why_it_waits(&mut self) {
        let asked = tokio::time::timeout(ANSWERED_WITHIN, self.client.job_now(self.id)).await;
        // If the coordinator does not answer, the stream ends too, which is reported.
        let Ok(Ok(job)) = asked else { return };
        if job.waiting_reason != self.waits_for {
            self.waits_for = job.waiting_reason;
            if !self.waits_for.is_empty() {
                self.remark("waiting", &format!("waiting: {}", self.waits_for), &self.waits_for);
            }
        }
    }

    /// Reports once that the coordinator does not answer or accepts no calls; returns the error when this
    /// lasts too long.
    fn is_away(&mut self, error: CliError) -> Result<()> {
        match self.away_since {
            Some(since) if since.elapsed() > PATIENCE => return Err(error),
            Some(_) => {}
            None => {
                self.away_since = Some(Instant::now());
                let (event, what, message) = match &error {
                    CliError::Unreachable { message, .. } => ("connection_lost", "connection lost", message),
                    CliError::TooOften { message, .. } => ("too_many_calls", "too many calls", message),
                    _ => return Ok(()),
                };
                self.remark(event, &format!("{what}, trying again ({message})"), message);
            }
        }
        Ok(())
    }

    /// Prints a remark that is no event of the job and has no number.
    fn remark(&self, event: &str, text: &str, message: &str) {
        match &self.printer {
            Printer::Text(view) => view.progress.note(text),
            Printer::Json => {
                let now = Timestamp::from(SystemTime::now()).to_string();
                output::json_line(&json!({"event": event, "time": now, "job": self.id, "message": message}));
            }
        }
    }
}

/// Text output of a job: one progress bar, and a line for each important event.
struct View {
    progress: Progress,
    tasks: BTreeMap<String, String>,
    /// The latest measurement of each task, which every progress report repeats.
    measured: BTreeMap<String, HeldOutMetrics>,
    share: f64,
}

impl View {
    fn new(id: &str) -> Self {
        let progress = Progress::new(format!("job {id}"), 1000, Unit::PerMille);
        Self { progress, tasks: BTreeMap::new(), measured: BTreeMap::new(), share: 0.0 }
    }

    /// A line for a new measurement.
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
            Event::JobStage(stage) => self.progress.note(&json::stage(stage.stage())),
            Event::TaskChanged(task) => {
                if task.state() != TaskState::Leased {
                    self.tasks.remove(&task.task_id);
                }
                let mut line = format!("  {}: {}", task.task_id, json::task_state(task.state()));
                if task.attempt > 1 {
                    line += &format!(", attempt {}", task.attempt);
                }
                if task.resumed_from_iteration > 0 {
                    line += &format!(", resumes at iteration {}", task.resumed_from_iteration);
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
                    let why = if change.message.is_empty() {
                        String::new()
                    } else {
                        format!(" ({})", change.message)
                    };
                    self.progress.note(&format!("paused{why}; `fathom resume` continues"));
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
