//! Extrema of the fast Hessian: an integral image in, keypoints with place, size and strength out.
//!
//! An octave samples every 2ⁿ-th pixel, or every second of these, with `layers + 2` filters. A sample
//! is a keypoint if its determinant is above the threshold and above all 26 neighbours in row, column
//! and layer; a quadratic through these 27 then gives place and size between the samples (Brown and
//! Lowe, *Invariant Features from Interest Point Groups*, 2002), and a candidate whose top lies more
//! than one sample away is none.
//!
//! The lowest and the highest layer of an octave hold no keypoints. They are not searched, so what is
//! found is candidates: samples that exceed their neighbours in the layers between. Only those that
//! have a chance to be among the keypoints that are kept are then [confirmed](Detector::confirm).
//! Of a layer that is searched only three rows are ever held.

use super::hessian::{Combined, Filter};
use super::integral::{IntegralImage, SortedColumns};
use super::{Keypoint, make_room};
use crate::simd::widened;
use std::ops::Range;

/// Samples across a strip of the first octave, narrow enough for what a strip needs of the integral
/// image to stay in the second cache: narrower ones, for the first cache, cost more by their number than
/// they gain. The other octaves are narrow enough as they are.
const STRIP: usize = 640;

/// Samples that are looked at together before any of them is looked at closely.
const GROUP: usize = 8;

/// What is searched for.
#[derive(Clone, Copy, Debug)]
pub(super) struct Search {
    /// Number of octaves.
    pub octaves: u32,
    /// Layers of an octave in which keypoints may lie.
    pub layers: usize,
    /// Distance of the samples in the first octave, px, a power of two.
    pub sampling_px: usize,
    /// The determinant that a keypoint exceeds.
    pub threshold: f32,
}

impl Search {
    /// The filter of a layer, both it and the octave counted from 0.
    fn filter(&self, octave: u32, layer: usize) -> Filter {
        Filter::new(octave, layer, self.sampling_px)
    }

    /// Size of the largest keypoint that may be found, px.
    pub(super) fn largest_px(&self) -> f32 {
        self.filter(self.octaves - 1, self.layers + 1).size_px as f32
    }
}

/// The search with its working memory, above all the last three rows of determinants of every
/// inner layer of an octave.
#[derive(Debug, Default)]
pub(super) struct Detector {
    columns: SortedColumns,
    combined: Combined,
    marks: Vec<u8>,
    highest: Vec<usize>,
    /// Of all octaves, those that fit into the image.
    filters: Vec<Vec<Filter>>,
    samples: usize,
    /// Row by row of each layer but the lowest and the highest.
    determinants: Vec<f32>,
    /// Around each candidate, the samples in its own layer and those beside it, as far as these are searched.
    around: Vec<[Layer; 3]>,
}

/// A sample that may be a keypoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Candidate {
    octave: u8,
    layer: u8,
    row: u32,
    column: u32,
    /// Where the sample lies, and how far from its neighbours.
    middle_px: [f32; 2],
    step_px: f32,
    response: f32,
    /// Which of those of its image it is.
    number: u32,
}

impl Candidate {
    /// One without neighbours.
    #[cfg(test)]
    pub(super) fn lone(octave: u8, (row, column): (u32, u32), response: f32) -> Self {
        let filter = Filter::new(octave.into(), 1, 1);
        Self {
            octave,
            layer: 1,
            row,
            column,
            middle_px: [column, row].map(|sample| filter.middle_px(sample as usize)),
            step_px: filter.step_px as f32,
            response,
            number: 0,
        }
    }

    /// Its determinant.
    pub(super) fn response(&self) -> f32 {
        self.response
    }

    /// Where the keypoint lies: from the first to the second value of each coordinate, px.
    pub(super) fn reach_px(&self) -> [[f32; 2]; 2] {
        self.middle_px
            .map(|middle_px| [middle_px - self.step_px, middle_px + self.step_px])
    }
}

