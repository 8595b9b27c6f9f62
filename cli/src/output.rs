//! Results on stdout: JSON with `--json`, otherwise lines for people.

use std::io::Write as _;
use std::path::Path;

use serde::Serialize;

use crate::error::{CliError, Result};

/// Prints a line of the result. A closed pipe (`fathom ls | head`) ends the output without an error.
pub fn line(text: impl std::fmt::Display) {
    let _ = writeln!(std::io::stdout(), "{text}");
}

/// Prints `value` as JSON.
pub fn json(value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value)
        .map_err(|error| CliError::Message(format!("the result cannot be written as JSON: {error}")))?;
    line(text);
    Ok(())
}

/// Reads a JSON file.
pub fn read_json(path: &Path) -> Result<serde_json::Value> {
    let bytes = std::fs::read(path).map_err(CliError::io("read", path))?;
    serde_json::from_slice(&bytes)
        .map_err(|error| CliError::Message(format!("{} is not JSON: {error}", path.display())))
}

/// "1.5 MB", decimal as storage is sold.
pub fn bytes(count: u64) -> String {
    let units = ["B", "kB", "MB", "GB", "TB"];
    let (mut value, mut unit) = (count as f64, 0);
    while value >= 1000.0 && unit + 1 < units.len() {
        value /= 1000.0;
        unit += 1;
    }
    if unit == 0 { format!("{count} B") } else { format!("{value:.1} {}", units[unit]) }
}

/// "1 h 02 min", "3 min 20 s", "12 s".
pub fn duration(seconds: f64) -> String {
    let seconds = seconds.max(0.0).round() as u64;
    match (seconds / 3600, seconds / 60 % 60, seconds % 60) {
        (0, 0, s) => format!("{s} s"),
        (0, m, s) => format!("{m} min {s:02} s"),
        (h, m, _) => format!("{h} h {m:02} min"),
    }
}
