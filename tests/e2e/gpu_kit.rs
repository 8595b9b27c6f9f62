//! The kit for a GPU machine (`scripts/gpu.sh`), rehearsed on a CPU driver with tiny sizes. It is packed,
//! unpacked elsewhere, run with a part that fails, run again, and merged into a history.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use serde_json::Value;

use crate::processes::{Watchdog, can_train};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn finish(command: &mut Command) -> Output {
    let child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn();
    let child = child.unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let _watchdog = Watchdog::over(&child);
    child.wait_with_output().expect("its output")
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

fn target() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_fathom")).ancestors().nth(2).expect("the target folder")
}

fn script(arguments: &[&Path], environment: &[(&str, &Path)]) -> Output {
    let mut command = Command::new(root().join("scripts/gpu.sh"));
    command.args(arguments).envs(environment.iter().copied());
    command.env("CARGO_TARGET_DIR", target()).env("FATHOM_GPU_REHEARSAL", "1").env("PEERS", "");
    finish(&mut command)
}

/// A folder with links to the programs of the kit, which `cargo test --workspace` has built; `None` if one is
/// missing. Building them here would have cargo rebuild packages whose build depends on its own variables.
fn programs(into: &Path) -> Option<PathBuf> {
    let built = Path::new(env!("CARGO_BIN_EXE_fathom")).parent()?;
    let mut found = vec![("fathom", built.join("fathom"))];
    for name in ["bench_random", "train_scene", "first_iteration"] {
        found.push((name, built.join("examples").join(name)));
    }
    for name in ["kernels", "device"] {
        let is_one = |file: &Path| {
            let stem =
                file.file_name().and_then(|stem| stem.to_str()).and_then(|stem| stem.strip_prefix(name));
            stem.is_some_and(|rest| rest.starts_with('-') && !rest.contains('.'))
        };
        let files = std::fs::read_dir(built.join("deps")).ok()?.filter_map(|entry| Some(entry.ok()?.path()));
        let age = |file: &PathBuf| file.metadata().and_then(|data| data.modified()).ok();
        found.push((name, files.filter(|file| is_one(file)).max_by_key(age)?));
    }
    let folder = into.join("programs");
    std::fs::create_dir(&folder).expect("a folder");
    for (name, file) in found {
        file.is_file().then_some(())?;
        std::os::unix::fs::symlink(file, folder.join(name)).expect("a link");
    }
    Some(folder)
}

/// What became of each part.
fn parts(results: &Path) -> Value {
    let text = std::fs::read_to_string(results.join("parts.json")).expect("parts.json");
    serde_json::from_str(&text).expect("JSON")
}

fn rows(file: &Path) -> Vec<Value> {
    let text = std::fs::read_to_string(file).expect("rows");
    text.lines().map(|line| serde_json::from_str(line).expect("a row")).collect()
}

