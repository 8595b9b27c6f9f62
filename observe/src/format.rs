//! A log line as one flat JSON object, and the fields of a text line.

use std::fmt;

use serde_json::{Map, Value};
use tracing::field::{Field, Visit};
use tracing::{Event, Subscriber};
use tracing_subscriber::field::MakeExt as _;
use tracing_subscriber::fmt::format::{Writer, debug_fn};
use tracing_subscriber::fmt::time::{FormatTime, SystemTime};
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields, FormattedFields};
use tracing_subscriber::registry::LookupSpan;

use crate::shown;

/// `{"time":…,"level":…,"target":…,"job":…,"task":…,"attempt":…,"worker":…,"message":…}`: fields of the spans
/// from the outermost to the innermost, then those of the event. If a name repeats, the innermost value
/// counts. Use it with `JsonFields`.
pub struct FlatJson;

impl<S, N> FormatEvent<S, N> for FlatJson
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let mut time = String::new();
        SystemTime.format_time(&mut Writer::new(&mut time))?;
        let metadata = event.metadata();
        let mut line = Map::new();
        line.insert("time".into(), time.into());
        line.insert("level".into(), metadata.level().as_str().into());
        line.insert("target".into(), metadata.target().into());
        for span in context.event_scope().into_iter().flat_map(|scope| scope.from_root()) {
            let extensions = span.extensions();
            let fields = extensions.get::<FormattedFields<N>>().map(|fields| fields.fields.as_str());
            if let Some(Ok(Value::Object(fields))) = fields.map(serde_json::from_str) {
                line.extend(fields);
            }
        }
        event.record(&mut Fields(&mut line));
        writeln!(writer, "{}", Value::Object(line))
    }
}

/// Fields as `name=value` after the message, like the default text format. Each value stays on one line and
/// moves no cursor, because names, reasons and errors come from other users.
pub fn text_fields() -> impl for<'a> FormatFields<'a> + 'static {
    debug_fn(|writer: &mut Writer<'_>, field: &Field, value: &dyn fmt::Debug| {
        let text = format!("{value:?}");
        let text = shown(&text);
        match field.name() {
            "message" => writer.write_str(&text),
            name if writer.has_ansi_escapes() => {
                write!(writer, "\u{1b}[3m{name}\u{1b}[0m\u{1b}[2m=\u{1b}[0m{text}")
            }
            name => write!(writer, "{name}={text}"),
        }
    })
    .delimited(" ")
}

struct Fields<'a>(&'a mut Map<String, Value>);

impl Visit for Fields<'_> {
    fn record_f64(&mut self, field: &Field, value: f64) {
        self.0.insert(field.name().into(), value.into());
    }

    fn record_i64(&mut self, field: &Field, value: i64) {
        self.0.insert(field.name().into(), value.into());
    }

    fn record_u64(&mut self, field: &Field, value: u64) {
        self.0.insert(field.name().into(), value.into());
    }

    fn record_bool(&mut self, field: &Field, value: bool) {
        self.0.insert(field.name().into(), value.into());
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.0.insert(field.name().into(), value.into());
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.0.insert(field.name().into(), format!("{value:?}").into());
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::{Arc, Mutex};

    use tracing_subscriber::fmt;
    use tracing_subscriber::fmt::format::JsonFields;
    use tracing_subscriber::layer::SubscriberExt as _;
    use tracing_subscriber::registry::Registry;

    use super::*;
    use crate::attempt_span;

    #[derive(Clone, Default)]
    struct Written(Arc<Mutex<Vec<u8>>>);

    impl Write for Written {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().extend_from_slice(bytes);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn foreign_text_begins_no_line_and_moves_no_cursor() {
        let written = Written::default();
        let writer = written.clone();
        let lines = fmt::layer().with_writer(move || writer.clone()).with_ansi(false);
        let lines = lines.without_time().fmt_fields(text_fields());
        tracing::subscriber::with_default(Registry::default().with(lines), || {
            let name = "a\nINFO forged\u{1b}[2J\u{9b}1m";
            attempt_span("job", "partition-0003", 2, name).in_scope(|| {
                tracing::warn!(%name, quoted = name, count = 7, "shown: {name}");
            });
        });
        let text = String::from_utf8(written.0.lock().unwrap().clone()).unwrap();
        assert!(!text.trim_end().contains(|c: char| c.is_control()), "{text:?}");
        let escaped = r"a\nINFO forged\u{1b}[2J\u{9b}1m";
        assert!(text.contains(&format!("shown: {escaped} name={escaped} quoted=")), "{text}");
        assert!(text.contains(&format!("worker=\"{escaped}\"")) && text.ends_with(" count=7\n"), "{text}");
    }

    #[test]
    fn a_line_names_its_attempt_and_values_keep_their_types() {
        let written = Written::default();
        let writer = written.clone();
        let lines = fmt::layer().with_writer(move || writer.clone()).with_ansi(false);
        let lines = lines.fmt_fields(JsonFields::new()).event_format(FlatJson);
        tracing::subscriber::with_default(Registry::default().with(lines), || {
            attempt_span("job", "partition-0003", 2, "reef \"1\"").in_scope(|| {
                tracing::info_span!("inner", step = 4, worker = "inner").in_scope(|| {
                    tracing::warn!(iteration = 7, psnr = 27.5, ok = true, "two\nlines");
                });
            });
            tracing::info!("outside of attempts");
        });
        let text = String::from_utf8(written.0.lock().unwrap().clone()).unwrap();
        let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(lines.len(), 2, "{text}");
        let first = &lines[0];
        assert_eq!((&first["job"], &first["task"]), (&"job".into(), &"partition-0003".into()));
        assert_eq!((&first["partition"], &first["attempt"]), (&3.into(), &2.into()));
        assert_eq!((&first["worker"], &first["step"]), (&"inner".into(), &4.into()));
        assert_eq!(
            (&first["iteration"], &first["psnr"], &first["ok"]),
            (&7.into(), &27.5.into(), &true.into())
        );
        assert_eq!((&first["message"], &first["level"]), (&"two\nlines".into(), &"WARN".into()));
        assert!(lines[1].get("job").is_none() && lines[1]["message"] == "outside of attempts");
    }
}