/// The samples around one in a layer: `values[row][column]`.
type Layer = [[f32; 3]; 3];

impl Detector {
    /// Makes room for that many candidates.
    pub(super) fn make_room(&mut self, candidates: usize) {
        make_room(&mut self.around, candidates);
    }

    /// Replaces `found` by an image's candidates, octave by octave, row by row.
    pub(super) fn detect(
        &mut self,
        integral: &IntegralImage,
        search: Search,
        found: &mut Vec<Candidate>,
    ) {
        found.clear();
        self.around.clear();
        let widest = search.sampling_px << (search.octaves - 1);
        self.columns.begin(integral, widest);
        self.filters.resize(search.octaves as usize, Vec::new());
        for octave in 0..search.octaves {
            let filters = (0..search.layers + 2).map(|layer| search.filter(octave, layer));
            let fitting = &mut self.filters[octave as usize];
            fitting.clear();
            make_room(fitting, search.layers + 2);
            fitting.extend(filters.take_while(|f| f.fits(integral)));
            if fitting.len() < 3 {
                break;
            }
            self.columns.widen(integral, fitting[0].step_px);
            self.detect_in_octave(integral, search.threshold, octave, found);
        }
    }

    fn detect_in_octave(
        &mut self,
        integral: &IntegralImage,
        threshold: f32,
        octave: u32,
        found: &mut Vec<Candidate>,
    ) {
        let filters = &self.filters[octave as usize];
        self.samples = integral.width() / filters[0].step_px;
        let values = (filters.len() - 2) * 3 * self.samples;
        let strip = if octave == 0 { STRIP } else { self.samples };
        // The first sample with complete neighbours in the second layer.
        let first = filters[2].margin() + 1;
        self.determinants.resize(values, 0.0);
        let mut start = first;
        while start + first < self.samples {
            let end = (start + strip).min(self.samples - first);
            self.detect_in_strip(integral, threshold, octave, start..end, found);
            start = end;
        }
    }

    /// Searches the samples of some columns of all rows.
    fn detect_in_strip(
        &mut self,
        integral: &IntegralImage,
        threshold: f32,
        octave: u32,
        strip: Range<usize>,
        found: &mut Vec<Candidate>,
    ) {
        let around = strip.start - 1..strip.end + 1;
        for row in 0..integral.height() / self.filters[octave as usize][0].step_px {
            let layers = 1..self.filters[octave as usize].len() - 1;
            for layer in layers.clone() {
                let filter = &self.filters[octave as usize][layer];
                let margin = filter.margin();
                let samples = margin..margin + filter.samples(integral, row);
                let wanted = around.start.max(samples.start)..around.end.min(samples.end);
                if !wanted.is_empty() {
                    let start = self.start(layer, row);
                    let out = &mut self.determinants[start..][wanted.clone()];
                    let at = (row, wanted.start);
                    filter.respond(integral, &self.columns, at, &mut self.combined, out);
                }
            }
            let Some(centre) = row.checked_sub(1) else {
                continue;
            };
            for layer in layers {
                let at = (octave, layer, centre);
                self.search_row(integral, threshold, at, &strip, found);
            }
        }
    }

