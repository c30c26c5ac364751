//! The board: where its corners (or circles) lie, and how well its size is known.

use crate::settings::SettingError;
use nalgebra::{Point3, Vector2};

/// What is printed on a board.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pattern {
    /// Black and white squares; the points are the inner corners.
    #[default]
    Chessboard,
    /// Dots in rows and columns; the points are their centres.
    Circles,
    /// Dots whose every second row is shifted by half their distance within a row.
    AsymmetricCircles,
}

/// A flat calibration board. Its points lie in its own plane z = 0, row by row, the first one in the origin.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Board {
    /// What is printed on it.
    pub pattern: Pattern,
    /// Points in a row.
    pub columns: u32,
    /// Rows of points.
    pub rows: u32,
    /// The side of a square, or the distance of neighbouring circles, m; of asymmetric circles the distance of
    /// neighbouring rows, half of that within a row.
    pub square_m: f64,
    /// 1 σ of that length, m: of the mean over the board, as a ruler along it measures.
    pub sigma_square_m: f64,
}

/// Fewest points along either side of a board: with fewer, one view says nothing of the lens.
const LEAST_SIDE: u32 = 3;
/// Most points along either side.
const MOST_SIDE: u32 = 100;

impl Board {
    /// Refuses what no board can be.
    ///
    /// # Errors
    /// The first value that lies out of its range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("columns", self.columns, LEAST_SIDE..=MOST_SIDE)?;
        SettingError::unless_in("rows", self.rows, LEAST_SIDE..=MOST_SIDE)?;
        SettingError::unless_in("square_m", self.square_m, 1e-6..=1000.0)?;
        SettingError::unless_in("sigma_square_m", self.sigma_square_m, 0.0..=self.square_m)
    }

    /// How many points it has.
    #[must_use]
    pub fn len(&self) -> usize {
        self.columns as usize * self.rows as usize
    }

    /// Whether it has no points.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// A point of the board by its number, m.
    #[must_use]
    pub fn point(&self, index: usize) -> Point3<f64> {
        let columns = self.columns.max(1) as usize;
        let (row, column) = (index / columns, index % columns);
        let x = match self.pattern {
            Pattern::AsymmetricCircles => 2 * column + row % 2,
            _ => column,
        };
        Point3::new(x as f64 * self.square_m, row as f64 * self.square_m, 0.0)
    }

    /// All points, m.
    #[must_use]
    pub fn points(&self) -> Vec<Point3<f64>> {
        (0..self.len()).map(|i| self.point(i)).collect()
    }

    /// Brings the points that one camera found into the order in which the other found them: a board looks
    /// the same (or nearly so) from other sides, and where a search begins is not certain.
    ///
    /// The cameras of a rig stand side by side and both upright, so that the board's image is nearly the same
    /// in both: of the orders that the board's symmetry allows, that of the least difference is right.
    #[must_use]
    pub fn in_order_of(
        &self,
        reference: &[Vector2<f64>],
        found: &[Vector2<f64>],
    ) -> Vec<Vector2<f64>> {
        let wanted = about_centre(reference);
        self.symmetries()
            .into_iter()
            .map(|order| order.iter().map(|&i| found[i]).collect::<Vec<_>>())
            .min_by(|a, b| {
                let gap = |points: &[Vector2<f64>]| -> f64 {
                    let here = about_centre(points);
                    here.iter()
                        .zip(&wanted)
                        .map(|(p, q)| (p - q).norm_squared())
                        .sum()
                };
                gap(a).total_cmp(&gap(b))
            })
            .unwrap_or_default()
    }

    /// The orders of its points that look like another placement of the board.
    fn symmetries(&self) -> Vec<Vec<usize>> {
        let (columns, rows) = (self.columns as usize, self.rows as usize);
        let order = |place: &dyn Fn(usize, usize) -> (usize, usize)| -> Vec<usize> {
            (0..rows)
                .flat_map(|row| (0..columns).map(move |column| (row, column)))
                .map(|(row, column)| {
                    let (row, column) = place(row, column);
                    row * columns + column
                })
                .collect()
        };
        let turned = |r: usize, c: usize| (rows - 1 - r, columns - 1 - c);
        let mut all = vec![order(&|r, c| (r, c)), order(&turned)];
        if self.pattern == Pattern::AsymmetricCircles {
            // A half turn maps the grid to itself only where the last row is shifted and the first is not.
            if rows % 2 == 1 {
                all.truncate(1);
            }
            return all;
        }
        all.push(order(&|r, c| (rows - 1 - r, c)));
        all.push(order(&|r, c| (r, columns - 1 - c)));
        if rows == columns {
            all.push(order(&|r, c| (c, r)));
            all.push(order(&|r, c| (c, rows - 1 - r)));
            all.push(order(&|r, c| (columns - 1 - c, r)));
            all.push(order(&|r, c| (columns - 1 - c, rows - 1 - r)));
        }
        all
    }
}

fn about_centre(points: &[Vector2<f64>]) -> Vec<Vector2<f64>> {
    let sum: Vector2<f64> = points.iter().sum();
    let centre = sum / points.len().max(1) as f64;
    points.iter().map(|p| p - centre).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn board(pattern: Pattern, columns: u32, rows: u32) -> Board {
        Board {
            pattern,
            columns,
            rows,
            square_m: 0.03,
            sigma_square_m: 0.0,
        }
    }

    #[test]
    fn points_lie_row_by_row() {
        let chessboard = board(Pattern::Chessboard, 9, 6);
        assert_eq!(chessboard.len(), 54);
        assert!((chessboard.point(10) - Point3::new(0.03, 0.03, 0.0)).norm() < 1e-15);
        let circles = board(Pattern::AsymmetricCircles, 4, 11);
        assert!((circles.point(5) - Point3::new(0.09, 0.03, 0.0)).norm() < 1e-15);
    }

    #[test]
    fn points_found_in_another_order_are_brought_into_that_of_the_reference() {
        for (columns, rows) in [(9, 6), (7, 7)] {
            let board = board(Pattern::Chessboard, columns, rows);
            let left: Vec<_> = board
                .points()
                .iter()
                .map(|p| Vector2::new(100.0 + 900.0 * p.x, 80.0 + 850.0 * p.y + 30.0 * p.x))
                .collect();
            // The right camera sees the same, shifted by a disparity.
            let right: Vec<_> = left.iter().map(|p| p - Vector2::new(40.0, 3.0)).collect();
            for order in board.symmetries() {
                let found: Vec<_> = order.iter().map(|&i| right[i]).collect();
                assert_eq!(board.in_order_of(&left, &found), right);
            }
        }
    }

    #[test]
    fn what_is_no_board_is_refused() {
        let mut wrong = board(Pattern::Chessboard, 9, 2);
        assert_eq!(wrong.check().unwrap_err().key, "rows");
        wrong.rows = 6;
        wrong.square_m = f64::NAN;
        assert_eq!(wrong.check().unwrap_err().key, "square_m");
    }
}
