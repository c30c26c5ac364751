//! Extrema of the fast Hessian: an integral image in, keypoints with place, size and strength out.
//!
//! An octave samples every 2ⁿ-th pixel with `layers + 2` filters. A sample is a keypoint if its
//! determinant is above the threshold and above all 26 neighbours in row, column and layer; a
//! quadratic through these 27 then gives place and size between the samples (Brown and Lowe,
//! *Invariant Features from Interest Point Groups*, 2002), and a candidate whose top lies more than
//! one sample away is none.
//!
//! The lowest and the highest layer of an octave hold no keypoints, so they are computed where a
//! sample of the layer beside them is the highest so far, and nowhere else. Of the other layers
//! only three rows are ever held.

use super::Keypoint;
use super::hessian::{Combined, Filter};
use super::integral::{IntegralImage, SortedColumns};
use super::simd::widened;

/// Samples that are looked at together before any of them is looked at closely.
const GROUP: usize = 16;

/// What is searched for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Search {
    /// Number of octaves.
    pub octaves: u32,
    /// Layers of an octave in which keypoints may lie.
    pub layers: usize,
    /// The determinant that a keypoint exceeds.
    pub threshold: f32,
}

/// The search with its working memory, above all the last three rows of determinants of every
/// inner layer of an octave.
#[derive(Debug, Default)]
pub(super) struct Detector {
    columns: SortedColumns,
    combined: Combined,
    candidates: Vec<usize>,
    filters: Vec<Filter>,
    samples: usize,
    /// Row by row of each layer but the lowest and the highest.
    determinants: Vec<f32>,
}

/// The samples around one in a layer: `values[row][column]`.
type Layer = [[f32; 3]; 3];

impl Detector {
    /// Appends the keypoints to `keypoints`, without direction and σ, octave by octave, row by row.
    pub(super) fn detect(
        &mut self,
        integral: &IntegralImage,
        search: Search,
        keypoints: &mut Vec<Keypoint>,
    ) {
        self.columns.begin(integral, search.octaves - 1);
        for octave in 0..search.octaves {
            self.filters.clear();
            let filters = (0..search.layers + 2).map(|layer| Filter::new(octave, layer));
            self.filters
                .extend(filters.take_while(|f| f.fits(integral)));
            if self.filters.len() < 3 {
                break;
            }
            if octave > 0 {
                self.columns.double_step(integral);
            }
            self.detect_in_octave(integral, search.threshold, octave, keypoints);
        }
    }

    fn detect_in_octave(
        &mut self,
        integral: &IntegralImage,
        threshold: f32,
        octave: u32,
        keypoints: &mut Vec<Keypoint>,
    ) {
        self.samples = integral.width() >> octave;
        self.determinants
            .resize((self.filters.len() - 2) * 3 * self.samples, 0.0);
        for row in 0..integral.height() >> octave {
            for layer in 1..self.filters.len() - 1 {
                let filter = &self.filters[layer];
                if filter.samples(integral, row) > 0 {
                    let start = self.start(layer, row);
                    let out = &mut self.determinants[start..][..self.samples];
                    filter.respond(integral, &self.columns, row, &mut self.combined, out);
                }
            }
            let Some(centre) = row.checked_sub(1) else {
                continue;
            };
            for layer in 1..self.filters.len() - 1 {
                self.search_row(integral, threshold, (octave, layer, centre), keypoints);
            }
        }
    }

    /// Searches row `centre` of a layer; the row below it is the last one computed.
    fn search_row(
        &mut self,
        integral: &IntegralImage,
        threshold: f32,
        (octave, layer, centre): (u32, usize, usize),
        keypoints: &mut Vec<Keypoint>,
    ) {
        // All neighbours must be complete, which the layer above decides.
        let margin = self.filters[layer + 1].margin() + 1;
        let rows = integral.height() >> octave;
        if centre < margin || centre + margin >= rows || 2 * margin >= self.samples {
            return;
        }
        let mut candidates = std::mem::take(&mut self.candidates);
        candidates.clear();
        let near = [centre - 1, centre, centre + 1].map(|row| self.row(layer, row));
        let columns = margin..self.samples - margin;
        find_candidates(&near, threshold, columns, &mut candidates);
        for &column in &candidates {
            let Some(layers) = self.layers_around(integral, (layer, centre, column)) else {
                continue;
            };
            if let Some(offset) = top_of_quadratic(&layers) {
                let filter = &self.filters[layer];
                keypoints.push(Keypoint {
                    response: layers[1][1][1],
                    octave: octave as i32,
                    laplacian: filter.laplacian_sign(integral, centre, column),
                    ..self.place(layer, (column, centre), offset)
                });
            }
        }
        self.candidates = candidates;
    }

    /// Where row `row` of an inner layer starts among the determinants.
    fn start(&self, layer: usize, row: usize) -> usize {
        ((layer - 1) * 3 + row % 3) * self.samples
    }

    /// A row of an inner layer, one of the last three.
    fn row(&self, layer: usize, row: usize) -> &[f32] {
        &self.determinants[self.start(layer, row)..][..self.samples]
    }

    /// The samples around one that exceeds its neighbours in its own layer; `None` unless it exceeds
    /// those in the layers beside it, too.
    fn layers_around(
        &self,
        integral: &IntegralImage,
        (layer, row, column): (usize, usize, usize),
    ) -> Option<[Layer; 3]> {
        let mut layers = [[[0.0; 3]; 3]; 3];
        self.held(layer, row, column, &mut layers[1]);
        let value = layers[1][1][1];
        let is_held = |layer| (1..self.filters.len() - 1).contains(&layer);
        // What costs nothing first.
        for held in [true, false] {
            for beside in [0, 2] {
                let (at, values) = (layer + beside - 1, &mut layers[beside]);
                if is_held(at) != held {
                    continue;
                }
                let is_exceeded = if held {
                    self.held(at, row, column, values);
                    values.as_flattened().iter().all(|&other| value > other)
                } else {
                    self.computed_while_below(value, integral, (at, row, column), values)
                };
                if !is_exceeded {
                    return None;
                }
            }
        }
        Some(layers)
    }

