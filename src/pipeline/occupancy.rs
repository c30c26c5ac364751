//! How many landmarks each part of the left image holds, so that new ones go where few are.

use crate::geometry::Camera;
use nalgebra::Vector2;

/// Cells across and down.
const COLUMNS: usize = 16;
const ROWS: usize = 12;

/// A count for each cell.
#[derive(Clone, Debug, Default)]
pub(super) struct Occupancy {
    counts: Vec<u32>,
    cells_per_px: Vector2<f64>,
}

impl Occupancy {
    /// Empties all cells, which share the camera's image.
    pub(super) fn begin(&mut self, camera: &Camera) {
        self.counts.clear();
        self.counts.resize(COLUMNS * ROWS, 0);
        self.cells_per_px = Vector2::new(
            COLUMNS as f64 / f64::from(camera.width),
            ROWS as f64 / f64::from(camera.height),
        );
    }

    /// Counts one at a position.
    pub(super) fn enter(&mut self, px: &Vector2<f64>) {
        let cell = self.cell(px);
        self.counts[cell] += 1;
    }

    /// How many there are around a position.
    pub(super) fn count(&self, px: &Vector2<f64>) -> u32 {
        self.counts[self.cell(px)]
    }

    fn cell(&self, px: &Vector2<f64>) -> usize {
        let at = (px + Vector2::repeat(0.5)).component_mul(&self.cells_per_px);
        // Positions outside count for the cell at the border.
        let column = (at.x.max(0.0) as usize).min(COLUMNS - 1);
        let row = (at.y.max(0.0) as usize).min(ROWS - 1);
        row * COLUMNS + column
    }
}
