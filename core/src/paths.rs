//! What a path that somebody else wrote may be: photographs in a manifest, files that a coordinator hands
//! out.

/// Longest path, bytes. File systems end at 255 a part and 4096 in all; no dataset comes near this.
pub const MAX_PATH_BYTES: usize = 1024;

/// Refuses a path that is not plainly one inside a folder, on any system: it must be relative, with `/`
/// between its parts, none of them empty, `.` or `..`, without drives, backslashes and control characters,
/// and of at most [`MAX_PATH_BYTES`].
///
/// # Errors
/// What is wrong, to go behind the path itself.
pub fn check_inside(path: &str) -> Result<(), String> {
    let has_drive =
        |part: &str| matches!(part.as_bytes(), [letter, b':', ..] if letter.is_ascii_alphabetic());
    let fault = if path.is_empty() {
        "is empty"
    } else if path.len() > MAX_PATH_BYTES {
        return Err(format!("has {} bytes, and at most {MAX_PATH_BYTES} are allowed", path.len()));
    } else if path.chars().any(char::is_control) {
        "holds a control character"
    } else if path.contains('\\') {
        "holds a backslash; parts are divided by /"
    } else if path.starts_with('/') || path.split('/').any(has_drive) {
        "is absolute; it must be relative"
    } else if path.split('/').any(|part| part == "..") {
        "leaves its folder: it must be a relative path without \"..\""
    } else if path.split('/').any(|part| matches!(part, "" | ".")) {
        "has an empty part or \".\" between two /"
    } else {
        return Ok(());
    };
    Err(fault.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_that_leave_their_folder_on_any_system_are_refused_with_the_reason() {
        for (path, reason) in [
            ("", "empty"),
            ("/etc/passwd", "absolute"),
            ("C:/a.jpg", "absolute"),
            ("a/c:b.jpg", "absolute"),
            ("C:\\a.jpg", "backslash"),
            ("\\\\server\\share", "backslash"),
            ("..", "\"..\""),
            ("../a.jpg", "\"..\""),
            ("a/../../b.jpg", "\"..\""),
            ("a/..", "\"..\""),
            ("a//b.jpg", "empty part"),
            ("a/", "empty part"),
            ("./a.jpg", "\".\""),
            ("a\nb.jpg", "control"),
            ("a\0.jpg", "control"),
            ("a\u{85}.jpg", "control"),
        ] {
            let refused = check_inside(path);
            assert!(refused.as_ref().is_err_and(|fault| fault.contains(reason)), "{path:?}: {refused:?}");
        }
        let long = "a/".repeat(MAX_PATH_BYTES / 2 - 1);
        assert_eq!(check_inside(&format!("{long}bb")), Ok(()));
        assert!(check_inside(&format!("{long}bbb")).is_err_and(|fault| fault.contains("1025 bytes")));
    }

    #[test]
    fn names_that_photographs_have_are_taken() {
        for path in
            ["a.jpg", "left cam/frame 12.JPG", "täuchung/ß.png", "a..b.png", "dive 12:30:05.jpg", "...", ".a"]
        {
            assert_eq!(check_inside(path), Ok(()), "{path}");
        }
    }
}
