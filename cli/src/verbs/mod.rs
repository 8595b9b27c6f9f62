//! The verbs, one file each.

mod cancel;
mod coordinator;
mod dataset;
mod doctor;
mod download;
pub mod eval;
mod export;
mod inspect;
mod logs;
mod ls;
pub mod render;
mod show;
mod steer;
mod store;
mod submit;
mod synth;
mod tenant;
mod token;
mod train;
mod view;
mod watch;
mod worker;
mod workers;

use std::net::{SocketAddr, ToSocketAddrs as _};

use clap::{Args, Parser, Subcommand};
use fathom_observe::LogFormat;

#[cfg(test)]
pub use self::{coordinator::CoordinatorSettings, worker::WorkerSettings};
use crate::client::Client;
use crate::dial_args::{DialArgs, HEADING};
use crate::error::{CliError, Result};

/// The version and the commit that this program was built from.
const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("FATHOM_COMMIT"), ")");

/// Trains large underwater scenes as 3D Gaussians on as many machines as you have.
#[derive(Parser, Debug)]
#[command(name = "fathom", version = VERSION, about, max_term_width = 110)]
pub struct Fathom {
    /// Format of log lines on stderr: text, or json with one object per line
    #[arg(long, global = true, value_name = "FORMAT", env = "FATHOM_LOG_FORMAT", default_value = "text")]
    pub log_format: LogFormat,
    #[command(subcommand)]
    pub verb: Verb,
}

/// What to do.
#[derive(Subcommand, Debug)]
pub enum Verb {
    /// Train a scene on this machine: from photographs with poses to one model
    Train(train::TrainArgs),
    /// Run the coordinator of a service
    Coordinator(coordinator::CoordinatorArgs),
    /// Run a worker of a service, or list and manage its workers
    Worker(worker::WorkerArgs),
    /// Back up, restore and check the data of a coordinator
    Store(store::StoreArgs),
    /// Make, list and revoke the tokens of a service
    Token(token::TokenArgs),
    /// List the tenants of a service, and set their limits
    Tenant(tenant::TenantArgs),
    /// Submit a scene to a service
    Submit(submit::SubmitArgs),
    /// Upload scenes once, for any number of jobs
    Dataset(dataset::DatasetArgs),
    /// List the jobs of a service
    Ls(ls::LsArgs),
    /// Show one job with its tasks
    Show(show::ShowArgs),
    /// Follow a job to its end; exits with 0 only when it succeeded
    Watch(watch::WatchArgs),
    /// Show the log of a job from all its workers, in the order in which the lines arrived
    Logs(logs::LogsArgs),
    /// Stop a job
    Cancel(cancel::CancelArgs),
    /// Pause a job: its tasks are checkpointed and returned, and no task starts
    Pause(steer::PauseArgs),
    /// Continue a paused job
    Resume(steer::OneJob),
    /// Continue a failed job; finished tasks stay finished
    Retry(steer::OneJob),
    /// Change the priority of a job, or the number of tasks that it may run at a time
    Update(steer::UpdateArgs),
    /// Delete a job that has ended
    Delete(steer::OneJob),
    /// Download the files of a job that succeeded
    Download(download::DownloadArgs),
    /// Read a scene and draw its plan; trains nothing
    Inspect(inspect::InspectArgs),
    /// Measure a model on held-out photographs, or against ground truth
    Eval(eval::EvalArgs),
    /// Render a model from given cameras, along a path through them, or from around it
    Render(render::RenderArgs),
    /// Show a model in the browser, with the water that was trained
    View(view::ViewArgs),
    /// Write a model for other programs, or one page that shows it in a browser
    Export(export::ExportArgs),
    /// Make a synthetic scene with exact ground truth
    Synth(synth::SynthArgs),
    /// List the GPUs of this machine and what is missing
    Doctor(doctor::DoctorArgs),
}

impl Verb {
    /// Whether the verb runs until it is stopped.
    pub fn is_service(&self) -> bool {
        match self {
            Self::Coordinator(_) => true,
            Self::Worker(args) => args.is_service(),
            _ => false,
        }
    }