    /// Searches a strip of row `centre` of a layer; the row below it is the last one computed.
    fn search_row(
        &mut self,
        integral: &IntegralImage,
        threshold: f32,
        (octave, layer, centre): (u32, usize, usize),
        strip: &Range<usize>,
        found: &mut Vec<Candidate>,
    ) {
        // All neighbours must be complete, which the layer above decides.
        let filter = &self.filters[octave as usize][layer + 1];
        let margin = filter.margin() + 1;
        let rows = integral.height() / filter.step_px;
        if centre < margin || centre + margin >= rows || 2 * margin >= self.samples {
            return;
        }
        let columns = strip.start.max(margin)..strip.end.min(self.samples - margin);
        let mut highest = std::mem::take(&mut self.highest);
        let mut marks = std::mem::take(&mut self.marks);
        let mut around = std::mem::take(&mut self.around);
        highest.clear();
        let rows_of =
            |layer: usize| [centre - 1, centre, centre + 1].map(|row| self.row(layer, row));
        let here = rows_of(layer);
        let beside =
            [layer - 1, layer + 1].map(|layer| self.is_held(octave, layer).then(|| rows_of(layer)));
        let [finer, coarser] = beside.map(|rows| rows.map_or(here[0], |rows| rows[1]));
        let rows = [here[0], here[1], here[2], finer, coarser];
        find_highest(&rows, threshold, columns, &mut marks, &mut highest);
        for &column in &highest {
            let response = here[1][column];
            let [finer, coarser] =
                beside.map(|rows| rows.map_or(Layer::default(), |rows| near(rows, column)));
            // A layer that is not held is zero here, and the value above a threshold that is not below.
            if exceeds(response, &finer) && exceeds(response, &coarser) {
                found.push(Candidate {
                    octave: octave as u8,
                    layer: layer as u8,
                    row: centre as u32,
                    column: column as u32,
                    middle_px: [column, centre].map(|sample| filter.middle_px(sample)),
                    step_px: filter.step_px as f32,
                    response,
                    number: around.len() as u32,
                });
                around.push([finer, near(here, column), coarser]);
            }
        }
        (self.highest, self.marks, self.around) = (highest, marks, around);
    }

    /// Whether a layer is an inner one.
    fn is_held(&self, octave: u32, layer: usize) -> bool {
        0 < layer && layer + 1 < self.filters[octave as usize].len()
    }

    /// Where row `row` of an inner layer starts among the determinants.
    fn start(&self, layer: usize, row: usize) -> usize {
        ((layer - 1) * 3 + row % 3) * self.samples
    }

    /// A row of an inner layer, one of the last three.
    fn row(&self, layer: usize, row: usize) -> &[f32] {
        &self.determinants[self.start(layer, row)..][..self.samples]
    }

    /// The keypoint at a candidate of the last image, without direction and σ; `None` unless it
    /// exceeds its neighbours in the layers that were not searched, too, and has a top.
    pub(super) fn confirm(
        &self,
        integral: &IntegralImage,
        candidate: &Candidate,
    ) -> Option<Keypoint> {
        let (octave, layer) = (candidate.octave, candidate.layer as usize);
        let filters = &self.filters[octave as usize];
        let at = (candidate.row as usize, candidate.column as usize);
        let mut layers = self.around[candidate.number as usize];
        for n in [0, 2] {
            if !self.is_held(u32::from(octave), layer + n - 1) {
                let filter = &filters[layer + n - 1];
                layers[n] = samples_below(candidate.response(), filter, integral, at)?;
            }
        }
        let offset = top_of_quadratic(&layers)?;
        let layer_step_px = filters[layer].size_px - filters[layer - 1].size_px;
        Some(Keypoint {
            response: candidate.response(),
            octave: i32::from(octave),
            laplacian: filters[layer].laplacian_sign(integral, at.0, at.1),
            ..place(&filters[layer], layer_step_px as f32, at, offset)
        })
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.columns.capacity()
            + self.combined.capacity()
            + self.marks.capacity()
            + self.highest.capacity()
            + self.filters.iter().map(Vec::capacity).sum::<usize>()
            + self.determinants.capacity()
            + self.around.capacity()
    }
}

/// The order in which neighbours are looked at: the middle one is most often the highest.
const MIDDLE_FIRST: [usize; 9] = [4, 1, 3, 5, 7, 0, 2, 6, 8];

