//! The command line in; its manual pages and the completions of shells out, so that neither can drift from
//! what the program takes. `tools/package` puts them into the Debian package.

use clap_complete::{Shell, generate_to};
use std::io;
use std::path::Path;
use std::process::ExitCode;

fn write(folder: &Path) -> io::Result<()> {
    let pages = folder.join("man");
    std::fs::create_dir_all(&pages)?;
    clap_mangen::generate_to(visod::cli::command(), &pages)?;
    for shell in [Shell::Bash, Shell::Fish, Shell::Zsh] {
        generate_to(shell, &mut visod::cli::command(), "visod", folder)?;
    }
    Ok(())
}

fn main() -> ExitCode {
    let Some(folder) = std::env::args_os().nth(1) else {
        eprintln!("usage: manual FOLDER");
        return ExitCode::from(2);
    };
    match write(Path::new(&folder)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("manual: {}: {e}", Path::new(&folder).display());
            ExitCode::FAILURE
        }
    }
}
