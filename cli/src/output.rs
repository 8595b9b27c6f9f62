//! The program's output: results on stdout, as JSON with `--json`, otherwise as text; remarks on stderr.
//!
//! Names, reasons and messages come from a server, which received them from other users. None of their
//! characters may move the cursor, colour the screen, start a forged line, or reverse the reading order. All
//! output passes through this file, which escapes such characters ([`fathom_observe::shown`]).

use std::fmt::Display;
use std::io::IsTerminal as _;
use std::io::Write as _;
use std::path::Path;

use fathom_observe::{is_unseen, shown};
use serde::Serialize;
use serde_json::Value;

use crate::error::{CliError, Result};

/// Prints a line of the result. A closed pipe (`fathom ls | head`) ends the output without an error.
pub fn line(text: impl Display) {
    let _ = writeln!(std::io::stdout(), "{}", shown(&text.to_string()));
}

/// Prints lines of the result that this program composed; each line passes [`shown`].
pub fn lines(text: impl Display) {
    line_by_line(&text.to_string()).for_each(line);
}

/// Prints text with its own colours; the caller has passed all other parts through [`shown`].
pub fn coloured(text: impl Display) {
    let _ = writeln!(std::io::stdout(), "{text}");
}

/// Prints lines on stderr, for users who watch.
pub fn remark(text: impl Display) {
    line_by_line(&text.to_string()).for_each(|text| eprintln!("{}", shown(text)));
}

/// Prints lines on stderr while a progress bar is there, which is drawn again below them.
pub fn remark_over_bar(text: impl Display) {
    if std::io::stderr().is_terminal() {
        eprint!("\r\x1b[2K");
    }
    remark(text);
}

/// The lines of a text; one empty line if it is empty.
fn line_by_line(text: &str) -> impl Iterator<Item = &str> {
    text.trim_end_matches('\n').split('\n')
}

/// Prints `value` as JSON.
pub fn json(value: &impl Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value)
        .map_err(|error| CliError::Message(format!("the result cannot be written as JSON: {error}")))?;
    coloured(escaped_json(&text));
    Ok(())
}

/// Prints `value` as JSON on one line.
pub fn json_line(value: &Value) {
    coloured(escaped_json(&value.to_string()));
}

/// The same JSON without terminal control characters: JSON leaves characters above U+007E unescaped.
fn escaped_json(json: &str) -> String {
    let mut text = String::with_capacity(json.len());
    for c in json.chars() {
        // JSON already escapes characters below U+0020 in strings; the others are the line ends of the JSON
        // itself.
        if is_unseen(c) && c >= ' ' {
            // All of them have four digits.
            text += &format!("\\u{:04x}", u32::from(c));
        } else {
            text.push(c);
        }
    }
    text
}

/// "1 file", "2 files".
pub fn count(number: impl Into<u64>, of: &str) -> String {
    let number = number.into();
    if number == 1 { format!("1 {of}") } else { format!("{number} {of}s") }
}

/// Reads a JSON file.
pub fn read_json(path: &Path) -> Result<serde_json::Value> {
    let bytes = std::fs::read(path).map_err(CliError::io("read", path))?;
    serde_json::from_slice(&bytes)
        .map_err(|error| CliError::Message(format!("{} is not JSON: {error}", path.display())))
}

/// "1.5 MB": decimal units, as storage is sold.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn json_is_valid_and_free_of_terminal_control_characters() {
        let name = "a\u{1b}[2J\n\u{7f}\u{9b}31m\u{2028}\u{202e}\u{2066}é";
        let value = serde_json::json!({ "name": name });
        let Ok(pretty) = serde_json::to_string_pretty(&value) else { panic!("no JSON") };
        let text = escaped_json(&pretty);
        assert!(!text.chars().any(|c| is_unseen(c) && c != '\n'), "{text:?}");
        assert!(text.contains("\\u009b31m\\u2028\\u202e\\u2066é"), "{text}");
        let back: std::result::Result<Value, _> = serde_json::from_str(&text);
        assert_eq!(back.ok(), Some(value));
    }

    #[test]
    fn counts_have_singular_and_plural() {
        assert_eq!([0_u32, 1, 2].map(|n| count(n, "task")), ["0 tasks", "1 task", "2 tasks"]);
    }
}
