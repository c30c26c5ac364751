//! What was seen of the board: views in, and the file that they can be kept in.

use super::Board;
use crate::text_file::shown;
use nalgebra::Vector2;
use std::collections::BTreeMap;
use std::fmt::Write as _;

/// Where one camera saw the points of a board, px, raw; `None` for points that it did not see.
pub type SeenPoints = Vec<Option<Vector2<f64>>>;

/// One placement of the board, seen by one camera or both at the same instant.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// What it is called in messages: the images' name.
    pub name: String,
    /// What the left and the right camera saw; `None` where that camera did not see the board.
    pub seen: [Option<SeenPoints>; 2],
}

impl View {
    /// How many points a camera (0 left, 1 right) saw.
    #[must_use]
    pub fn count(&self, side: usize) -> usize {
        self.seen[side]
            .as_ref()
            .map_or(0, |seen| seen.iter().flatten().count())
    }

    /// The points that a camera saw, with their numbers.
    pub fn points(&self, side: usize) -> impl Iterator<Item = (usize, Vector2<f64>)> {
        let seen = self.seen[side].iter().flatten().enumerate();
        seen.filter_map(|(i, point)| point.map(|point| (i, point)))
    }
}

const HEADER: &str = "view,side,point,x_px,y_px";

/// Views as CSV: a line a point, `view,side,point,x_px,y_px`, side `left` or `right`, points counted from 0, row by
/// row. [`views_from_csv`] reads them back to the last bit.
#[must_use]
pub fn views_to_csv(views: &[View]) -> String {
    let mut out = format!("{HEADER}\n");
    for view in views {
        for (side, name) in ["left", "right"].iter().enumerate() {
            for (point, at) in view.points(side) {
                // Writing to a `String` cannot fail.
                let _ = writeln!(
                    out,
                    "{},{name},{point},{},{}",
                    quoted(&view.name),
                    at.x,
                    at.y
                );
            }
        }
    }
    out
}

fn quoted(name: &str) -> String {
    if name.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", name.replace('"', "\"\""))
    } else {
        name.to_owned()
    }
}

/// Most views that are read: each takes room for every point of the board, however few it saw.
const MOST_VIEWS: usize = 1000;

/// Reads what [`views_to_csv`] writes; views keep the order in which they first stand.
///
/// # Errors
/// One sentence with the line: not that header, a side that is neither, a point that the board has not or that
/// stands twice, or a position that is no finite number.
pub fn views_from_csv(text: &str, board: &Board) -> Result<Vec<View>, String> {
    let mut reader = csv::ReaderBuilder::new().from_reader(text.as_bytes());
    let header = reader.headers().map_err(|e| e.to_string())?;
    if header.iter().map(str::trim).ne(HEADER.split(',')) {
        return Err(format!("1: must begin with the line {HEADER:?}"));
    }
    let mut views: Vec<View> = Vec::new();
    let mut places = BTreeMap::new();
    for record in reader.records() {
        let record = record.map_err(|e| e.to_string())?;
        let line = record.position().map_or(0, csv::Position::line);
        let fail = |cause: String| format!("{line}: {cause}");
        let (side, point, at) = entry(&record, board).map_err(fail)?;
        if views.len() >= MOST_VIEWS && !places.contains_key(&record[0]) {
            return Err(fail(format!("more than {MOST_VIEWS} views are not taken")));
        }
        let place = *places.entry(record[0].to_owned()).or_insert_with(|| {
            views.push(View {
                name: record[0].to_owned(),
                seen: [None, None],
            });
            views.len() - 1
        });
        let seen = views[place].seen[side].get_or_insert_with(|| vec![None; board.len()]);
        if seen[point].replace(at).is_some() {
            return Err(fail(format!(
                "point {point} of this side of view \"{}\" stands twice",
                shown(&record[0])
            )));
        }
    }
    Ok(views)
}

fn entry(
    record: &csv::StringRecord,
    board: &Board,
) -> Result<(usize, usize, Vector2<f64>), String> {
    let side = match &record[1] {
        "left" => 0,
        "right" => 1,
        other => {
            let shown = shown(other);
            return Err(format!("side must be left or right, but is \"{shown}\""));
        }
    };
    let point = match record[2].parse::<usize>() {
        Ok(point) if point < board.len() => point,
        _ => {
            return Err(format!(
                "\"{}\" is no point of a board with {} × {} points, numbered from 0",
                shown(&record[2]),
                board.columns,
                board.rows
            ));
        }
    };
    let number = |word: &str| match word.trim().parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(format!("\"{}\" is no position in px", shown(word))),
    };
    Ok((
        side,
        point,
        Vector2::new(number(&record[3])?, number(&record[4])?),
    ))
}

#[cfg(test)]
mod tests {
    use super::super::Pattern;
    use super::*;

    const BOARD: Board = Board {
        pattern: Pattern::Chessboard,
        columns: 4,
        rows: 3,
        square_m: 0.03,
        sigma_square_m: 0.0,
    };

    #[test]
    fn more_views_than_have_room_are_refused() {
        let line = |n: usize| format!("v{n},left,0,1,2\n");
        let lines: String = (0..MOST_VIEWS).map(line).collect();
        let text = format!("{HEADER}\n{lines}");
        let views = views_from_csv(&text, &BOARD).expect("as many as may be");
        assert_eq!(views.len(), MOST_VIEWS);
        let why = views_from_csv(&(text + &line(MOST_VIEWS)), &BOARD).expect_err("one more");
        assert_eq!(why, "1002: more than 1000 views are not taken");
    }

    #[test]
    fn views_read_back_as_they_were_written() {
        let seen = |shift: f64| -> SeenPoints {
            (0..12)
                .map(|i| (i != 5).then(|| Vector2::new(shift + f64::from(i) / 3.0, 7.25)))
                .collect()
        };
        let views = vec![
            View {
                name: "b, 2.png".to_owned(),
                seen: [Some(seen(1.0)), Some(seen(0.1))],
            },
            View {
                name: "a.png".to_owned(),
                seen: [None, Some(seen(3.0))],
            },
        ];
        assert_eq!(views_from_csv(&views_to_csv(&views), &BOARD), Ok(views));
    }

    #[test]
    fn mistakes_are_named_with_their_line() {
        let error =
            |rows: &str| views_from_csv(&format!("{HEADER}\n{rows}"), &BOARD).expect_err("wrong");
        assert_eq!(
            error("a,left,0,1,2\na,up,1,2,3"),
            "3: side must be left or right, but is \"up\""
        );
        assert!(error("a,left,12,1,2").starts_with("2: \"12\" is no point of a board with 4 × 3"));
        assert_eq!(error("a,left,1,nan,2"), "2: \"nan\" is no position in px");
        assert!(error("a,left,1,1,2\na,left,1,1,2").contains("stands twice"));
        assert!(
            views_from_csv("x,y\n", &BOARD)
                .expect_err("wrong")
                .starts_with("1: must begin")
        );
    }
}
