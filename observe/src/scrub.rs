//! Removes secrets that messages contain by accident: not only operators read job logs.

/// Markers before a secret, in lower case.
const MARKS: [&str; 8] =
    ["bearer ", "token=", "token: ", "\"token\":", "password=", "password: ", "secret=", "api_key="];
/// Replacement of a secret.
const HIDDEN: &str = "[hidden]";

/// The text without apparent credentials: values after "Bearer", "token=" and the like, and user names and
/// passwords in URLs.
///
/// No program of Fathom writes its tokens into messages; this is for errors of libraries that quote their
/// input.
pub fn scrub(text: &str) -> String {
    let mut clean = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((secret, length)) = next_secret(rest) {
        clean.push_str(&rest[..secret]);
        clean.push_str(HIDDEN);
        rest = &rest[secret + length..];
    }
    clean.push_str(rest);
    clean
}

/// Offset of the first secret, and its length, bytes.
fn next_secret(text: &str) -> Option<(usize, usize)> {
    let lower = text.to_ascii_lowercase();
    let ends = |c: char| c.is_whitespace() || matches!(c, '"' | '\'' | ',' | ';' | '&' | ')' | '}' | ']');
    let after_mark = |mark: &str| {
        let value = lower.find(mark)? + mark.len();
        let start = value + (text[value..].len() - text[value..].trim_start_matches(['"', '\'', ' ']).len());
        let length = text[start..].find(ends).unwrap_or(text.len() - start);
        // A hidden secret stays hidden, and is not found again.
        (length > 0 && !text[start..].starts_with(HIDDEN)).then_some((start, length))
    };
    MARKS.iter().filter_map(|mark| after_mark(mark)).chain(user_in_url(text)).min()
}

/// The part before the @ of a URL that has one.
fn user_in_url(text: &str) -> Option<(usize, usize)> {
    let mut from = 0;
    while let Some(found) = text[from..].find("://") {
        let start = from + found + 3;
        let end = text[start..].find(|c: char| c.is_whitespace() || matches!(c, '/' | '"' | '?' | '#'));
        let host = &text[start..end.map_or(text.len(), |end| start + end)];
        if let Some(at) = host.rfind('@')
            && &host[..at] != HIDDEN
        {
            return Some((start, at));
        }
        from = start;
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn secrets_are_hidden_and_everything_else_stays() {
        let cases = [
            ("authorization: Bearer abc.def-1 was refused", "authorization: Bearer [hidden] was refused"),
            (
                "url=http://me:pass@host:7420/x token=\"t0p\", n=3",
                "url=http://[hidden]@host:7420/x token=\"[hidden]\", n=3",
            ),
            (r#"{"token":"abc","iteration":7}"#, r#"{"token":"[hidden]","iteration":7}"#),
            ("PASSWORD=x&y=1 secret=tief\u{fc}\u{fc} ende", "PASSWORD=[hidden]&y=1 secret=[hidden] ende"),
            ("iteration=100 psnr=27.5 at http://host/a@b", "iteration=100 psnr=27.5 at http://host/a@b"),
            ("token=", "token="),
        ];
        for (text, expected) in cases {
            assert_eq!(scrub(text), expected);
            assert_eq!(scrub(expected), expected, "again");
        }
    }
}
