//! Runs by seed, the invariants of their histories, and that the absence of a safeguard is noticed.
//!
//! `FATHOM_SIMULATION_SEEDS=N` runs so many seeds in the place of 200.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use fathom_simulation::campaign::{Campaign, run_apart, setting};
use fathom_simulation::{Options, Safeguard};

fn program() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_fathom-simulation"))
}

#[test]
fn invariants_hold_whatever_crashes_is_cut_or_comes_twice() {
    let since = Instant::now();
    let seeds = 1..=setting("FATHOM_SIMULATION_SEEDS").unwrap_or(200);
    let counts = Campaign::new(program()).all(seeds).unwrap_or_else(|report| panic!("{report}"));
    eprintln!("{:.0} s: {counts:?}", since.elapsed().as_secs_f64());
    // Faults fired, and were noticed.
    assert!(counts.coordinators > 2 * counts.seeds && counts.workers > counts.seeds, "{counts:?}");
    assert!(counts.partitions > counts.seeds && counts.holds > counts.seeds, "{counts:?}");
    assert!(counts.attempts > 4 * counts.jobs && counts.stale > counts.seeds, "{counts:?}");
    assert!(counts.disks > 0 && counts.repeated > 0, "{counts:?}");
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

/// How many of so many seeds violate what, without a safeguard.
fn violations_without(safeguard: Safeguard, seeds: u64) -> BTreeMap<String, u64> {
    let mut by_name = BTreeMap::new();
    for seed in 1..=seeds {
        let run = run_apart(program(), &Options { seed, without: Some(safeguard), ..Options::default() });
        let mut names: Vec<&str> =
            run.violations.iter().filter_map(|fault| Some(fault.split_once(':')?.0)).collect();
        names.sort_unstable();
        names.dedup();
        names.into_iter().for_each(|name| *by_name.entry(name.to_owned()).or_default() += 1);
    }
    eprintln!("without {safeguard:?}, of {seeds} seeds violate: {by_name:?}");
    by_name
}

#[test]
fn the_absence_of_fences_is_noticed() {
    assert!(violations_without(Safeguard::Fence, 16).contains_key("I4"));
}

#[test]
fn the_absence_of_the_table_of_requests_is_noticed() {
    assert!(violations_without(Safeguard::Requests, 3).contains_key("I2"));
}

#[test]
fn the_absence_of_the_sweeper_is_noticed() {
    assert!(violations_without(Safeguard::Sweeper, 4).contains_key("I8"));
}

#[test]
fn the_absence_of_the_sync_before_the_answer_is_noticed() {
    assert!(violations_without(Safeguard::Sync, 12).contains_key("I5"));
}
