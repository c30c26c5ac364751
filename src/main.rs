//! The `visod` command.

fn main() -> std::process::ExitCode {
    visod::cli::main()
}
