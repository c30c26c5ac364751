//! How the command line behaves on a terminal.

use super::replay::stderr_of;
use std::process::{Command, Stdio};

#[test]
fn help_is_coloured_on_a_terminal_unless_told_otherwise() {
    let on_a_terminal = |no_color: Option<&str>| {
        let mut command = Command::new("script");
        command
            .args(["--quiet", "--return", "--command"])
            .arg(format!("{} listen --help", env!("CARGO_BIN_EXE_visod")))
            .arg("/dev/null")
            .env("TERM", "xterm-256color")
            .env_remove("NO_COLOR")
            .stdin(Stdio::null());
        if let Some(value) = no_color {
            command.env("NO_COLOR", value);
        }
        let output = command.output().unwrap();
        assert!(output.status.success(), "{}", stderr_of(&output));
        String::from_utf8(output.stdout).unwrap()
    };
    assert!(on_a_terminal(None).contains('\x1b'));
    assert!(!on_a_terminal(Some("1")).contains('\x1b'));
}