    /// Its name in traces.
    pub fn service(&self) -> &'static str {
        match self {
            Self::Coordinator(_) => "fathom-coordinator",
            Self::Worker(args) if args.is_service() => "fathom-worker",
            _ => "fathom",
        }
    }

    /// Runs the verb.
    pub fn run(self) -> Result<()> {
        match self {
            Self::Train(args) => block_on(train::run(args)),
            Self::Coordinator(args) => block_on(coordinator::run(args)),
            Self::Worker(args) => block_on(worker::run(args)),
            Self::Store(args) => block_on(store::run(args)),
            Self::Token(args) => block_on(token::run(args)),
            Self::Tenant(args) => block_on(tenant::run(args)),
            Self::Submit(args) => block_on(submit::run(args)),
            Self::Dataset(args) => block_on(dataset::run(args)),
            Self::Ls(args) => block_on(ls::run(args)),
            Self::Show(args) => block_on(show::run(args)),
            Self::Watch(args) => block_on(watch::run(args)),
            Self::Logs(args) => block_on(logs::run(args)),
            Self::Cancel(args) => block_on(cancel::run(args)),
            Self::Pause(args) => block_on(steer::pause(args)),
            Self::Resume(args) => block_on(steer::resume(args)),
            Self::Retry(args) => block_on(steer::retry(args)),
            Self::Update(args) => block_on(steer::update(args)),
            Self::Delete(args) => block_on(steer::delete(args)),
            Self::Download(args) => block_on(download::run(args)),
            Self::Inspect(args) => inspect::run(args),
            Self::Eval(args) => eval::run(args),
            Self::Render(args) => render::run(args),
            Self::View(args) => block_on(view::run(args)),
            Self::Export(args) => export::run(args),
            Self::Synth(args) => synth::run(args),
            Self::Doctor(args) => doctor::run(args),
        }
    }
}

/// The address of a service, and the connection to it.
#[derive(Args, Clone, Debug)]
pub struct ServiceArgs {
    /// URL of the coordinator, or several with commas between them: the first that answers is used, and the
    /// next one when it is lost
    #[arg(long, value_name = "URL", help_heading = HEADING)]
    #[arg(env = "FATHOM_COORDINATOR", default_value = "http://127.0.0.1:7420")]
    pub coordinator: String,
    #[command(flatten)]
    pub dial: DialArgs,
}

impl ServiceArgs {
    /// Connects.
    pub async fn client(&self) -> Result<Client> {
        Client::connect(&self.dial.dial(&self.coordinator)?).await
    }
}

/// Parses a command line without the variables of the tester's environment.
#[cfg(test)]
fn parsed(words: &[&str]) -> Verb {
    use clap::{CommandFactory as _, FromArgMatches as _};
    let alone = |verb: clap::Command| verb.mut_args(|arg| arg.env(clap::builder::Resettable::Reset));
    let command = Fathom::command().mut_subcommands(alone);
    let words = std::iter::once("fathom").chain(words.iter().copied());
    let parsed = command.try_get_matches_from(words).and_then(|matches| Fathom::from_arg_matches(&matches));
    parsed.unwrap_or_else(|error| panic!("{error}")).verb
}

/// An address to listen on: `10.0.0.1:7420`, `[::]:7420`, or a name of this machine in its place, such as
/// localhost.
fn parse_address(text: &str) -> std::result::Result<SocketAddr, String> {
    if let Ok(address) = text.parse() {
        return Ok(address);
    }
    let form =
        "use ADDRESS:PORT, such as 127.0.0.1:7420, 0.0.0.0:7420 for all addresses of IPv4, or localhost:7420";
    let has_port = text.rsplit_once(':').is_some_and(|(_, port)| port.parse::<u16>().is_ok());
    if !has_port {
        return Err(form.to_owned());
    }
    let found =
        text.to_socket_addrs().map_err(|error| format!("the name cannot be found ({error}); {form}"))?;
    let mut found: Vec<SocketAddr> = found.collect();
    // For a name with addresses of both kinds, clients try the one of IPv4 too.
    found.sort_by_key(SocketAddr::is_ipv6);
    found.first().copied().ok_or_else(|| format!("the name has no address; {form}"))
}

/// WIDTHxHEIGHT, pixels.
fn parse_size(text: &str) -> std::result::Result<(u32, u32), String> {
    let fault = || "use WIDTHxHEIGHT in pixels, such as 240x180".to_owned();
    let (width, height) = text.split_once(['x', 'X']).ok_or_else(fault)?;
    Ok((width.parse().map_err(|_| fault())?, height.parse().map_err(|_| fault())?))
}

fn block_on(work: impl Future<Output = Result<()>>) -> Result<()> {
    tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|error| CliError::Message(format!("cannot start the threads of this program: {error}")))?
        .block_on(work)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_to_listen_on_may_be_a_name() {
        assert_eq!(parse_address("localhost:7420"), Ok(SocketAddr::from(([127, 0, 0, 1], 7420))));
        assert_eq!(parse_address("[::]:0").map(|address| address.is_ipv6()), Ok(true));
        for wrong in ["localhost", "7420", "", "localhost:http", "127.0.0.1:70000"] {
            assert!(parse_address(wrong).is_err_and(|said| said.contains("use ADDRESS:PORT")), "{wrong}");
        }
    }
}
