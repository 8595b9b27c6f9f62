//! Finds real scenes for tests, which are outside the repository.

use std::io::Write as _;
use std::path::{Path, PathBuf};

/// The folder or file `name` among the real scenes in `$FATHOM_SCENES`, for a test. `None` if it does not
/// exist, with a message on stderr. Without the variable, the folder is `shared/scenes` beside the workspace.
pub fn real_scene_for_test(name: &str) -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/scenes");
    let path = std::env::var_os("FATHOM_SCENES").map_or(beside, PathBuf::from).join(name);
    if path.exists() {
        return Some(path);
    }
    // Not eprintln: the harness captures its output in passing tests.
    let _ = writeln!(
        std::io::stderr().lock(),
        "skipped: {} does not exist; set FATHOM_SCENES to the folder of the real scenes",
        path.display()
    );
    None
}
