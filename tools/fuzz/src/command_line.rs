//! The command line.

/// Any lines are the arguments of a command, or refused.
pub fn run(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else {
        return;
    };
    let arguments = ["visod"].into_iter().chain(text.lines());
    if let Err(why) = visod::cli::command().try_get_matches_from(arguments) {
        assert!(!why.to_string().is_empty());
    }
}
