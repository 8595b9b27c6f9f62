//! `fathom-simulation OPTIONS` runs one seed in this process and prints the outcome. Options and outcome are
//! JSON: `{"seed": 7}`.
//!
//! `fathom-simulation` alone runs `FATHOM_SIMULATION_SEEDS` seeds (200), each in its own process, and prints
//! a summary. `FATHOM_SIMULATION_SEED=7 fathom-simulation` runs one seed and prints the whole history.

use std::process::ExitCode;

use fathom_simulation::campaign::{Campaign, setting};
use fathom_simulation::{Options, run};

fn main() -> ExitCode {
    if let Some(options) = std::env::args().nth(1) {
        let options: Options = match serde_json::from_str(&options) {
            Ok(options) => options,
            Err(error) => {
                eprintln!("{options}: {error}; it looks like {{\"seed\": 7}}");
                return ExitCode::FAILURE;
            }
        };
        println!("{}", serde_json::to_string(&run(&options)).expect("the outcome as JSON"));
        return ExitCode::SUCCESS;
    }
    let program = std::env::current_exe().expect("the path of this program");
    let campaign = Campaign::new(&program);
    let outcome = match setting("FATHOM_SIMULATION_SEED") {
        Some(seed) => {
            let run = campaign.checked(seed);
            run.history.iter().for_each(|line| println!("{line}"));
            println!("{:?}\n{}", run.counts, run.tail);
            if run.violations.is_empty() { Ok(run.counts) } else { Err(run.violations.join("\n")) }
        }
        None => campaign.all(1..=setting("FATHOM_SIMULATION_SEEDS").unwrap_or(200)),
    };
    match outcome {
        Ok(counts) => {
            println!("every invariant held: {counts:?}");
            ExitCode::SUCCESS
        }
        Err(report) => {
            eprintln!("{report}");
            ExitCode::FAILURE
        }
    }
}
