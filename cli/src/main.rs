//! `fathom`: trains large underwater scenes as 3D Gaussians on one or many machines.
//!
//! One binary is the command line, the coordinator and the worker. Results go to stdout, progress and errors
//! to stderr. A failure exits with 1 (2 for wrong usage, 130 for an interruption). Its message is one
//! sentence: what happened, where, and what to do.

mod against_truth;
mod blob;
mod children;
mod client;
mod config_args;
mod dial_args;
mod download;
mod error;
mod eval_summary;
#[cfg(test)]
mod fuzz;
mod handover;
mod maps;
mod model;
mod open_water;
mod output;
mod photographs;
mod progress;
mod seams;
mod settings;
mod upload;
mod verbs;
mod viewed;
mod water_region;
mod white_point;

use std::process::ExitCode;

use clap::Parser;
use fathom_observe::Logging;

fn main() -> ExitCode {
    if std::env::var_os("XDG_RUNTIME_DIR").is_none() {
        // Mesa's device-select layer looks for a Wayland display and complains on stderr in every container.
        // SAFETY: nothing else runs yet; the environment is changed before the first thread is started.
        unsafe { std::env::set_var("NODEVICE_SELECT", "1") };
    }
    let fathom = verbs::Fathom::parse();
    // Children write to log files; users see only warnings, unless RUST_LOG or FATHOM_LOG asks for more.
    let level = if fathom.verb.is_service() { "info" } else { "warn" };
    let _log = fathom_observe::init(&Logging {
        format: fathom.log_format,
        default_filter: format!(
            "{level},wgpu_core=warn,wgpu_hal=error,naga=warn,sled=warn,sqlx=warn,sqlx_core=warn"
        ),
        captures: fathom.verb.is_service(),
        service: fathom.verb.service(),
    });
    match fathom.verb.run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            output::remark(format!("fathom: {error}"));
            ExitCode::from(error.exit_code())
        }
    }
}
