//! Captures the log lines of an attempt from all log lines of a process.
//!
//! The code that begins an attempt attaches a [`Sink`] to its span. Every event inside that span, on any
//! thread that has entered it, goes to the sink, and to stderr like every other line.

use std::fmt::{self, Write as _};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::subscriber::Interest;
use tracing::{Event, Level, Metadata, Span, Subscriber};
use tracing_subscriber::layer::{Context, Filter, Layer};
use tracing_subscriber::registry::{LookupSpan, Registry};

use crate::scrub;

/// Longest message of a line, bytes; longer ones are truncated.
pub const MAX_MESSAGE_BYTES: usize = 4096;

/// One log line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoggedLine {
    /// When, Unix milliseconds.
    pub time_ms: u64,
    /// Severity.
    pub level: Level,
    /// The message, with its fields as `name=value`; without secrets, at most [`MAX_MESSAGE_BYTES`].
    pub message: String,
}

impl LoggedLine {
    /// A line with the current time.
    pub fn now(level: Level, message: &str) -> Self {
        // A clock before 1970 counts as 1970: times are for display only.
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self { time_ms: since_epoch.as_millis() as u64, level, message: tidy(message) }
    }
}

/// Receives the lines of an attempt. Called on the thread that logs, so it must neither wait nor log.
pub trait Sink: Send + Sync {
    /// Takes a line, or drops it.
    fn line(&self, line: LoggedLine);
}

struct Attached(Arc<dyn Sink>);

/// Sends lines logged inside `span` to `sink` from now on. Nothing happens where the process has no
/// [`Capture`].
pub fn attach(span: &Span, sink: Arc<dyn Sink>) {
    span.with_subscriber(|(id, dispatch)| {
        if let Some(span) = dispatch.downcast_ref::<Registry>().and_then(|registry| registry.span(id)) {
            span.extensions_mut().replace(Attached(sink));
        }
    });
}

/// The layer that captures lines; filter it by [`AttemptLines`].
pub struct Capture;

impl<S: Subscriber + for<'a> LookupSpan<'a>> Layer<S> for Capture {
    fn on_event(&self, event: &Event<'_>, context: Context<'_, S>) {
        let sink = context.event_scope(event).into_iter().flatten().find_map(|span| {
            // Cloned, so that no lock is held while the sink is called.
            span.extensions().get::<Attached>().map(|attached| Arc::clone(&attached.0))
        });
        let Some(sink) = sink else { return };
        let mut text = Text::default();
        event.record(&mut text);
        let Text { message, fields } = text;
        sink.line(LoggedLine::now(*event.metadata().level(), &format!("{message}{fields}")));
    }
}

/// The lowest level captured: [`LevelFilter`] as a number, 0 captures none.
static LEVEL: AtomicU8 = AtomicU8::new(number_of(LevelFilter::INFO));

/// Captures lines of at least `level` from now on, in the whole process.
pub fn set_level(level: LevelFilter) {
    if LEVEL.swap(number_of(level), Ordering::Relaxed) != number_of(level) {
        // Call sites cache whether a layer wants them.
        tracing::callsite::rebuild_interest_cache();
    }
}

fn level() -> LevelFilter {
    let all =
        [LevelFilter::OFF, LevelFilter::ERROR, LevelFilter::WARN, LevelFilter::INFO, LevelFilter::DEBUG];
    all.get(usize::from(LEVEL.load(Ordering::Relaxed))).copied().unwrap_or(LevelFilter::TRACE)
}

const fn number_of(level: LevelFilter) -> u8 {
    match level.into_level() {
        None => 0,
        Some(Level::ERROR) => 1,
        Some(Level::WARN) => 2,
        Some(Level::INFO) => 3,
        Some(Level::DEBUG) => 4,
        Some(Level::TRACE) => 5,
    }
}

/// Lines for a job's user: of our own crates by [`set_level`], of other crates only warnings and errors.
pub struct AttemptLines;