/// The samples around one of a layer; `None` if one of them is not below `value`.
fn samples_below(
    value: f32,
    filter: &Filter,
    integral: &IntegralImage,
    (row, column): (usize, usize),
) -> Option<Layer> {
    let mut samples = [[0.0; 3]; 3];
    for n in MIDDLE_FIRST {
        let (y, x) = (n / 3, n % 3);
        let sample = filter.determinant(integral, row + y - 1, column + x - 1);
        if value <= sample {
            return None;
        }
        samples[y][x] = sample;
    }
    Some(samples)
}

/// Place and size of the keypoint `offset` samples from sample `(row, column)` of a filter's layer,
/// whose size exceeds that of the one below by `layer_step_px`.
fn place(
    filter: &Filter,
    layer_step_px: f32,
    (row, column): (usize, usize),
    offset: [f32; 3],
) -> Keypoint {
    let step_px = filter.step_px as f32;
    Keypoint {
        x_px: filter.middle_px(column) + offset[0] * step_px,
        y_px: filter.middle_px(row) + offset[1] * step_px,
        size_px: (filter.size_px as f32 + offset[2] * layer_step_px).round_ties_even(),
        ..Keypoint::default()
    }
}

/// Appends every column of the middle of three rows that exceeds the threshold, its eight
/// neighbours and the two rows of other layers that follow to `found`; `marks` is working memory.
fn find_highest(
    rows: &[&[f32]; 5],
    threshold: f32,
    columns: Range<usize>,
    marks: &mut Vec<u8>,
    found: &mut Vec<usize>,
) {
    let len = columns.len();
    // Every second sample at most is above its neighbours.
    make_room(found, len.div_ceil(2));
    if marks.len() < len.next_multiple_of(GROUP) {
        marks.resize(len.next_multiple_of(GROUP), 0);
    }
    let around = columns.start - 1..columns.end + 1;
    let rows = [0, 1, 2, 3, 4].map(|n| &rows[n][around.clone()]);
    mark_highest(rows, threshold, &mut marks[..len]);
    marks[len..].fill(0);
    for (group, marks) in marks.as_chunks::<GROUP>().0.iter().enumerate() {
        let mut marked = u64::from_le_bytes(*marks);
        while marked != 0 {
            found.push(columns.start + group * GROUP + marked.trailing_zeros() as usize / 8);
            marked &= marked - 1;
        }
    }
}

widened! {
    /// Marks with 1 what [`find_highest`] is after, with 0 what it is not; the rows begin one
    /// column before.
    fn mark_highest = mark_highest_narrow, (rows: [&[f32]; 5], threshold: f32, marks: &mut [u8])
}

#[inline(always)]
fn mark_highest_narrow(rows: [&[f32]; 5], threshold: f32, marks: &mut [u8]) {
    let [above, here, below, finer, coarser] = rows;
    let len = marks.len();
    let (finer, coarser) = (&finer[1..][..len], &coarser[1..][..len]);
    let (up_left, up, up_right) = (&above[..len], &above[1..][..len], &above[2..][..len]);
    let (left, value, right) = (&here[..len], &here[1..][..len], &here[2..][..len]);
    let (down_left, down, down_right) = (&below[..len], &below[1..][..len], &below[2..][..len]);
    for x in 0..len {
        let sides = higher(higher(left[x], right[x]), higher(up[x], down[x]));
        let upper = higher(up_left[x], up_right[x]);
        let lower = higher(down_left[x], down_right[x]);
        let layers = higher(higher(finer[x], coarser[x]), threshold);
        let bar = higher(higher(layers, sides), higher(upper, lower));
        marks[x] = u8::from(value[x] > bar);
    }
}

/// The samples around a column of three rows.
#[inline(always)]
fn near(rows: [&[f32]; 3], column: usize) -> Layer {
    rows.map(|row| {
        let samples = &row[column - 1..column + 2];
        [samples[0], samples[1], samples[2]]
    })
}

/// Whether `value` exceeds all samples of a layer.
#[inline(always)]
fn exceeds(value: f32, layer: &Layer) -> bool {
    layer.as_flattened().iter().all(|&other| value > other)
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
