//! Progress on stderr: bars with rate and time left on a terminal, plain lines elsewhere.

use std::io::IsTerminal as _;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use fathom_observe::shown;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::output;

/// Seconds between plain lines, to keep the log of a long run short.
const PLAIN_EVERY: Duration = Duration::from_secs(10);

/// One quantity that grows to its end.
pub struct Progress {
    what: String,
    total: u64,
    unit: Unit,
    bar: Option<ProgressBar>,
    plain: Mutex<Plain>,
}

struct Plain {
    begin: Instant,
    /// The count when this process started; earlier progress says nothing about the rate.
    first: Option<u64>,
    last_line: Option<Instant>,
    done: u64,
}

/// Unit of the count.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// Items with a plural name: "photographs".
    Count(&'static str),
    /// Bytes.
    Bytes,
    /// Thousandths of a job.
    PerMille,
}

impl Progress {
    /// `what` is the label: "uploading".
    pub fn new(what: impl Into<String>, total: u64, unit: Unit) -> Self {
        let what = shown(&what.into()).into_owned();
        let bar = std::io::stderr().is_terminal().then(|| {
            let bar = ProgressBar::with_draw_target(Some(total), ProgressDrawTarget::stderr_with_hz(5));
            let counts = match unit {
                Unit::Count(name) => format!("{{pos}}/{{len}} {name}, {{per_sec}}"),
                Unit::Bytes => "{bytes}/{total_bytes}, {bytes_per_sec}".to_owned(),
                Unit::PerMille => "{percent} %".to_owned(),
            };
            let template = format!("{{prefix}} {{wide_bar}} {counts}, {{eta}} left {{msg}}");
            // The template above is a constant of this file; if it is invalid, the plain bar is used.
            let style =
                ProgressStyle::with_template(&template).unwrap_or_else(|_| ProgressStyle::default_bar());
            bar.with_style(style).with_prefix(what.clone())
        });
        let plain = Plain { begin: Instant::now(), first: None, last_line: None, done: 0 };
        Self { what, total, unit, bar, plain: Mutex::new(plain) }
    }

    /// Sets the progress; `detail` is shown at the end of the bar or line.
    pub fn set(&self, done: u64, detail: &str) {
        let detail = &*shown(detail);
        if let Some(bar) = &self.bar {
            bar.set_position(done);
            bar.set_message(detail.to_owned());
            return;
        }
        let Ok(mut plain) = self.plain.lock() else { return };
        let first = *plain.first.get_or_insert(done);
        // Threads may report out of order.
        plain.done = plain.done.max(done);
        let due = plain.last_line.is_none_or(|last| last.elapsed() >= PLAIN_EVERY);
        if due || (plain.done >= self.total && plain.last_line.is_some()) {
            plain.last_line = Some(Instant::now());
            eprintln!("{}", self.plain_line(&plain, first, detail));
        }
    }

    /// A line above the bar, or a plain one.
    pub fn note(&self, text: &str) {
        let text = shown(text);
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{text}")),
            None => eprintln!("{text}"),
        }
    }

    /// Removes the bar.
    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }

    fn plain_line(&self, plain: &Plain, first: u64, detail: &str) -> String {
        let (done, seconds) = (plain.done, plain.begin.elapsed().as_secs_f64());
        let rate = (done - first.min(done)) as f64 / seconds.max(1e-3);
        let counts = match self.unit {
            Unit::Count(name) => format!("{done}/{} {name}", self.total),
            Unit::Bytes => format!("{}/{}", output::bytes(done), output::bytes(self.total)),
            Unit::PerMille => format!("{} %", done / 10),
        };
        let pace = match self.unit {
            _ if rate <= 0.0 || seconds < 1.0 => String::new(),
            Unit::Count(_) => format!(", {rate:.1}/s"),
            Unit::Bytes => format!(", {}/s", output::bytes(rate as u64)),
            Unit::PerMille => String::new(),
        };
        let left = if rate > 0.0 && seconds >= 1.0 && done < self.total {
            format!(", {} left", output::duration((self.total - done) as f64 / rate))
        } else {
            String::new()
        };
        let detail = if detail.is_empty() { String::new() } else { format!(" ({detail})") };
        format!("{}: {counts}{pace}{left}{detail}", self.what)
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.finish();
    }
}
