//! Checks paths from untrusted sources: photographs in a manifest, files that a coordinator sends.

/// Longest path, bytes. File systems allow 255 a part and 4096 in all; no dataset comes near this limit.
pub const MAX_PATH_BYTES: usize = 1024;

/// Refuses a path that could leave its folder on any system. It must be relative, with `/` between its parts,
/// and no part may be empty, `.` or `..`. Drives, backslashes and control characters are refused, and so is a
/// path over [`MAX_PATH_BYTES`].
///
/// # Errors
/// What is wrong, phrased to follow the path itself.
pub fn check_inside(path: &str) -> Result<(), String> {
    let has_drive =
        |part: &str| matches!(part.as_bytes(), [letter, b':', ..] if letter.is_ascii_alphabetic());
    let fault = if path.is_empty() {
        "is empty"
    } else if path.len() > MAX_PATH_BYTES {
        return Err(format!("has {} bytes, and at most {MAX_PATH_BYTES} are allowed", path.len()));
    } else if path.chars().any(char::is_control) {
        "contains a control character"
    } else if path.contains('\\') {
        "contains a backslash; separate the parts with /"
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
    fn paths_that_leave_their_folder_on_any_system_are_refused() {
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
    fn usual_photograph_names_are_accepted() {
        for path in
            ["a.jpg", "left cam/frame 12.JPG", "täuchung/ß.png", "a..b.png", "dive 12:30:05.jpg", "...", ".a"]
        {
            assert_eq!(check_inside(path), Ok(()), "{path}");
        }
    }
}
