//! Left–right: features of one pair in, stereo matches out.
//!
//! Keypoints (not images) are carried to the rectified plane, where the sights of one point share
//! their row. Right features are sorted by row, so that each left feature meets only the few of its
//! band and disparity range: cost grows as features × features per band.

use super::Settings;
use super::candidates::{MatchError, Window};
use super::pairing::{Chosen, Pairing};
use crate::features::{Features, Keypoint};
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
    band: EpipolarBand,
    pairing: Pairing,
}

impl StereoMatcher {
    /// A matcher for one rig.
    #[must_use]
    pub fn new(settings: Settings, rectification: Rectification) -> Self {
        Self {
            band: EpipolarBand::default(),
            pairing: Pairing::new(settings.clone()),
            settings,
            rectification,
        }
    }

    /// Finds the stereo matches of a pair, in the order of its left features, replacing what
    /// `matches` held. Each feature is in one match at most.
    ///
    /// # Errors
    /// FLANN was asked for and failed; `matches` is then empty.
    pub fn find(
        &mut self,
        left: &Features,
        right: &Features,
        matches: &mut Vec<StereoMatch>,
    ) -> Result<(), MatchError> {
        matches.clear();
        self.band
            .fill(&self.settings, &self.rectification, left, right);
        self.pairing.search(&all(left), &all(right), &self.band)?;
        matches.extend((0..left.len() as u32).filter_map(|left| {
            let right = self.pairing.partner(left)?;
            Some(StereoMatch { left, right })
        }));
        Ok(())
    }
}

fn all(features: &Features) -> Chosen<'_, impl Fn(u32) -> u32> {
    Chosen {
        features,
        count: features.len() as u32,
        feature_of: |i| i,
    }
}

/// The window left–right: a band of rectified rows, and a range of disparities.
#[derive(Debug, Default)]
struct EpipolarBand {
    min_disparity_px: f64,
    max_disparity_px: f64,
    left: Vec<Option<LeftSight>>,
    right: Vec<Option<RightSight>>,
    /// The right ones by row.
    right_by_row: Vec<RightSight>,
}

#[derive(Clone, Copy, Debug)]
struct LeftSight {
    x_px: f64,
    top_px: f64,
    bottom_px: f64,
}

#[derive(Clone, Copy, Debug)]
struct RightSight {
    index: u32,
    x_px: f64,
    y_px: f64,
}

impl EpipolarBand {
    fn fill(
        &mut self,
        settings: &Settings,
        rectification: &Rectification,
        left: &Features,
        right: &Features,
    ) {
        self.min_disparity_px = settings.min_disparity_px;
        self.max_disparity_px = rectification.disparity_px(settings.min_depth_m);
        self.left.clear();
        self.left.extend(left.keypoints.iter().map(|k| {
            let at = rectification.left(&raw_px(k))?;
            let half_px = settings.row_band_px(k.sigma_px);
            Some(LeftSight {
                x_px: at.x,
                top_px: at.y - half_px,
                bottom_px: at.y + half_px,
            })
        }));
        self.right.clear();
        self.right
            .extend((0..).zip(&right.keypoints).map(|(index, k)| {
                let at = rectification.right(&raw_px(k))?;
                Some(RightSight {
                    index,
                    x_px: at.x,
                    y_px: at.y,
                })
            }));
        self.right_by_row.clear();
        self.right_by_row.extend(self.right.iter().flatten());
        self.right_by_row
            .sort_unstable_by(|a, b| a.y_px.total_cmp(&b.y_px).then(a.index.cmp(&b.index)));
    }

    fn has_disparity_in_range(&self, left: &LeftSight, right: &RightSight) -> bool {
        let disparity_px = left.x_px - right.x_px;
        self.min_disparity_px <= disparity_px && disparity_px <= self.max_disparity_px
    }
}

impl Window for EpipolarBand {
    fn for_each_in(&self, i: u32, mut visit: impl FnMut(u32)) {
        let Some(left) = &self.left[i as usize] else {
            return;
        };
        let from = self.right_by_row.partition_point(|r| r.y_px < left.top_px);
        for right in &self.right_by_row[from..] {
            if right.y_px > left.bottom_px {
                return;
            }
            if self.has_disparity_in_range(left, right) {
                visit(right.index);
            }
        }
    }

    #[cfg(feature = "opencv")]
    fn holds(&self, i: u32, j: u32) -> bool {
        let (Some(left), Some(right)) = (&self.left[i as usize], &self.right[j as usize]) else {
            return false;
        };
        (left.top_px..=left.bottom_px).contains(&right.y_px)
            && self.has_disparity_in_range(left, right)
    }
}

pub(super) fn raw_px(keypoint: &Keypoint) -> Vector2<f64> {
    Vector2::new(f64::from(keypoint.x_px), f64::from(keypoint.y_px))
}
