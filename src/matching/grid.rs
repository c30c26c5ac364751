//! A grid over the image: numbered points in, those near a place out, without looking at all.

use nalgebra::Vector2;

/// Side of a grid cell, px.
const CELL_PX: f32 = 32.0;

/// Numbered points sorted into the cells of a grid.
#[derive(Debug, Default)]
pub(super) struct Grid {
    columns: i32,
    rows: i32,
    /// Where each cell's points start in `points`; one more entry than cells.
    starts: Vec<u32>,
    points: Vec<(u32, f32, f32)>,
    /// The points as they were given.
    in_order: Vec<(u32, f32, f32)>,
}

impl Grid {
    /// Sorts points in; the n-th is numbered n.
    pub(super) fn fill(&mut self, points: impl Iterator<Item = (u32, f32, f32)>) {
        self.in_order.clear();
        self.in_order.extend(points);
        let extent = |get: fn(&(u32, f32, f32)) -> f32| {
            let max = self.in_order.iter().map(get).fold(0.0_f32, f32::max);
            (max / CELL_PX) as i32 + 1
        };
        self.columns = extent(|p| p.1);
        self.rows = extent(|p| p.2);
        // Counting sort: points of a cell stay in their given order.
        self.starts.clear();
        self.starts
            .resize((self.columns * self.rows) as usize + 1, 0);
        for p in &self.in_order {
            self.starts[cell_of(self.columns, p) + 1] += 1;
        }
        for c in 1..self.starts.len() {
            self.starts[c] += self.starts[c - 1];
        }
        self.points.clear();
        self.points.resize(self.in_order.len(), (0, 0.0, 0.0));
        for p in &self.in_order {
            let slot = &mut self.starts[cell_of(self.columns, p)];
            self.points[*slot as usize] = *p;
            *slot += 1;
        }
        // Each start has moved to its cell's end, which is the next cell's start: shift back.
        self.starts.rotate_right(1);
        self.starts[0] = 0;
    }

    /// Calls `visit` with the number of each point within `radius_px` of a place.
    pub(super) fn for_each_near(
        &self,
        at: &Vector2<f64>,
        radius_px: f64,
        mut visit: impl FnMut(u32),
    ) {
        let cell = |v: f64| (v as f32 / CELL_PX).floor() as i32;
        let columns = cell(at.x - radius_px).max(0)..=cell(at.x + radius_px).min(self.columns - 1);
        for row in cell(at.y - radius_px).max(0)..=cell(at.y + radius_px).min(self.rows - 1) {
            for column in columns.clone() {
                let c = (row * self.columns + column) as usize;
                for &(n, x, y) in &self.points[self.starts[c] as usize..self.starts[c + 1] as usize]
                {
                    if within(x, y, at, radius_px) {
                        visit(n);
                    }
                }
            }
        }
    }

    /// Whether the point numbered `n` lies within `radius_px` of a place.
    #[cfg(any(test, feature = "opencv"))]
    pub(super) fn is_near(&self, n: u32, at: &Vector2<f64>, radius_px: f64) -> bool {
        let (_, x, y) = self.in_order[n as usize];
        within(x, y, at, radius_px)
    }
}

fn within(x: f32, y: f32, at: &Vector2<f64>, radius_px: f64) -> bool {
    let offset = Vector2::new(f64::from(x), f64::from(y)) - at;
    offset.norm_squared() <= radius_px * radius_px
}

fn cell_of(columns: i32, point: &(u32, f32, f32)) -> usize {
    let column = (point.1.max(0.0) / CELL_PX) as i32;
    let row = (point.2.max(0.0) / CELL_PX) as i32;
    (row * columns + column) as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn grid_finds_what_a_plain_scan_finds(
            points in prop::collection::vec((0.0..640.0_f32, 0.0..480.0_f32), 0..200),
            x in -50.0..700.0_f64, y in -50.0..530.0_f64, radius in 0.0..200.0_f64,
        ) {
            let mut grid = Grid::default();
            grid.fill(points.iter().enumerate().map(|(i, p)| (i as u32, p.0, p.1)));
            let at = Vector2::new(x, y);
            let mut found = Vec::new();
            grid.for_each_near(&at, radius, |n| found.push(n));
            found.sort_unstable();
            let plain: Vec<u32> = (0..points.len() as u32)
                .filter(|&i| {
                    let p = points[i as usize];
                    (Vector2::new(f64::from(p.0), f64::from(p.1)) - at).norm_squared() <= radius * radius
                })
                .collect();
            prop_assert_eq!(&found, &plain);
            let near: Vec<u32> = (0..points.len() as u32)
                .filter(|&n| grid.is_near(n, &at, radius))
                .collect();
            prop_assert_eq!(near, plain);
        }
    }
}
