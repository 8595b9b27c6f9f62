//! The undisturbed run: the scene and settings of all scenarios, and the expected model.

use std::path::{Path, PathBuf};
use std::sync::{LazyLock, OnceLock};
use std::time::Duration;

use crate::harness::Harness;
use crate::processes::succeed;

/// Two partitions after a coarse model, two seconds of training each, a checkpoint every second.
pub const JOB: [&str; 5] = [
    "--partitions=2x1",
    "--preset=3dgs",
    "--iterations=300",
    "--max-gaussians=1000",
    "--set=train.checkpoint_seconds=1",
];

/// Longer than any run of these tests.
const KEPT_FOR: Duration = Duration::from_secs(24 * 60 * 60);

/// The shared folder of this process's scenarios; removes those of processes that ended long ago.
static SHARED: LazyLock<PathBuf> = LazyLock::new(|| {
    let all = Path::new(env!("CARGO_TARGET_TMPDIR")).join("kills");
    std::fs::create_dir_all(&all).expect("a folder");
    for old in std::fs::read_dir(&all).expect("a folder").map_while(Result::ok) {
        let changed = old.metadata().and_then(|meta| meta.modified()).ok();
        if changed.and_then(|changed| changed.elapsed().ok()).is_some_and(|age| age > KEPT_FOR) {
            // Another process may have removed it already.
            let _ = std::fs::remove_dir_all(old.path());
        }
    }
    let folder = all.join(std::process::id().to_string());
    // Left by an earlier process with this id.
    let _ = std::fs::remove_dir_all(&folder);
    std::fs::create_dir(&folder).expect("a folder");
    let scene = folder.join("scene");
    succeed(&["synth", &scene.to_string_lossy(), "--views", "40", "--size", "64x48"]);
    folder
});

/// The photographs.
pub fn scene() -> PathBuf {
    SHARED.join("scene")
}

/// A shared photograph cache, for workers that need not fetch.
pub fn cache() -> PathBuf {
    SHARED.join("cache")
}

/// The model of the undisturbed run, made on first use.
pub fn model() -> &'static [u8] {
    static MODEL: OnceLock<Vec<u8>> = OnceLock::new();
    MODEL.get_or_init(|| {
        let mut harness = Harness::new("reference");
        harness.start_worker("first");
        harness.start_worker("second");
        let job = harness.submit();
        let history = harness.ended(&job, "succeeded");
        for task in ["global", "partition-0000", "partition-0001", "merge"] {
            assert_eq!(history.leases(task).len(), 1, "the undisturbed run was disturbed: {task}");
        }
        let model = harness.download(&job);
        harness.check_what_is_kept();
        assert!(model.starts_with(b"ply\n") && model.len() > 50_000, "{} bytes", model.len());
        model
    })
}
