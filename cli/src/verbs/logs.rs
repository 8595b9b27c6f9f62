//! `fathom logs`: the log lines of a job's tasks.
//!
//! Lines are numbered, so a lost connection or a restarted coordinator loses none.

use std::io::IsTerminal as _;
use std::time::Duration;

use clap::{Args, ValueEnum};
use fathom_coordinator::json;
use fathom_observe::shown;
use fathom_proto::v1::{LogEntry, LogSeverity, StreamLogsRequest};
use prost_types::Timestamp;

use super::ServiceArgs;
use crate::client::passing;
use crate::error::Result;
use crate::output;

/// Number of streams that may break off without a line before giving up.
const TRIES: u32 = 16;
const PAUSE: Duration = Duration::from_secs(1);

/// Arguments of `fathom logs`.
#[derive(Args, Debug)]
pub struct LogsArgs {
    /// Id of the job
    #[arg(value_name = "JOB")]
    job: String,
    /// Only lines of this task, such as partition-0003
    #[arg(long, value_name = "TASK", default_value = "", hide_default_value = true)]
    task: String,
    /// Only lines of this attempt, from 1; 0: all attempts
    #[arg(long, value_name = "N", default_value_t = 0)]
    attempt: u32,
    /// Only lines of at least this level
    #[arg(long, value_enum, default_value_t = Level::Info)]
    level: Level,
    /// Only lines after this number (shown by --json)
    #[arg(long, value_name = "NUMBER", default_value_t = 0)]
    after: u64,
    /// Keep printing new lines until the job ends
    #[arg(long, short)]
    follow: bool,
    /// Print JSON lines
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    service: ServiceArgs,
}

/// Level of a log line.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Level {
    Trace,
    Debug,
    Info,
    Warn,
    Error,
}

pub async fn run(args: LogsArgs) -> Result<()> {
    let client = args.service.client().await?;
    let min_severity = match args.level {
        Level::Trace => LogSeverity::Trace,
        Level::Debug => LogSeverity::Debug,
        Level::Info => LogSeverity::Info,
        Level::Warn => LogSeverity::Warn,
        Level::Error => LogSeverity::Error,
    };
    let mut request = StreamLogsRequest {
        job_id: args.job,
        task_id: args.task,
        attempt: args.attempt,
        min_severity: min_severity.into(),
        after_number: args.after,
        follow: args.follow,
    };
    let coloured = std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none();
    let mut failures = 0;
    loop {
        let mut stream = client.logs(request.clone()).await?;
        let end = loop {
            match stream.message().await {
                Ok(Some(entry)) => {
                    (request.after_number, failures) = (entry.number, 0);
                    if args.json {
                        output::json_line(&json::log_line(&entry));
                    } else {
                        output::coloured(as_text(&entry, coloured));
                    }
                }
                Ok(None) => break None,
                Err(status) => break Some(status),
            }
        };
        // A stopping coordinator ends the stream just as the end of the job does.
        let goes_on = match &end {
            None if args.follow => client.job(&request.job_id).await?.end_time.is_none(),
            None => false,
            Some(_) => true,
        };
        match end {
            _ if !goes_on => return Ok(()),
            Some(status) if !passing(&status) || failures == TRIES => {
                return Err(client.fault("send the log of the job", &status));
            }
            _ => {
                failures += 1;
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
}

fn as_text(entry: &LogEntry, coloured: bool) -> String {
    let time = entry.time.as_ref().map(Timestamp::to_string).unwrap_or_default();
    let severity = entry.severity();
    let (begin, end) = match severity {
        LogSeverity::Error if coloured => ("\x1b[31m", "\x1b[0m"),
        LogSeverity::Warn if coloured => ("\x1b[33m", "\x1b[0m"),
        _ => ("", ""),
    };
    let level = json::severity(severity);
    let (task_id, attempt, worker) = (shown(&entry.task_id), entry.attempt, shown(&entry.worker));
    // Later lines of a message are indented, so they do not look like log lines of their own.
    let message = entry.message.split('\n').map(shown).collect::<Vec<_>>().join("\n    ");
    format!("{time} {begin}{level:5}{end} {task_id} #{attempt} {worker}: {message}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_line_has_time_level_task_attempt_and_worker() {
        let entry = LogEntry {
            time: Some(Timestamp { seconds: 1_700_000_000, nanos: 250_000_000 }),
            severity: LogSeverity::Warn.into(),
            task_id: "partition-0003".into(),
            attempt: 2,
            worker: "reef-1".into(),
            message: "first\nsecond\u{1b}[2J".into(),
            number: 9,
        };
        let line = "2023-11-14T22:13:20.250Z warn  partition-0003 #2 reef-1: first\n    second\\u{1b}[2J";
        assert_eq!(as_text(&entry, false), line);
        assert!(as_text(&entry, true).contains("\x1b[33mwarn "));
        let json = json::log_line(&entry);
        assert_eq!((json["number"].as_u64(), json["level"].as_str()), (Some(9), Some("warn")));
    }
}
