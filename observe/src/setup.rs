//! The log of a process.

use std::io::{self, IsTerminal as _, Write};
use std::str::FromStr;

use tracing_subscriber::filter::EnvFilter;
use tracing_subscriber::fmt;
use tracing_subscriber::fmt::format::JsonFields;
use tracing_subscriber::layer::{Layer as _, SubscriberExt as _};
use tracing_subscriber::registry::Registry;
use tracing_subscriber::util::SubscriberInitExt as _;

use crate::capture::{AttemptLines, Capture};
use crate::format::{FlatJson, text_fields};
use crate::scrub;

/// Format of log lines on stderr.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LogFormat {
    /// Text.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

impl FromStr for LogFormat {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "text" => Ok(Self::Text),
            "json" => Ok(Self::Json),
            _ => Err("use text or json".to_owned()),
        }
    }
}

/// Log settings of a process.
#[derive(Clone, Debug)]
pub struct Logging {
    /// Format of lines.
    pub format: LogFormat,
    /// Filter for stderr if neither FATHOM_LOG nor RUST_LOG is set.
    pub default_filter: String,
    /// Whether to capture lines of attempts for job logs: in coordinators and workers.
    pub captures: bool,
    /// Name of the process in traces if OTEL_SERVICE_NAME is not set.
    pub service: &'static str,
}

/// Hold it until the process ends: it sends the last spans when dropped.
#[must_use = "unsent spans are lost without it"]
pub struct Guard {
    #[cfg(feature = "otel")]
    _traces: Option<crate::otel::Exporter>,
}

/// Writes lines without apparent secrets. Each line arrives in one piece.
struct Scrubbed<W>(W);

impl<W: Write> Write for Scrubbed<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.write_all(scrub(&String::from_utf8_lossy(bytes)).as_bytes())?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

/// Sets up the log. Call it once in a process, before any thread starts.
pub fn init(logging: &Logging) -> Guard {
    let filter = EnvFilter::try_from_env("FATHOM_LOG")
        .or_else(|_| EnvFilter::try_from_default_env())
        .unwrap_or_else(|_| EnvFilter::new(&logging.default_filter));
    let lines = fmt::layer().with_writer(|| Scrubbed(std::io::stderr()));
    let lines = match logging.format {
        LogFormat::Text => lines.with_ansi(std::io::stderr().is_terminal()).fmt_fields(text_fields()).boxed(),
        LogFormat::Json => {
            lines.with_ansi(false).fmt_fields(JsonFields::new()).event_format(FlatJson).boxed()
        }
    };
    let captured = logging.captures.then(|| Capture.with_filter(AttemptLines));
    let subscriber = Registry::default().with(lines.with_filter(filter)).with(captured);
    #[cfg(feature = "otel")]
    {
        let (layer, exporter) = crate::otel::start(logging.service).unzip();
        subscriber.with(layer).init();
        Guard { _traces: exporter }
    }
    #[cfg(not(feature = "otel"))]
    {
        subscriber.init();
        Guard {}
    }
}
