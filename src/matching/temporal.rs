//! Over time: the stereo matches of two pairs in, tracks that close the circle out.
//!
//! Each side is searched on its own near the positions that the predicted motion gives; a track is
//! kept only if both sides agree on it. Candidates come from a grid over the image, so that cost
//! grows as matches × matches per search window.

use super::descriptor::{Best, compatible, distance_between};
use super::{Settings, StereoMatch};
use crate::features::Features;
use nalgebra::{Vector2, Vector4};

/// A stereo match of an earlier pair found again in this one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Track {
    /// Index among the earlier pair's stereo matches.
    pub before: u32,
    /// Index among this pair's stereo matches.
    pub now: u32,
}

/// One pair's features and the stereo matches among them.
#[derive(Clone, Copy, Debug)]
pub struct MatchedPair<'a> {
    /// The left image's features.
    pub left: &'a Features,
    /// The right image's features.
    pub right: &'a Features,
    /// Their stereo matches.
    pub matches: &'a [StereoMatch],
}

/// Finds tracks; keeps its working memory from pair to pair.
#[derive(Debug)]
pub struct TemporalMatcher {
    settings: Settings,
    left: SideSearch,
    right: SideSearch,
}

impl TemporalMatcher {
    /// A matcher.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
        Self {
            settings,
            left: SideSearch::default(),
            right: SideSearch::default(),
        }
    }

    /// Finds the tracks between two pairs, in the order of the earlier pair's matches, replacing
    /// what `tracks` held. Each match is in one track at most.
    ///
    /// `predicted` holds, for each of the earlier matches, where its point should now be seen
    /// (ul, vl, ur, vr), px, or `None` where it should not; each is sought within `radius_px`.
    pub fn find(
        &mut self,
        before: MatchedPair<'_>,
        now: MatchedPair<'_>,
        predicted: &[Option<Vector4<f64>>],
        radius_px: f64,
        tracks: &mut Vec<Track>,
    ) {
        let settings = &self.settings;
        self.left.search(
            SideFeatures {
                before: before.left,
                now: now.left,
                feature_before: |m| before.matches[m as usize].left,
                feature_now: |m| now.matches[m as usize].left,
            },
            now.matches.len(),
            |m| predicted[m].map(|p| p.xy()),
            predicted.len(),
            radius_px,
            settings,
        );
        self.right.search(
            SideFeatures {
                before: before.right,
                now: now.right,
                feature_before: |m| before.matches[m as usize].right,
                feature_now: |m| now.matches[m as usize].right,
            },
            now.matches.len(),
            |m| predicted[m].map(|p| p.fixed_rows::<2>(2).into_owned()),
            predicted.len(),
            radius_px,
            settings,
        );
        tracks.clear();
        for m in 0..predicted.len() {
            let Some(n) = self.left.partner(m, settings) else {
                continue;
            };
            // The circle: the right side must lead from the same earlier match to the same one now.
            if self.right.partner(m, settings) == Some(n) {
                tracks.push(Track {
                    before: m as u32,
                    now: n,
                });
            }
        }
    }
}

/// What one side's search reads.
struct SideFeatures<'a, B, N> {
    before: &'a Features,
    now: &'a Features,
    feature_before: B,
    feature_now: N,
}

/// The search on one side: best partners both ways, in numbers of stereo matches.
#[derive(Debug, Default)]
struct SideSearch {
    grid: Grid,
    now_of_before: Vec<Best>,
    before_of_now: Vec<Best>,
}

