//! Odometry CSV.

use super::sentence;
use std::path::Path;
use visod::output::csv::{header_line, parse_odometry_csv, push_row};

/// Any bytes are rows, which are written so that they read back, or refused.
pub fn run(data: &[u8]) {
    let name = Path::new("odometry.csv");
    match parse_odometry_csv(name, data) {
        Ok(rows) => {
            let mut written = header_line();
            if !written.ends_with('\n') {
                written.push('\n');
            }
            for row in &rows {
                push_row(&mut written, row);
                if !written.ends_with('\n') {
                    written.push('\n');
                }
            }
            let again =
                parse_odometry_csv(name, written.as_bytes()).expect("what was written is read");
            assert_eq!(again.len(), rows.len());
        }
        Err(why) => sentence::check(&why.to_string()),
    }
}
