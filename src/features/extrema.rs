//! Extrema of the fast Hessian: an integral image in, keypoints with place, size and strength out.
//!
//! An octave samples every 2ⁿ-th pixel with `layers + 2` filters. A sample is a keypoint if its
//! determinant is above the threshold and above all 26 neighbours in row, column and layer; a
//! quadratic through these 27 then gives place and size between the samples (Brown and Lowe,
//! *Invariant Features from Interest Point Groups*, 2002), and a candidate whose top lies more than
//! one sample away is none. Only three rows of each layer are ever held.

use super::Keypoint;
use super::hessian::{Columns, Filter};
use super::integral::IntegralImage;

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

/// The last three rows of determinants of every layer of an octave.
#[derive(Debug, Default)]
pub(super) struct Detector {
    columns: Columns,
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
        for octave in 0..search.octaves {
            self.filters.clear();
            let filters = (0..search.layers + 2).map(|layer| Filter::new(octave, layer));
            self.filters
                .extend(filters.take_while(|f| f.fits(integral)));
            if self.filters.len() < 3 {
                break;
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
                    filter.respond(integral, row, &mut self.columns, out);
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
        &self,
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
        let row =
            |layer, row| &self.determinants[(layer * 3 + row % 3) * self.samples..][..self.samples];
        let near: Neighbourhood =
            std::array::from_fn(|l| std::array::from_fn(|r| row(layer + l - 1, centre + r - 1)));
        candidates(
            &near[1],
            threshold,
            margin..self.samples - margin,
            |column| {
                if !is_highest(&near, column) {
                    return;
                }
                let Some(offset) = top_of_quadratic(&near, column) else {
                    return;
                };
                let filter = &self.filters[layer];
                let step = filter.step_px as f32;
                let layer_step_px = (filter.size_px - self.filters[layer - 1].size_px) as f32;
                let centre_px = |sample: usize| {
                    (filter.step_px * sample) as f32 + (filter.step_px - 1) as f32 * 0.5
                };
                keypoints.push(Keypoint {
                    x_px: centre_px(column) + offset[0] * step,
                    y_px: centre_px(centre) + offset[1] * step,
                    size_px: (filter.size_px as f32 + offset[2] * layer_step_px).round_ties_even(),
                    response: near[1][1][column],
                    octave: octave as i32,
                    laplacian: filter.laplacian_sign(integral, centre, column),
                    ..Keypoint::default()
                });
            },
        );
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.columns.capacity() + self.filters.capacity() + self.determinants.capacity()
    }
}

/// Calls `found` for every column that exceeds the threshold and its four nearest neighbours.
fn candidates(
    rows: &[&[f32]; 3],
    threshold: f32,
    columns: std::ops::Range<usize>,
    found: impl FnMut(usize),
) {
    #[cfg(target_arch = "x86_64")]
    if std::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2, as just asked.
        unsafe { candidates_avx2(rows, threshold, columns, found) };
        return;
    }
    candidates_anywhere(rows, threshold, columns, found);
}

/// [`candidates_anywhere`] compiled for wider registers.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn candidates_avx2(
    rows: &[&[f32]; 3],
    threshold: f32,
    columns: std::ops::Range<usize>,
    found: impl FnMut(usize),
) {
    candidates_anywhere(rows, threshold, columns, found);
}

#[inline(always)]
fn candidates_anywhere(
    rows: &[&[f32]; 3],
    threshold: f32,
    columns: std::ops::Range<usize>,
    mut found: impl FnMut(usize),
) {
    let (start, len) = (columns.start, columns.len());
    let [above, here, below] = rows;
    let is_candidate = |v: f32, neighbours: [f32; 4]| {
        // No short circuit: a whole group goes through without a branch.
        neighbours
            .iter()
            .fold(v > threshold, |all, &n| all & (v > n))
    };
    let neighbours = |at: usize| [here[at - 1], here[at + 1], above[at], below[at]];
    let mut group_start = start;
    let groups = here[start..][..len]
        .chunks_exact(GROUP)
        .zip(here[start - 1..].chunks_exact(GROUP))
        .zip(here[start + 1..].chunks_exact(GROUP))
        .zip(above[start..].chunks_exact(GROUP))
        .zip(below[start..].chunks_exact(GROUP));
    for ((((v, left), right), up), down) in groups {
        let mut any = false;
        for t in 0..GROUP {
            any |= is_candidate(v[t], [left[t], right[t], up[t], down[t]]);
        }
        if any {
            (group_start..group_start + GROUP)
                .filter(|&at| is_candidate(here[at], neighbours(at)))
                .for_each(&mut found);
        }
        group_start += GROUP;
    }
    (group_start..columns.end)
        .filter(|&at| is_candidate(here[at], neighbours(at)))
        .for_each(found);
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
