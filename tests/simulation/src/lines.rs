//! Reads the programs' logs: workers log acknowledgements, coordinators log removals, and no program may log
//! a token.

use std::fmt;
use std::sync::Arc;

use fathom_invariants::Fact;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id};
use tracing::{Event, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

use crate::world::World;

/// Receives every log line of the simulating thread.
pub struct Lines(pub Arc<World>);

/// Fields as text.
#[derive(Default)]
struct Fields(Vec<(&'static str, String)>);

impl Fields {
    fn get(&self, name: &str) -> Option<&str> {
        self.0.iter().find(|(known, _)| *known == name).map(|(_, value)| value.as_str())
    }

    fn number(&self, name: &str) -> Option<u64> {
        self.get(name)?.parse().ok()
    }
}

impl Visit for Fields {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.0.push((field.name(), format!("{value:?}")));
    }

    fn record_str(&mut self, field: &Field, value: &str) {
        self.0.push((field.name(), value.to_owned()));
    }
}

impl<S: Subscriber + for<'a> LookupSpan<'a>> Layer<S> for Lines {
    fn on_new_span(&self, attributes: &Attributes<'_>, id: &Id, context: Context<'_, S>) {
        let mut fields = Fields::default();
        attributes.record(&mut fields);
        if let Some(span) = context.span(id) {
            span.extensions_mut().insert(fields);
        }
    }

    fn on_event(&self, event: &Event<'_>, context: Context<'_, S>) {
        let mut fields = Fields::default();
        event.record(&mut fields);
        let mut text = format!("{} {}:", event.metadata().level(), event.metadata().target());
        for (name, value) in &fields.0 {
            text += &if *name == "message" { format!(" {value}") } else { format!(" {name}={value}") };
        }
        let mut safe = None;
        for span in context.event_scope(event).into_iter().flatten() {
            let extensions = span.extensions();
            let Some(of) = extensions.get::<Fields>() else { continue };
            for (name, value) in &of.0 {
                text += &format!(" [{name}={value}]");
            }
            safe = safe.or_else(|| acknowledgement(event.metadata().target(), &fields, of));
        }
        self.0.look_for_tokens(&text);
        if event.metadata().target() == "fathom_coordinator::retention" {
            let removed = fields.number("blobs").unwrap_or(0) + fields.number("uploads").unwrap_or(0);
            self.0.counts(|counts| counts.removed += removed);
        }
        if let Some(fact) = safe {
            self.0.history.note(fact);
        }
        self.0.history.line(text);
    }
}

/// An acknowledgement in a worker's log.
fn acknowledgement(target: &str, line: &Fields, attempt: &Fields) -> Option<Fact> {
    if target != "fathom_worker::session" {
        return None;
    }
    let (job, task) = (attempt.get("job")?.to_owned(), attempt.get("task")?.to_owned());
    let number = attempt.number("attempt")?;
    match line.get("message")? {
        "checkpoint stored" => {
            Some(Fact::CheckpointSafe { job, task, attempt: number, iteration: line.number("iteration")? })
        }
        "task done" => Some(Fact::ResultTaken { job, task, attempt: number }),
        _ => None,
    }
}