    /// Copies the samples around one of an inner layer.
    fn held(&self, layer: usize, row: usize, column: usize, values: &mut Layer) {
        for (values, row) in values.iter_mut().zip(row - 1..) {
            values.copy_from_slice(&self.row(layer, row)[column - 1..][..3]);
        }
    }

    /// Computes the samples around one, and says whether all are below `value`; stops at the first
    /// that is not. The middle one, most often the highest, comes first.
    fn computed_while_below(
        &self,
        value: f32,
        integral: &IntegralImage,
        (layer, row, column): (usize, usize, usize),
        values: &mut Layer,
    ) -> bool {
        let filter = &self.filters[layer];
        [4, 1, 3, 5, 7, 0, 2, 6, 8].into_iter().all(|n| {
            let (y, x) = (n / 3, n % 3);
            values[y][x] = filter.determinant(integral, row + y - 1, column + x - 1);
            value > values[y][x]
        })
    }

    /// Place and size of the keypoint `offset` samples from sample `(column, row)` of `layer`.
    fn place(&self, layer: usize, (column, row): (usize, usize), offset: [f32; 3]) -> Keypoint {
        let filter = &self.filters[layer];
        let step_px = filter.step_px as f32;
        let layer_step_px = (filter.size_px - self.filters[layer - 1].size_px) as f32;
        // The middle of the filter, which has an even number of pixels from the second octave on.
        let middle_px = |sample: usize| (sample as f32 + 0.5) * step_px - 0.5;
        Keypoint {
            x_px: middle_px(column) + offset[0] * step_px,
            y_px: middle_px(row) + offset[1] * step_px,
            size_px: (filter.size_px as f32 + offset[2] * layer_step_px).round_ties_even(),
            ..Keypoint::default()
        }
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.columns.capacity()
            + self.combined.capacity()
            + self.candidates.capacity()
            + self.filters.capacity()
            + self.determinants.capacity()
    }
}

widened! {
    /// Appends every column that exceeds the threshold and its eight neighbours to `found`.
    fn find_candidates = find_candidates_narrow, (
        rows: &[&[f32]; 3],
        threshold: f32,
        columns: std::ops::Range<usize>,
        found: &mut Vec<usize>,
    )
}

#[inline(always)]
fn find_candidates_narrow(
    rows: &[&[f32]; 3],
    threshold: f32,
    columns: std::ops::Range<usize>,
    found: &mut Vec<usize>,
) {
    let [above, here, below] = *rows;
    let mut at = columns.start;
    while at + GROUP <= columns.end {
        let up = &above[at - 1..][..GROUP + 2];
        let v = &here[at - 1..][..GROUP + 2];
        let down = &below[at - 1..][..GROUP + 2];
        // No branch until a whole group is done with.
        let mut is_hit = [0_u8; GROUP];
        for t in 0..GROUP {
            let corners = higher(higher(up[t], up[t + 2]), higher(down[t], down[t + 2]));
            let sides = higher(higher(v[t], v[t + 2]), higher(up[t + 1], down[t + 1]));
            is_hit[t] = u8::from(v[t + 1] > higher(threshold, higher(sides, corners)));
        }
        let mut hits = u128::from_le_bytes(is_hit);
        while hits != 0 {
            found.push(at + (hits.trailing_zeros() / 8) as usize);
            hits &= hits - 1;
        }
        at += GROUP;
    }
    for at in at..columns.end {
        let ends = rows.iter().flat_map(|row| [row[at - 1], row[at + 1]]);
        let bar = ends.chain([above[at], below[at]]).fold(threshold, higher);
        if here[at] > bar {
            found.push(at);
        }
    }
}

/// The higher of two determinants, none of which is ever NaN.
#[inline(always)]
fn higher(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Where the quadratic through the 27 samples has its top: column, row, layer, in samples from the
/// middle one. `None` if it has none within one sample of it.
fn top_of_quadratic(layers: &[Layer; 3]) -> Option<[f32; 3]> {
    let v = |x: usize, y: usize, s: usize| f64::from(layers[s][y][x]);
    let gradient = [
        0.5 * (v(2, 1, 1) - v(0, 1, 1)),
        0.5 * (v(1, 2, 1) - v(1, 0, 1)),
        0.5 * (v(1, 1, 2) - v(1, 1, 0)),
    ];
    let twice = 2.0 * v(1, 1, 1);
    let xx = v(0, 1, 1) - twice + v(2, 1, 1);
    let yy = v(1, 0, 1) - twice + v(1, 2, 1);
    let ss = v(1, 1, 0) - twice + v(1, 1, 2);
    let xy = 0.25 * (v(2, 2, 1) - v(0, 2, 1) - v(2, 0, 1) + v(0, 0, 1));
    let xs = 0.25 * (v(2, 1, 2) - v(0, 1, 2) - v(2, 1, 0) + v(0, 1, 0));
    let ys = 0.25 * (v(1, 2, 2) - v(1, 0, 2) - v(1, 2, 0) + v(1, 0, 0));
    let curvature = nalgebra::Matrix3::new(xx, xy, xs, xy, yy, ys, xs, ys, ss);
    let offset = -(curvature.try_inverse()? * nalgebra::Vector3::from(gradient));
    let inside = offset.iter().all(|o| o.abs() <= 1.0) && offset.iter().any(|&o| o != 0.0);
    inside.then(|| offset.map(|o| o as f32).into())
}
