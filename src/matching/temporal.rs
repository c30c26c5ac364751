//! Over time: the stereo matches of two pairs in, tracks that close the circle out.
//!
//! Each side is searched on its own near the positions that the predicted motion gives; a track is
//! kept only if both sides agree on it. Candidates come from a grid over the image, so that cost
//! grows as matches × matches per search window.

use super::candidates::{MatchError, Window};
use super::grid::Grid;
use super::pairing::{Chosen, Pairing};
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
    left: SideSearch,
    right: SideSearch,
}

impl TemporalMatcher {
    /// A matcher.
    #[must_use]
    pub fn new(settings: Settings) -> Self {
        Self {
            left: SideSearch::new(settings.clone()),
            right: SideSearch::new(settings),
        }
    }

    /// Finds the tracks between two pairs, in the order of the earlier pair's matches, replacing
    /// what `tracks` held. Each match is in one track at most.
    ///
    /// `predicted` holds, for each of the earlier matches, where its point should now be seen
    /// (ul, vl, ur, vr), px, or `None` where it should not; each is sought within `radius_px`.
    ///
    /// # Errors
    /// FLANN was asked for and failed; `tracks` is then empty.
    pub fn find(
        &mut self,
        before: MatchedPair<'_>,
        now: MatchedPair<'_>,
        predicted: &[Option<Vector4<f64>>],
        radius_px: f64,
        tracks: &mut Vec<Track>,
    ) -> Result<(), MatchError> {
        tracks.clear();
        self.left.search(
            &before.chosen(before.left, |m| m.left),
            &now.chosen(now.left, |m| m.left),
            |m| predicted[m as usize].map(|p| p.xy()),
            radius_px,
        )?;
        self.right.search(
            &before.chosen(before.right, |m| m.right),
            &now.chosen(now.right, |m| m.right),
            |m| predicted[m as usize].map(|p| p.fixed_rows::<2>(2).into_owned()),
            radius_px,
        )?;
        tracks.extend((0..before.matches.len() as u32).filter_map(|before| {
            let now = self.left.pairing.partner(before)?;
            // The circle: the right side must lead from the same earlier match to the same one now.
            (self.right.pairing.partner(before)? == now).then_some(Track { before, now })
        }));
        Ok(())
    }
}

impl<'a> MatchedPair<'a> {
    /// The features of one side, numbered as the matches are.
    fn chosen(
        &self,
        features: &'a Features,
        side: impl Fn(&StereoMatch) -> u32,
    ) -> Chosen<'a, impl Fn(u32) -> u32> {
        let matches = self.matches;
        Chosen {
            features,
            count: matches.len() as u32,
            feature_of: move |m| side(&matches[m as usize]),
        }
    }
}

/// The search on one side, in numbers of stereo matches.
#[derive(Debug)]
struct SideSearch {
    grid: Grid,
    pairing: Pairing,
}

impl SideSearch {
    fn new(settings: Settings) -> Self {
        Self {
            grid: Grid::default(),
            pairing: Pairing::new(settings),
        }
    }

    fn search<B: Fn(u32) -> u32, N: Fn(u32) -> u32>(
        &mut self,
        before: &Chosen<'_, B>,
        now: &Chosen<'_, N>,
        predicted: impl Fn(u32) -> Option<Vector2<f64>>,
        radius_px: f64,
    ) -> Result<(), MatchError> {
        self.grid.fill((0..now.count).map(|n| {
            let k = now.keypoint(n);
            (n, k.x_px, k.y_px)
        }));
        let window = SearchCircle {
            grid: &self.grid,
            predicted,
            radius_px,
        };
        self.pairing.search(before, now, &window)
    }
}

/// The window over time: what lies around a predicted position.
struct SearchCircle<'a, P> {
    grid: &'a Grid,
    predicted: P,
    radius_px: f64,
}

impl<P: Fn(u32) -> Option<Vector2<f64>>> Window for SearchCircle<'_, P> {
    fn for_each_in(&self, m: u32, visit: impl FnMut(u32)) {
        if let Some(at) = (self.predicted)(m) {
            self.grid.for_each_near(&at, self.radius_px, visit);
        }
    }

    #[cfg(feature = "opencv")]
    fn holds(&self, m: u32, n: u32) -> bool {
        (self.predicted)(m).is_some_and(|at| self.grid.is_near(n, &at, self.radius_px))
    }
}
