//! The command line: one file a command.

mod attendant;
mod calibrate;
#[cfg(feature = "opencv")]
mod calibrate_live;
mod calibrate_views;
mod cameras;
mod check;
mod demo;
mod evaluate;
mod features;
#[cfg(feature = "ipc")]
mod health;
mod listen;
#[cfg(feature = "ipc")]
mod listen_view;
mod live;
mod metrics;
mod montecarlo;
mod progress;
mod record;
mod replay;
mod report;
mod rig;
mod rig_convert;
mod run;
mod session;
mod simulate;
mod summary;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// Stereo visual odometry that knows its own error.
#[derive(Parser)]
#[command(
    version,
    about,
    arg_required_else_help = true,
    after_help = "Example: visod demo"
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Demo(demo::Args),
    Run(run::Args),
    Replay(replay::Args),
    Record(record::Args),
    Simulate(Box<simulate::Args>),
    Listen(listen::Args),
    Evaluate(evaluate::Args),
    Report(report::Args),
    Features(features::Args),
    Montecarlo(Box<montecarlo::Args>),
    Calibrate(Box<calibrate::Args>),
    Rig(rig::Args),
    Cameras(cameras::Args),
    Check(check::Args),
}

/// Why a command did not do what it was asked to.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Failure {
    /// The command line, a configuration or a rig is wrong: exit code 2.
    Usage(String),
    /// Anything else: exit code 1.
    Other(String),
}

impl Failure {
    /// Bad usage or configuration, from anything that explains itself.
    pub(crate) fn usage(cause: impl std::fmt::Display) -> Self {
        Self::Usage(cause.to_string())
    }

    /// Any other failure, from anything that explains itself.
    pub(crate) fn other(cause: impl std::fmt::Display) -> Self {
        Self::Other(cause.to_string())
    }
}

/// The whole command line, for what is generated from it: manual pages and completions.
#[must_use]
pub fn command() -> clap::Command {
    <Cli as clap::CommandFactory>::command()
}

/// Runs the command line of this process. Exit code: 0 success, 2 bad usage or configuration, 1 any
/// other failure.
pub fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Demo(args) => demo::run(&args),
        Command::Run(args) => run::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Record(args) => record::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::Listen(args) => listen::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Features(args) => features::run(&args),
        Command::Montecarlo(args) => montecarlo::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Rig(args) => rig::run(&args),
        Command::Cameras(args) => cameras::run(&args),
        Command::Check(args) => check::run(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(Failure::Usage(cause)) => {
            eprintln!("visod: {cause}");
            ExitCode::from(2)
        }
        Err(Failure::Other(cause)) => {
            eprintln!("visod: {cause}");
            ExitCode::FAILURE
        }
    }
}
