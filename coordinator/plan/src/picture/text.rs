//! Letters for pictures: a stroke font of our own, so that no font file has to be found or carried.
//!
//! A glyph is a path in a small language: `M x y` moves, `L x y` draws a line, `Q x y x y` a quadratic
//! curve. Capitals reach from y = 0 to the baseline at y = 7, small letters from y = 2.4; strokes are
//! round, so that corners and ends look drawn with one pen.

use tiny_skia::{Path, PathBuilder};

/// Height of capitals in glyph units.
const CAPITAL: f32 = 7.0;
/// Space between glyphs in glyph units.
const GAP: f32 = 1.55;

/// Width of `text` whose capitals are `height` pixels high.
pub fn width(text: &str, height: f32) -> f32 {
    let units: f32 = text.chars().map(|c| glyph(c).0 + GAP).sum();
    (units - GAP).max(0.0) * height / CAPITAL
}

/// The strokes of `text`, its first glyph's left end at `x` and its baseline at `y`; draw them with a
/// pen of about a seventh of `height`. `None` when there is nothing to draw.
pub fn strokes(text: &str, x: f32, y: f32, height: f32) -> Option<Path> {
    let scale = height / CAPITAL;
    let mut builder = PathBuilder::new();
    let mut left = x;
    for character in text.chars() {
        let (glyph_width, path) = glyph(character);
        append(&mut builder, path, left, y - height, scale);
        left += (glyph_width + GAP) * scale;
    }
    builder.finish()
}

/// Appends one glyph with its top-left corner at (x, y).
fn append(builder: &mut PathBuilder, path: &str, x: f32, y: f32, scale: f32) {
    let mut numbers: Vec<f32> = Vec::with_capacity(4);
    let mut words = path.split_whitespace().peekable();
    while let Some(command) = words.next() {
        numbers.clear();
        while let Some(number) = words.peek().and_then(|word| word.parse::<f32>().ok()) {
            let origin = if numbers.len().is_multiple_of(2) { x } else { y };
            numbers.push(origin + number * scale);
            words.next();
        }
        match (command, numbers.as_slice()) {
            ("M", &[x, y]) => builder.move_to(x, y),
            ("L", &[x, y]) => builder.line_to(x, y),
            ("Q", &[cx, cy, x, y]) => builder.quad_to(cx, cy, x, y),
            _ => debug_assert!(false, "a glyph has {command} with {} numbers", numbers.len()),
        }
    }
}