impl AttemptLines {
    fn admits(metadata: &Metadata<'_>) -> bool {
        if metadata.is_span() {
            // Spans of attempts, at every level.
            return *metadata.level() <= Level::INFO;
        }
        let most = match metadata.target() {
            target if target.starts_with("fathom") => LevelFilter::TRACE,
            target if target.starts_with("wgpu_hal") => LevelFilter::ERROR,
            // Slow statements are the operator's matter.
            target if target.starts_with("sqlx") => LevelFilter::ERROR,
            _ => LevelFilter::WARN,
        };
        *metadata.level() <= level().min(most)
    }
}

impl<S> Filter<S> for AttemptLines {
    fn enabled(&self, metadata: &Metadata<'_>, _context: &Context<'_, S>) -> bool {
        Self::admits(metadata)
    }

    fn callsite_enabled(&self, metadata: &'static Metadata<'static>) -> Interest {
        if Self::admits(metadata) { Interest::always() } else { Interest::never() }
    }

    fn max_level_hint(&self) -> Option<LevelFilter> {
        Some(level().max(LevelFilter::INFO))
    }
}

/// The fields of an event as text.
#[derive(Default)]
struct Text {
    message: String,
    fields: String,
}

impl Visit for Text {
    fn record_str(&mut self, field: &Field, value: &str) {
        if field.name() == "message" {
            self.message.push_str(value);
        } else {
            self.record_debug(field, &value);
        }
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        // Writing to a string does not fail.
        let _ = match field.name() {
            "message" => write!(self.message, "{value:?}"),
            name => write!(self.fields, " {name}={value:?}"),
        };
    }
}

/// At most [`MAX_MESSAGE_BYTES`] of a message, without secrets, and without control characters, which could
/// overwrite text on a reader's terminal.
pub fn tidy(message: &str) -> String {
    let mut message = scrub(&message[..message.floor_char_boundary(MAX_MESSAGE_BYTES)]);
    message.truncate(message.floor_char_boundary(MAX_MESSAGE_BYTES));
    message.replace(|c: char| c.is_control() && c != '\n', " ")
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use tracing_subscriber::layer::SubscriberExt as _;

    use super::*;
    use crate::attempt_span;

    #[derive(Default)]
    struct Kept(Mutex<Vec<String>>);

    impl Sink for Kept {
        fn line(&self, LoggedLine { level, message, .. }: LoggedLine) {
            self.0.lock().unwrap().push(format!("{level} {message}"));
        }
    }

    #[test]
    fn only_lines_of_an_attempt_reach_its_sink_from_any_thread() {
        let subscriber = Registry::default().with(Capture.with_filter(AttemptLines));
        let (first, second) = (Arc::new(Kept::default()), Arc::new(Kept::default()));
        tracing::subscriber::with_default(subscriber, || {
            let spans = [attempt_span("job", "partition-0003", 1, "w"), attempt_span("job", "merge", 2, "w")];
            attach(&spans[0], first.clone());
            attach(&spans[1], second.clone());
            tracing::info!("outside of attempts");
            spans[0].in_scope(|| {
                tracing::info!(iteration = 7, path = "a b", "at a checkpoint");
                tracing::debug!("too fine");
                tracing::info!(target: "hyper", "of a library");
                tracing::info_span!("inner")
                    .in_scope(|| tracing::warn!(token = "t0p", "a\u{1b}[2Jnested\nline"));
            });
            let dispatch = tracing::dispatcher::get_default(Clone::clone);
            let span = spans[1].clone();
            let thread = std::thread::spawn(move || {
                tracing::dispatcher::with_default(&dispatch, || {
                    span.in_scope(|| tracing::error!("{}", "x".repeat(5000)))
                });
            });
            thread.join().unwrap();
        });
        assert_eq!(
            *first.0.lock().unwrap(),
            ["INFO at a checkpoint iteration=7 path=\"a b\"", "WARN a [2Jnested\nline token=\"[hidden]\""]
        );
        let second = second.0.lock().unwrap();
        assert_eq!(second.len(), 1);
        assert_eq!(second[0].len(), "ERROR ".len() + MAX_MESSAGE_BYTES);
    }
}
