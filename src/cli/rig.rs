//! `visod rig`: looks after calibration files.

use super::Failure;
use crate::geometry::{Finding, Severity, check_rig, load_rig};
use std::path::PathBuf;

/// Look after calibration files.
#[derive(clap::Args)]
#[command(after_help = "Example: visod rig check rig.toml")]
pub(crate) struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Subcommand)]
enum Command {
    /// Find what cannot be right in a rig file.
    #[command(after_help = "Example: visod rig check rig.toml")]
    Check {
        /// The rig file.
        rig: PathBuf,
        /// Print the findings as JSON.
        #[arg(long)]
        json: bool,
    },
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.command {
        Command::Check { rig, json } => check(rig, *json),
    }
}

/// Prints the findings; one of severity `error` makes the command fail as bad configuration does.
fn check(path: &std::path::Path, json: bool) -> Result<(), Failure> {
    let rig = load_rig(path).map_err(Failure::usage)?;
    let findings = check_rig(&rig);
    if json {
        let text = serde_json::to_string_pretty(&findings).map_err(Failure::other)?;
        println!("{text}");
    } else {
        findings.iter().for_each(print);
        if findings.is_empty() {
            println!(
                "{}: plausible: baseline {:.4} m, {}×{} and {}×{} px",
                path.display(),
                rig.baseline_m(),
                rig.left.width,
                rig.left.height,
                rig.right.width,
                rig.right.height
            );
        }
    }
    let errors = findings
        .iter()
        .filter(|f| f.severity == Severity::Error)
        .count();
    if errors > 0 {
        return Err(Failure::usage(format!(
            "{}: {errors} of its values cannot be right",
            path.display()
        )));
    }
    Ok(())
}

fn print(finding: &Finding) {
    let severity = match finding.severity {
        Severity::Warning => "warning",
        Severity::Error => "error",
    };
    println!("{severity}: {}: {}", finding.key, finding.message);
}
