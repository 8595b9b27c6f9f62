//! Runs many seeds, each in its own process: only then is a seed reproducible.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crate::world::KINDS;
use crate::{Counts, Options, Run};

/// Runs many seeds.
pub struct Campaign {
    program: PathBuf,
    /// The models of runs without faults, by the kind of their jobs.
    reference: BTreeMap<String, String>,
}

/// A number from the environment; `None` if it is empty.
///
/// # Panics
/// When it is no number.
pub fn setting(name: &str) -> Option<u64> {
    let text = std::env::var(name).ok().filter(|text| !text.is_empty())?;
    Some(text.parse().unwrap_or_else(|error| panic!("{name}={text}: {error}")))
}

/// One run in a process of `program` (`fathom-simulation`).
///
/// # Panics
/// When it does not finish.
pub fn run_apart(program: &Path, options: &Options) -> Run {
    let text = serde_json::to_string(options).expect("options as JSON");
    let ended = Command::new(program).arg(&text).output().expect("a process");
    serde_json::from_slice(&ended.stdout).unwrap_or_else(|error| {
        let said = String::from_utf8_lossy(&ended.stderr);
        panic!("the run {text} failed ({}): {error}\n{said}", ended.status)
    })
}

impl Campaign {
    /// Runs each kind of job without faults first.
    ///
    /// # Panics
    /// When such a run violates an invariant.
    pub fn new(program: &Path) -> Self {
        let calm = |kind| {
            let options = Options { seed: 1, undisturbed: true, jobs: Some(kind), ..Options::default() };
            let run = run_apart(program, &options);
            assert!(run.violations.is_empty(), "{kind:?} without faults: {:?}\n{}", run.violations, run.tail);
            assert!(
                run.models.len() > 1 && run.models.iter().all(|model| *model == run.models[0]),
                "{kind:?}"
            );
            run.models[0].clone()
        };
        Self { program: program.to_owned(), reference: KINDS.map(calm).into() }
    }

    /// A run with I12 checked too.
    pub fn checked(&self, seed: u64) -> Run {
        let mut run = run_apart(&self.program, &Options { seed, ..Options::default() });
        for (kind, model) in &run.models {
            let reference = self.reference.get(kind);
            if reference != Some(model) {
                run.violations.push(format!(
                    "I12: the model of a job of kind {kind} is {model}, without faults it is {reference:?}"
                ));
            }
        }
        run
    }

    /// Runs all of these seeds, two at a time; returns the sum of their counts.
    ///
    /// # Errors
    /// The first seed that violates an invariant, with the violation and the end of its history.
    pub fn all(&self, seeds: RangeInclusive<u64>) -> Result<Counts, String> {
        let (next, failed) = (AtomicU64::new(*seeds.start()), AtomicBool::new(false));
        let outcome = Mutex::new((Counts::default(), Vec::new()));
        std::thread::scope(|scope| {
            for _ in 0..2 {
                scope.spawn(|| {
                    loop {
                        let seed = next.fetch_add(1, Ordering::SeqCst);
                        if seed > *seeds.end() || failed.load(Ordering::SeqCst) {
                            return;
                        }
                        let run = self.checked(seed);
                        let mut outcome = outcome.lock().expect("nobody panics with it");
                        outcome.0 += run.counts;
                        if outcome.0.seeds.is_multiple_of(500) {
                            eprintln!("{:?}", outcome.0);
                        }
                        if !run.violations.is_empty() {
                            failed.store(true, Ordering::SeqCst);
                            outcome.1.push(report(seed, &run));
                        }
                    }
                });
            }
        });
        let (counts, reports) = outcome.into_inner().expect("nobody panicked with it");
        if reports.is_empty() { Ok(counts) } else { Err(reports.join("\n")) }
    }
}

/// The report of a failed run.
fn report(seed: u64, run: &Run) -> String {
    format!(
        "seed {seed}:\n{}\nreplay: make simulate SEED={seed}\nthe end of its history:\n{}",
        run.violations.join("\n"),
        run.tail
    )
}