/// Width and path of a character; unknown characters are drawn as an empty box.
fn glyph(character: char) -> (f32, &'static str) {
    match character {
        ' ' => (1.6, ""),
        'A' => (4.8, "M 0 7 L 2.4 0 L 4.8 7 M 0.85 4.7 L 3.95 4.7"),
        'B' => (
            4.0,
            "M 0 0 L 0 7 L 2.2 7 Q 4 7 4 5.2 Q 4 3.4 2.2 3.4 L 0 3.4 M 2.2 3.4 Q 3.7 3.3 3.7 1.7 Q 3.7 0 2 0 L 0 0",
        ),
        'C' => (4.6, "M 4.5 1.6 Q 4 0 2.4 0 Q 0 0 0 3.5 Q 0 7 2.4 7 Q 4 7 4.5 5.4"),
        'D' => (4.5, "M 0 0 L 0 7 L 1.8 7 Q 4.5 7 4.5 3.5 Q 4.5 0 1.8 0 L 0 0"),
        'E' => (3.7, "M 3.7 0 L 0 0 L 0 7 L 3.7 7 M 0 3.4 L 3.2 3.4"),
        'F' => (3.6, "M 3.6 0 L 0 0 L 0 7 M 0 3.4 L 3.1 3.4"),
        'G' => (4.7, "M 4.5 1.6 Q 4 0 2.4 0 Q 0 0 0 3.5 Q 0 7 2.4 7 Q 4.7 7 4.7 3.9 L 2.8 3.9"),
        'H' => (4.4, "M 0 0 L 0 7 M 4.4 0 L 4.4 7 M 0 3.4 L 4.4 3.4"),
        'I' => (0.4, "M 0.2 0 L 0.2 7"),
        'J' => (3.0, "M 3 0 L 3 5 Q 3 7 1.5 7 Q 0 7 0 5.2"),
        'K' => (4.3, "M 0 0 L 0 7 M 4.1 0 L 0 4.4 M 1.5 2.8 L 4.3 7"),
        'L' => (3.5, "M 0 0 L 0 7 L 3.5 7"),
        'M' => (5.2, "M 0 7 L 0 0 L 2.6 5 L 5.2 0 L 5.2 7"),
        'N' => (4.4, "M 0 7 L 0 0 L 4.4 7 L 4.4 0"),
        'O' => (5.0, "M 2.5 0 Q 5 0 5 3.5 Q 5 7 2.5 7 Q 0 7 0 3.5 Q 0 0 2.5 0"),
        'P' => (4.0, "M 0 7 L 0 0 L 2.1 0 Q 4 0 4 2 Q 4 4 2.1 4 L 0 4"),
        'Q' => (5.0, "M 2.5 0 Q 5 0 5 3.5 Q 5 7 2.5 7 Q 0 7 0 3.5 Q 0 0 2.5 0 M 3.2 5.4 L 5 7.4"),
        'R' => (4.2, "M 0 7 L 0 0 L 2.1 0 Q 4 0 4 1.9 Q 4 3.8 2.1 3.8 L 0 3.8 M 2.2 3.8 L 4.2 7"),
        'S' => {
            (4.0, "M 3.8 1.4 Q 3.3 0 2 0 Q 0.2 0 0.2 1.7 Q 0.2 3 2 3.4 Q 4 3.8 4 5.2 Q 4 7 2 7 Q 0.4 7 0 5.4")
        }
        'T' => (4.2, "M 0 0 L 4.2 0 M 2.1 0 L 2.1 7"),
        'U' => (4.4, "M 0 0 L 0 4.6 Q 0 7 2.2 7 Q 4.4 7 4.4 4.6 L 4.4 0"),
        'V' => (4.6, "M 0 0 L 2.3 7 L 4.6 0"),
        'W' => (6.4, "M 0 0 L 1.6 7 L 3.2 1 L 4.8 7 L 6.4 0"),
        'X' => (4.4, "M 0 0 L 4.4 7 M 4.4 0 L 0 7"),
        'Y' => (4.4, "M 0 0 L 2.2 3.4 L 4.4 0 M 2.2 3.4 L 2.2 7"),
        'Z' => (4.2, "M 0 0 L 4.2 0 L 0 7 L 4.2 7"),
        'a' => (
            3.4,
            "M 0.3 3.3 Q 0.8 2.4 1.9 2.4 Q 3.4 2.4 3.4 4 L 3.4 7 M 3.4 4.4 Q 0 4.2 0 5.8 Q 0 7 1.4 7 Q 3.1 7 3.4 5.4",
        ),
        'b' => (3.6, "M 0 0 L 0 7 M 0 4.7 Q 0 2.4 1.8 2.4 Q 3.6 2.4 3.6 4.7 Q 3.6 7 1.8 7 Q 0 7 0 4.7"),
        'c' => (3.3, "M 3.3 3.5 Q 2.9 2.4 1.8 2.4 Q 0 2.4 0 4.7 Q 0 7 1.8 7 Q 2.9 7 3.3 5.9"),
        'd' => (3.6, "M 3.6 0 L 3.6 7 M 3.6 4.7 Q 3.6 2.4 1.8 2.4 Q 0 2.4 0 4.7 Q 0 7 1.8 7 Q 3.6 7 3.6 4.7"),
        'e' => (3.5, "M 0 4.6 L 3.5 4.6 Q 3.5 2.4 1.8 2.4 Q 0 2.4 0 4.7 Q 0 7 1.9 7 Q 3 7 3.4 6.1"),
        'f' => (2.2, "M 2.2 0 Q 0.8 -0.1 0.8 1.5 L 0.8 7 M 0 2.5 L 2 2.5"),
        'g' => (
            3.6,
            "M 3.6 2.4 L 3.6 7.2 Q 3.6 9 1.8 9 Q 0.6 9 0.2 8.2 M 3.6 4.7 Q 3.6 2.4 1.8 2.4 Q 0 2.4 0 4.7 Q 0 7 1.8 7 Q 3.6 7 3.6 4.7",
        ),
        'h' => (3.3, "M 0 0 L 0 7 M 0 4.4 Q 0.2 2.4 1.8 2.4 Q 3.3 2.4 3.3 4.2 L 3.3 7"),
        'i' => (0.4, "M 0.2 2.4 L 0.2 7 M 0.2 0.5 L 0.2 0.55"),
        'j' => (1.2, "M 1 2.4 L 1 7.6 Q 1 9 -0.2 8.9 M 1 0.5 L 1 0.55"),
        'k' => (3.2, "M 0 0 L 0 7 M 2.9 2.4 L 0 5.2 M 1.2 4.1 L 3.2 7"),
        'l' => (0.4, "M 0.2 0 L 0.2 7"),
        'm' => (
            5.6,
            "M 0 2.4 L 0 7 M 0 4.2 Q 0.2 2.4 1.5 2.4 Q 2.8 2.4 2.8 4.2 L 2.8 7 M 2.8 4.2 Q 3 2.4 4.3 2.4 Q 5.6 2.4 5.6 4.2 L 5.6 7",
        ),
        'n' => (3.3, "M 0 2.4 L 0 7 M 0 4.4 Q 0.2 2.4 1.8 2.4 Q 3.3 2.4 3.3 4.2 L 3.3 7"),
        'o' => (3.6, "M 1.8 2.4 Q 3.6 2.4 3.6 4.7 Q 3.6 7 1.8 7 Q 0 7 0 4.7 Q 0 2.4 1.8 2.4"),
        'p' => (3.6, "M 0 2.4 L 0 9 M 0 4.7 Q 0 2.4 1.8 2.4 Q 3.6 2.4 3.6 4.7 Q 3.6 7 1.8 7 Q 0 7 0 4.7"),
        'q' => {
            (3.6, "M 3.6 2.4 L 3.6 9 M 3.6 4.7 Q 3.6 2.4 1.8 2.4 Q 0 2.4 0 4.7 Q 0 7 1.8 7 Q 3.6 7 3.6 4.7")
        }
        'r' => (2.1, "M 0 2.4 L 0 7 M 0 4.6 Q 0.2 2.3 2.1 2.5"),
        's' => (
            3.0,
            "M 2.9 3.3 Q 2.5 2.4 1.5 2.4 Q 0.1 2.4 0.1 3.5 Q 0.1 4.4 1.5 4.6 Q 3 4.8 3 5.8 Q 3 7 1.5 7 Q 0.3 7 0 6",
        ),
        't' => (2.2, "M 0.8 0.8 L 0.8 5.6 Q 0.8 7 2.2 6.9 M 0 2.5 L 2 2.5"),
        'u' => (3.3, "M 0 2.4 L 0 5.2 Q 0 7 1.5 7 Q 3.1 7 3.3 5 M 3.3 2.4 L 3.3 7"),
        'v' => (3.4, "M 0 2.4 L 1.7 7 L 3.4 2.4"),
        'w' => (5.0, "M 0 2.4 L 1.2 7 L 2.5 2.9 L 3.8 7 L 5 2.4"),
        'x' => (3.2, "M 0 2.4 L 3.2 7 M 3.2 2.4 L 0 7"),
        'y' => (3.4, "M 0 2.4 L 1.75 6.9 M 3.4 2.4 L 1.6 7.5 Q 1.1 9 -0.1 8.9"),
        'z' => (3.0, "M 0 2.4 L 3 2.4 L 0 7 L 3 7"),
        '0' => (3.8, "M 1.9 0 Q 3.8 0 3.8 3.5 Q 3.8 7 1.9 7 Q 0 7 0 3.5 Q 0 0 1.9 0"),
        '1' => (2.0, "M 0 1.5 Q 1.3 1.2 1.6 0 L 1.6 7"),
        '2' => (3.7, "M 0.1 1.9 Q 0.1 0 1.9 0 Q 3.6 0 3.6 1.8 Q 3.6 3 2.2 4.4 L 0 7 L 3.7 7"),
        '3' => (
            3.7,
            "M 0.2 1.4 Q 0.5 0 1.9 0 Q 3.5 0 3.5 1.7 Q 3.5 3.3 1.5 3.3 Q 3.7 3.4 3.7 5.2 Q 3.7 7 1.9 7 Q 0.3 7 0 5.5",
        ),
        '4' => (4.0, "M 3.1 7 L 3.1 0 L 0 4.9 L 4 4.9"),
        '5' => {
            (3.7, "M 3.4 0 L 0.6 0 L 0.3 3.2 Q 0.9 2.6 1.9 2.6 Q 3.7 2.7 3.7 4.8 Q 3.7 7 1.8 7 Q 0.3 7 0 5.6")
        }
        '6' => (
            3.8,
            "M 3.5 1.3 Q 3.1 0 2 0 Q 0 0 0 4 Q 0 7 1.9 7 Q 3.8 7 3.8 4.8 Q 3.8 2.7 2 2.7 Q 0.3 2.7 0 4.6",
        ),
        '7' => (3.6, "M 0 0 L 3.6 0 Q 1.6 3 1.3 7"),
        '8' => (
            3.8,
            "M 1.9 3.3 Q 0.3 3.2 0.3 1.7 Q 0.3 0 1.9 0 Q 3.5 0 3.5 1.7 Q 3.5 3.2 1.9 3.3 Q 0 3.4 0 5.2 Q 0 7 1.9 7 Q 3.8 7 3.8 5.2 Q 3.8 3.4 1.9 3.3",
        ),
        '9' => (
            3.8,
            "M 0.3 5.7 Q 0.7 7 1.8 7 Q 3.8 7 3.8 3 Q 3.8 0 1.9 0 Q 0 0 0 2.2 Q 0 4.3 1.8 4.3 Q 3.5 4.3 3.8 2.4",
        ),
        '.' => (0.4, "M 0.2 6.9 L 0.2 6.95"),
        ',' => (0.8, "M 0.5 6.8 L 0.1 8.2"),
        ':' => (0.4, "M 0.2 3.1 L 0.2 3.15 M 0.2 6.7 L 0.2 6.75"),
        ';' => (0.8, "M 0.5 3.1 L 0.5 3.15 M 0.5 6.8 L 0.1 8.2"),
        '-' => (2.2, "M 0.1 4.3 L 2.1 4.3"),
        '+' => (3.4, "M 0 4.3 L 3.4 4.3 M 1.7 2.6 L 1.7 6"),
        '=' => (3.2, "M 0 3.3 L 3.2 3.3 M 0 5.3 L 3.2 5.3"),
        '/' => (2.6, "M 0 7.6 L 2.6 -0.5"),
        '(' => (1.5, "M 1.5 -0.6 Q -0.9 3.6 1.5 8.2"),
        ')' => (1.5, "M 0 -0.6 Q 2.4 3.6 0 8.2"),
        '[' => (1.3, "M 1.3 -0.5 L 0 -0.5 L 0 8 L 1.3 8"),
        ']' => (1.3, "M 0 -0.5 L 1.3 -0.5 L 1.3 8 L 0 8"),
        '%' => (
            5.6,
            "M 4.5 0 L 1.1 7 M 1.2 0 Q 2.4 0 2.4 1.6 Q 2.4 3.2 1.2 3.2 Q 0 3.2 0 1.6 Q 0 0 1.2 0 M 4.4 3.8 Q 5.6 3.8 5.6 5.4 Q 5.6 7 4.4 7 Q 3.2 7 3.2 5.4 Q 3.2 3.8 4.4 3.8",
        ),
        '_' => (3.6, "M 0 8 L 3.6 8"),
        '\'' => (0.4, "M 0.2 0 L 0.2 1.8"),
        '"' => (1.6, "M 0.2 0 L 0.2 1.8 M 1.4 0 L 1.4 1.8"),
        '!' => (0.4, "M 0.2 0 L 0.2 4.8 M 0.2 6.9 L 0.2 6.95"),
        '?' => {
            (3.2, "M 0 1.6 Q 0.1 0 1.6 0 Q 3.2 0 3.2 1.7 Q 3.2 2.9 1.6 3.7 L 1.6 4.9 M 1.6 6.9 L 1.6 6.95")
        }
        '<' => (3.2, "M 3.2 1.8 L 0 4.3 L 3.2 6.8"),
        '>' => (3.2, "M 0 1.8 L 3.2 4.3 L 0 6.8"),
        '#' => (4.4, "M 1.6 0.4 L 0.8 7 M 3.6 0.4 L 2.8 7 M 0.2 2.5 L 4.4 2.5 M 0 4.9 L 4.2 4.9"),
        '&' => (
            4.6,
            "M 4.5 7 L 0.9 2.4 Q 0.2 1.5 0.7 0.7 Q 1.1 0 1.9 0 Q 3.2 0 3.2 1.4 Q 3.2 2.5 1.6 3.3 Q 0 4 0 5.4 Q 0 7 1.8 7 Q 3.9 7 4.3 4.2",
        ),
        _ => (3.2, "M 0 0 L 3.2 0 L 3.2 7 L 0 7 L 0 0"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_printable_character_that_the_picture_uses_has_a_glyph() {
        let (_, unknown) = glyph('\u{1F41F}');
        let used = ('a'..='z').chain('A'..='Z').chain('0'..='9').chain(".,:;-+=/()[]%_'\"!?<>#&".chars());
        for character in used {
            let (_, path) = glyph(character);
            assert_ne!(path, unknown, "{character:?}");
            let bounds = strokes(&character.to_string(), 0.0, CAPITAL, CAPITAL)
                .and_then(|path| path.compute_tight_bounds());
            let bounds = bounds.unwrap_or_else(|| panic!("{character:?} draws nothing"));
            assert!(bounds.top() >= -0.7 && bounds.bottom() <= 9.1, "{character:?}: {bounds:?}");
            assert!(bounds.right() <= glyph(character).0 + 0.01, "{character:?}: {bounds:?}");
        }
    }

    #[test]
    fn text_is_as_wide_as_its_strokes() {
        let bounds = strokes("HillH", 10.0, 50.0, 14.0).map(|path| path.bounds());
        let bounds = bounds.unwrap_or_else(|| panic!("the text draws nothing"));
        assert!((bounds.right() - bounds.left() - width("HillH", 14.0)).abs() < 1e-3);
        assert_eq!((bounds.top(), bounds.bottom()), (36.0, 50.0));
        assert!(strokes(" ", 0.0, 0.0, 14.0).is_none());
    }
}
