//! Extrema of the fast Hessian: an integral image in, keypoints with place, size and strength out.
//!
//! An octave samples every 2ⁿ-th pixel with `layers + 2` filters. A sample is a keypoint if its
//! determinant is above the threshold and above all 26 neighbours in row, column and layer; a
//! quadratic through these 27 then gives place and size between the samples (Brown and Lowe,
//! *Invariant Features from Interest Point Groups*, 2002), and a candidate whose top lies more than
//! one sample away is none. Only three rows of each layer are ever held.

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

/// The search with its working memory, above all the last three rows of determinants of every layer
/// of an octave.
#[derive(Debug, Default)]
pub(super) struct Detector {
    columns: SortedColumns,
    combined: Combined,
    candidates: Vec<usize>,
    filters: Vec<Filter>,
    samples: usize,
    determinants: Vec<f32>,
}

/// The three rows around a sample in three neighbouring layers: `rows[layer][row]`.
type Neighbourhood<'a> = [[&'a [f32]; 3]; 3];

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
            .resize(self.filters.len() * 3 * self.samples, 0.0);
        for row in 0..integral.height() >> octave {
            for (layer, filter) in self.filters.iter().enumerate() {
                if filter.samples(integral, row) > 0 {
                    let start = (layer * 3 + row % 3) * self.samples;
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
        let near = self.neighbourhood(layer, centre);
        let columns = margin..self.samples - margin;
        find_candidates(&near[1], threshold, columns, &mut candidates);
        for &column in &candidates {
            if !is_highest(&near, column) {
                continue;
            }
            if let Some(offset) = top_of_quadratic(&near, column) {
                let filter = &self.filters[layer];
                keypoints.push(Keypoint {
                    response: near[1][1][column],
                    octave: octave as i32,
                    laplacian: filter.laplacian_sign(integral, centre, column),
                    ..self.place(layer, (column, centre), offset)
                });
            }
        }
        self.candidates = candidates;
    }

    /// The rows around row `centre` of `layer`.
    fn neighbourhood(&self, layer: usize, centre: usize) -> Neighbourhood<'_> {
        let row = |layer: usize, row: usize| {
            &self.determinants[(layer * 3 + row % 3) * self.samples..][..self.samples]
        };
        std::array::from_fn(|l| std::array::from_fn(|r| row(layer + l - 1, centre + r - 1)))
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
    /// Appends every column that exceeds the threshold and its four nearest neighbours to `found`.
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
    let [above, here, below] = rows;
    let mut at = columns.start;
    while at + GROUP <= columns.end {
        let (left, v, right) = (
            &here[at - 1..][..GROUP],
            &here[at..][..GROUP],
            &here[at + 1..][..GROUP],
        );
        let (up, down) = (&above[at..][..GROUP], &below[at..][..GROUP]);
        // No branch until a whole group is done with.
        let mut bar = [threshold; GROUP];
        let mut hits = 0_u32;
        for t in 0..GROUP {
            bar[t] = higher(
                higher(bar[t], higher(left[t], right[t])),
                higher(up[t], down[t]),
            );
            hits |= u32::from(v[t] > bar[t]);
        }
        if hits > 0 {
            for t in 0..GROUP {
                if v[t] > bar[t] {
                    found.push(at + t);
                }
            }
        }
        at += GROUP;
    }
    for at in at..columns.end {
        let others = [here[at - 1], here[at + 1], above[at], below[at], threshold];
        if others.iter().all(|&other| here[at] > other) {
            found.push(at);
        }
    }
}

/// The higher of two determinants, none of which is ever NaN.
#[inline(always)]
fn higher(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}

/// Whether the sample exceeds its 26 neighbours.
fn is_highest(near: &Neighbourhood, column: usize) -> bool {
    let value = near[1][1][column];
    near.iter().flatten().enumerate().all(|(n, row)| {
        let [left, middle, right] = [row[column - 1], row[column], row[column + 1]];
        value > left && value > right && (n == 4 || value > middle)
    })
}

/// Where the quadratic through the 27 samples has its top: column, row, layer, in samples from the
/// middle one. `None` if it has none within one sample of it.
fn top_of_quadratic(near: &Neighbourhood, column: usize) -> Option<[f32; 3]> {
    let v = |x: usize, y: usize, s: usize| f64::from(near[s][y][column + x - 1]);
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
