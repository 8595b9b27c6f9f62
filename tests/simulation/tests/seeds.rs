//! Runs seeds, checks the invariants of their histories, and checks that a missing safeguard is detected.
//!
//! `FATHOM_SIMULATION_SEEDS=N` runs N seeds instead of 200.

use std::path::Path;
use std::time::Instant;

use fathom_simulation::campaign::{Campaign, run_apart, setting};
use fathom_simulation::{Options, Safeguard};

fn program() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_fathom-simulation"))
}

#[test]
fn invariants_hold_despite_crashes_cuts_and_repeats() {
    let since = Instant::now();
    let seeds = 1..=setting("FATHOM_SIMULATION_SEEDS").unwrap_or(200);
    let counts = Campaign::new(program()).all(seeds).unwrap_or_else(|report| panic!("{report}"));
    eprintln!("{:.0} s: {counts:?}", since.elapsed().as_secs_f64());
    // Faults occurred, and were noticed.
    assert!(counts.coordinators > 2 * counts.seeds && counts.workers > counts.seeds, "{counts:?}");
    assert!(counts.partitions > counts.seeds && counts.holds > counts.seeds, "{counts:?}");
    assert!(counts.attempts > 4 * counts.jobs && counts.stale > counts.seeds, "{counts:?}");
    assert!(
        counts.disks > 0 && counts.repeated > 0 && counts.second_attempts > counts.seeds / 4,
        "{counts:?}"
    );
    assert!(counts.datasets > counts.jobs / 4 && counts.deleted > counts.jobs / 5, "{counts:?}");
    assert!(counts.removed > 20 * counts.deleted, "{counts:?}");
}

#[test]
fn a_seed_replays_to_the_same_history() {
    for seed in 1..=4 {
        let options = Options { seed, ..Options::default() };
        let [first, second] = [(), ()].map(|()| run_apart(program(), &options).history);
        if let Some((at, (a, b))) = first.iter().zip(&second).enumerate().find(|(_, (a, b))| a != b) {
            let before = first[at.saturating_sub(10)..at].join("\n");
            panic!("seed {seed}: after\n{before}\ncame\n{a}\nand then\n{b}");
        }
        assert_eq!(first.len(), second.len(), "seed {seed}");
        assert!(first.len() > 20, "seed {seed}: nothing happened");
    }
}

/// Runs seeds without a safeguard until an invariant does not hold.
fn is_noticed(safeguard: Safeguard, invariant: &str) {
    const AT_MOST: u64 = 60;
    for seed in 1..=AT_MOST {
        let run = run_apart(program(), &Options { seed, without: Some(safeguard), ..Options::default() });
        let found = run.violations.iter().find(|fault| fault.starts_with(&format!("{invariant}:")));
        if let Some(fault) = found {
            eprintln!("without {safeguard:?}, seed {seed}: {fault}");
            return;
        }
    }
    panic!("without {safeguard:?}, {invariant} held in {AT_MOST} seeds");
}

#[test]
fn the_absence_of_fences_is_noticed() {
    is_noticed(Safeguard::Fence, "I4");
}

#[test]
fn the_absence_of_the_table_of_requests_is_noticed() {
    is_noticed(Safeguard::Requests, "I2");
}

#[test]
fn the_absence_of_the_sweeper_is_noticed() {
    is_noticed(Safeguard::Sweeper, "I8");
}

#[test]
fn the_absence_of_the_sync_before_the_answer_is_noticed() {
    is_noticed(Safeguard::Sync, "I5");
}
