//! Left–right: features of one pair in, stereo matches out.
//!
//! Keypoints (not images) are carried to the rectified plane, where the sights of one point share
//! their row. Right features are sorted by row, so that each left feature meets only the few of its
//! band and disparity range: cost grows as features × features per band.

use super::Settings;
use super::descriptor::{Best, compatible, distance_between};
use crate::features::Features;
use crate::geometry::Rectification;
use nalgebra::Vector2;

/// A left and a right feature that show the same point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StereoMatch {
    /// Index among the left image's features.
    pub left: u32,
    /// Index among the right image's features.
    pub right: u32,
}

/// Finds stereo matches; keeps its working memory from pair to pair.
#[derive(Debug)]
pub struct StereoMatcher {
    settings: Settings,
    rectification: Rectification,
    left: Vec<Option<Vector2<f64>>>,
    right: Vec<RightFeature>,
    best_right: Vec<Option<u32>>,
    best_left: Vec<Best>,
}

#[derive(Clone, Copy, Debug)]
struct RightFeature {
    index: u32,
    x_px: f64,
    y_px: f64,
}

impl StereoMatcher {
    /// A matcher for one rig.
    #[must_use]
    pub fn new(settings: Settings, rectification: Rectification) -> Self {
        Self {
            settings,
            rectification,
            left: Vec::new(),
            right: Vec::new(),
            best_right: Vec::new(),
            best_left: Vec::new(),
        }
    }

    /// Finds the stereo matches of a pair, in the order of its left features, replacing what
    /// `matches` held. Each feature is in one match at most.
    pub fn find(&mut self, left: &Features, right: &Features, matches: &mut Vec<StereoMatch>) {
        self.rectify(left, right);
        self.search(left, right);
        matches.clear();
        for (i, best) in self.best_right.iter().enumerate() {
            let Some(j) = *best else { continue };
            // Mutual: of all left features, the right one must like this one best.
            if self.best_left[j as usize].accepted(&self.settings) == Some(i as u32) {
                matches.push(StereoMatch {
                    left: i as u32,
                    right: j,
                });
            }
        }
    }

    fn rectify(&mut self, left: &Features, right: &Features) {
        self.left.clear();
        self.left.extend(left.keypoints.iter().map(|k| {
            self.rectification
                .left(&Vector2::new(f64::from(k.x_px), f64::from(k.y_px)))
        }));
        self.right.clear();
        for (index, k) in right.keypoints.iter().enumerate() {
            let raw_px = Vector2::new(f64::from(k.x_px), f64::from(k.y_px));
            if let Some(p) = self.rectification.right(&raw_px) {
                self.right.push(RightFeature {
                    index: index as u32,
                    x_px: p.x,
                    y_px: p.y,
                });
            }
        }
        self.right
            .sort_unstable_by(|a, b| a.y_px.total_cmp(&b.y_px).then(a.index.cmp(&b.index)));
    }

    fn search(&mut self, left: &Features, right: &Features) {
        let max_disparity_px = self.rectification.disparity_px(self.settings.min_depth_m);
        self.best_right.clear();
        self.best_left.clear();
        self.best_left.resize(right.len(), Best::NONE);
        for (i, (keypoint, position)) in left.keypoints.iter().zip(&self.left).enumerate() {
            let mut best = Best::NONE;
            if let Some(p) = position {
                let band_px = self
                    .settings
                    .row_band_px
                    .max(self.settings.row_band_sigmas * f64::from(keypoint.sigma_px));
                let from = self.right.partition_point(|r| r.y_px < p.y - band_px);
                for candidate in &self.right[from..] {
                    if candidate.y_px > p.y + band_px {
                        break;
                    }
                    let disparity_px = p.x - candidate.x_px;
                    let j = candidate.index;
                    if disparity_px < self.settings.min_disparity_px
                        || disparity_px > max_disparity_px
                        || !compatible(keypoint, &right.keypoints[j as usize], &self.settings)
                    {
                        continue;
                    }
                    let squared = distance_between(left, i as u32, right, j);
                    best.offer(j, squared);
                    self.best_left[j as usize].offer(i as u32, squared);
                }
            }
            self.best_right.push(best.accepted(&self.settings));
        }
    }
}
