//! Points of a calibration board that were found elsewhere.

use super::sentence;
use visod::calibration::{Board, Pattern, views_from_csv, views_to_csv};

/// Any text is a list of views, which is written so that it reads back, or refused.
pub fn run(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else {
        return;
    };
    let board = Board {
        pattern: Pattern::Chessboard,
        columns: 100,
        rows: 100,
        square_m: 0.025,
        sigma_square_m: 0.0,
    };
    match views_from_csv(text, &board) {
        Ok(views) => {
            let written = views_to_csv(&views);
            let again = views_from_csv(&written, &board).expect("what was written is read");
            assert_eq!(again.len(), views.len());
        }
        Err(why) => sentence::check(&why),
    }
}
