//! Real scenes, for tests: they lie outside the repository.

use std::io::Write as _;
use std::path::{Path, PathBuf};

/// The folder or file `name` among the real scenes (`$FATHOM_SCENES`, or `../shared/scenes` beside the
/// workspace), for a test; `None` where it is not there, which stderr is told.
pub fn real_scene_for_test(name: &str) -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/scenes");
    let path = std::env::var_os("FATHOM_SCENES").map_or(beside, PathBuf::from).join(name);
    if path.exists() {
        return Some(path);
    }
    // Not eprintln: the harness keeps what passing tests say with it to itself.
    let _ = writeln!(
        std::io::stderr().lock(),
        "skipped: {} does not exist; set FATHOM_SCENES to the folder of the real scenes",
        path.display()
    );
    None
}
