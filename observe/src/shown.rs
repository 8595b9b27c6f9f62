//! Makes foreign text safe for a terminal or a log.

use std::borrow::Cow;

/// Whether a character is invisible but changes how others are displayed: control characters (C0, DEL, C1),
/// Unicode line and paragraph separators, and bidirectional controls.
pub fn is_unseen(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// `text` with such characters escaped: `\n`, `\u{1b}`.
pub fn shown(text: &str) -> Cow<'_, str> {
    if !text.contains(is_unseen) {
        return Cow::Borrowed(text);
    }
    let mut seen = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        match c {
            '\n' => seen.push_str("\\n"),
            '\r' => seen.push_str("\\r"),
            '\t' => seen.push_str("\\t"),
            c if is_unseen(c) => seen.extend(c.escape_unicode()),
            c => seen.push(c),
        }
    }
    Cow::Owned(seen)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn terminal_controls_are_escaped_and_all_else_is_unchanged() {
        assert_eq!(shown("a\u{1b}[2J\nb\0\r\t"), "a\\u{1b}[2J\\nb\\u{0}\\r\\t");
        assert_eq!(shown("\u{7f}\u{85}\u{9b}1m"), "\\u{7f}\\u{85}\\u{9b}1m");
        assert_eq!(shown("\u{2028}\u{2029}\u{202e}\u{2066}"), "\\u{2028}\\u{2029}\\u{202e}\\u{2066}");
        let plain = "Riff 7 – 礁 🐠 é \\ \"";
        assert!(matches!(shown(plain), Cow::Borrowed(same) if same == plain));
    }
}