#[test]
fn a_packed_kit_runs_goes_on_after_failures_and_merges() {
    let test = "a_packed_kit_runs_goes_on_after_failures_and_merges";
    if !can_train(test) {
        return;
    }
    let tools = ["python3", "xz", "strip", "readelf"];
    if let Some(tool) = tools.iter().find(|tool| Command::new(tool).arg("--version").output().is_err()) {
        eprintln!("{test}: skipped, since {tool} is not installed");
        return;
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let archive = folder.path().join("kit.tar.xz");
    let Some(programs) = programs(folder.path()) else {
        eprintln!("{test}: skipped, since its programs are not built; cargo test --workspace builds them");
        return;
    };
    let packed = script(&[Path::new("pack"), &archive], &[("FATHOM_GPU_PROGRAMS", &programs)]);
    assert!(packed.status.success(), "{}", said(&packed));
    assert!(
        finish(Command::new("tar").arg("-xf").arg(&archive).arg("-C").arg(folder.path())).status.success()
    );

    // Without what the first picture is compared with, one part fails and the others have their results.
    let kit = folder.path().join("fathom-gpu");
    let results = folder.path().join("results");
    let run = |words: &[&str]| {
        finish(Command::new(kit.join("run")).args(words).arg("--allow-cpu").arg("--out").arg(&results))
    };
    std::fs::rename(kit.join("first.bin"), kit.join("first.away")).expect("the file of the kit");
    let first = run(&["checks", "times"]);
    assert_eq!(first.status.code(), Some(1), "{}", said(&first));
    let found = parts(&results);
    let layer = kit.join("layer/libVkLayer_khronos_validation.so").exists();
    for (name, part) in found.as_object().expect("an object") {
        let fails = name == "first" || name == "validation" && !layer;
        assert_eq!(part["result"] == "ok", !fails, "{name}: {part}; {}", said(&first));
    }
    assert_eq!(found.as_object().map(serde_json::Map::len), Some(10), "{found:#}");
    let trace = std::fs::read_to_string(results.join("trace.json")).expect("a trace");
    let trace: Value = serde_json::from_str(&trace).expect("JSON");
    let names: Vec<&str> =
        trace["traceEvents"].as_array().expect("a list").iter().filter_map(|e| e["name"].as_str()).collect();
    assert!(names.contains(&"mcmc") && names.contains(&"1m rasterize_forward"), "{names:?}");

    // The second call does what is left alone. Peers that were not packed are an error that says so.
    std::fs::rename(kit.join("first.away"), kit.join("first.bin")).expect("the file of the kit");
    let before = rows(&results.join("rows.jsonl"));
    let second = run(&["first", "mcmc", "gsplat-stages-1m"]);
    assert_eq!(second.status.code(), Some(1), "{}", said(&second));
    let found = parts(&results);
    assert_eq!(found["first"]["result"], "ok", "{}", said(&second));
    let why = found["gsplat-stages-1m"]["why"].as_str().unwrap_or_default().to_owned();
    assert!(why.contains("packed without gsplat"), "{why}");
    let measured = rows(&results.join("rows.jsonl"));
    assert_eq!(measured.len(), before.len() + 1, "the second call repeats what was done: {}", said(&second));

    let of = |figure: &str, variant: &str| {
        let row =
            measured.iter().find(|row| row["figure"] == figure && row["variant"].as_str() == Some(variant));
        row.unwrap_or_else(|| panic!("{figure} {variant} has no row: {measured:#?}"))["values"].clone()
    };
    assert_eq!(of("gpu_checks", "bytes")["same_bytes"], 1);
    assert!(of("gpu_checks", "kernels")["passed"].as_u64() > Some(1));
    let trained = of("gpu_mcmc", "fathom");
    let number = |value: &Value| value.as_f64().expect("a number");
    let forecast = number(&trained["forecast_bytes"]) / number(&trained["peak_bytes"]);
    assert!((0.5..2.0).contains(&forecast), "forecast {forecast} of what it took");
    let computed = number(&of("gpu_mcmc", "fathom, 30k computed")["wall_s"]);
    let expected = 30.0 * number(&trained["ms_per_step"]);
    assert!((computed / expected - 1.0).abs() < 1e-9, "{computed} s, expected {expected} s");

    let (history, table) = (folder.path().join("history.jsonl"), folder.path().join("gpu.md"));
    let empty = "a\n<!-- begin -->\n<!-- end -->\n";
    std::fs::write(&table, empty).expect("a file");
    for _ in 0..2 {
        let merged = script(
            &[Path::new("unpack"), &results],
            &[("FATHOM_HISTORY", &history), ("FATHOM_BENCHMARKS_GPU", &table)],
        );
        assert!(merged.status.success(), "{}", said(&merged));
        assert_eq!(rows(&history), measured, "each row is added once");
    }
    assert_eq!(std::fs::read_to_string(&table).expect("the table"), empty, "a CPU is shown as a card");
}

#[test]
fn unknown_parts_and_folders_without_results_are_refused() {
    let kit = root().join("scripts/gpu/kit.py");
    let refused = finish(Command::new("python3").arg(kit).arg("everything"));
    assert!(!refused.status.success());
    assert!(said(&refused).contains("there is no part everything; parts are kernels"), "{}", said(&refused));
    let refused = script(&[Path::new("unpack"), Path::new("/no-results")], &[]);
    assert!(!refused.status.success());
    assert!(said(&refused).contains("/no-results/rows.jsonl is not there"), "{}", said(&refused));
}