impl SideSearch {
    fn search<B: Fn(u32) -> u32, N: Fn(u32) -> u32>(
        &mut self,
        features: SideFeatures<'_, B, N>,
        now_count: usize,
        predicted: impl Fn(usize) -> Option<Vector2<f64>>,
        before_count: usize,
        radius_px: f64,
        settings: &Settings,
    ) {
        self.grid.fill((0..now_count as u32).map(|n| {
            let k = &features.now.keypoints[(features.feature_now)(n) as usize];
            (n, k.x_px, k.y_px)
        }));
        self.now_of_before.clear();
        self.now_of_before.resize(before_count, Best::NONE);
        self.before_of_now.clear();
        self.before_of_now.resize(now_count, Best::NONE);
        for m in 0..before_count {
            let Some(at) = predicted(m) else { continue };
            let i = (features.feature_before)(m as u32);
            let keypoint = &features.before.keypoints[i as usize];
            let best = &mut self.now_of_before[m];
            let before_of_now = &mut self.before_of_now;
            self.grid.for_each_near(&at, radius_px, |n| {
                let j = (features.feature_now)(n);
                if !compatible(keypoint, &features.now.keypoints[j as usize], settings) {
                    return;
                }
                let squared = distance_between(features.before, i, features.now, j);
                best.offer(n, squared);
                before_of_now[n as usize].offer(m as u32, squared);
            });
        }
    }

    /// The match now that goes with `m` of before, if each likes the other best.
    fn partner(&self, m: usize, settings: &Settings) -> Option<u32> {
        let n = self.now_of_before[m].accepted(settings)?;
        (self.before_of_now[n as usize].accepted(settings)? == m as u32).then_some(n)
    }
}

/// Side of a grid cell, px.
const CELL_PX: f32 = 32.0;

/// Numbered points sorted into the cells of a grid.
#[derive(Debug, Default)]
struct Grid {
    columns: i32,
    rows: i32,
    /// Where each cell's points start in `points`; one more entry than cells.
    starts: Vec<u32>,
    points: Vec<(u32, f32, f32)>,
    unsorted: Vec<(u32, f32, f32)>,
}

impl Grid {
    fn fill(&mut self, points: impl Iterator<Item = (u32, f32, f32)>) {
        self.unsorted.clear();
        self.unsorted.extend(points);
        let extent = |get: fn(&(u32, f32, f32)) -> f32| {
            let max = self.unsorted.iter().map(get).fold(0.0_f32, f32::max);
            (max / CELL_PX) as i32 + 1
        };
        self.columns = extent(|p| p.1);
        self.rows = extent(|p| p.2);
        // Counting sort: points of a cell stay in their given order.
        self.starts.clear();
        self.starts
            .resize((self.columns * self.rows) as usize + 1, 0);
        for p in &self.unsorted {
            self.starts[cell_of(self.columns, p) + 1] += 1;
        }
        for c in 1..self.starts.len() {
            self.starts[c] += self.starts[c - 1];
        }
        self.points.clear();
        self.points.resize(self.unsorted.len(), (0, 0.0, 0.0));
        for p in &self.unsorted {
            let slot = &mut self.starts[cell_of(self.columns, p)];
            self.points[*slot as usize] = *p;
            *slot += 1;
        }
        // Each start has moved to its cell's end, which is the next cell's start: shift back.
        self.starts.rotate_right(1);
        self.starts[0] = 0;
    }

    fn for_each_near(&self, at: &Vector2<f64>, radius_px: f64, mut visit: impl FnMut(u32)) {
        let cell = |v: f64| (v as f32 / CELL_PX).floor() as i32;
        let columns = cell(at.x - radius_px).max(0)..=cell(at.x + radius_px).min(self.columns - 1);
        for row in cell(at.y - radius_px).max(0)..=cell(at.y + radius_px).min(self.rows - 1) {
            for column in columns.clone() {
                let c = (row * self.columns + column) as usize;
                for &(n, x, y) in &self.points[self.starts[c] as usize..self.starts[c + 1] as usize]
                {
                    let offset = Vector2::new(f64::from(x), f64::from(y)) - at;
                    if offset.norm_squared() <= radius_px * radius_px {
                        visit(n);
                    }
                }
            }
        }
    }
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
            prop_assert_eq!(found, plain);
        }
    }
}
