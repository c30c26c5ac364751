//! The gallery: what the landmarks under way look like.
//!
//! Beside each landmark of the window stand the descriptors with which it was last recognised, on
//! the left and on the right, and where its patch is to be found.

use super::method::{Described, DescribedPair};
use crate::estimation::window::LandmarkId;
use crate::features::{Features, Keypoint};
use crate::matching::{MatchedPair, StereoMatch};
use crate::refinement::Slant;
use nalgebra::Vector2;

/// One landmark's looks, but for its descriptors.
#[derive(Clone, Copy, Debug)]
pub(super) struct Portrait {
    pub(super) id: LandmarkId,
    /// The serial of the keyframe whose left image holds its patch.
    pub(super) anchor: u64,
    /// The centre of the patch there, raw px.
    pub(super) px: Vector2<f64>,
    /// Diameter of the keypoint there, px.
    pub(super) size_px: f64,
    /// What is known of its surface.
    pub(super) slant: Slant,
    /// Pairs that have shown it since the first that did.
    pub(super) age: u32,
    /// Pairs in a row in which it should have been seen and was not.
    pub(super) missed: u32,
    /// Whether the present pair shows it.
    pub(super) found: bool,
    /// Whether it was recognised where the others' motion does not put it: it moves by itself, or
    /// was mistaken.
    pub(super) disagreed: bool,
}

/// All landmarks under way, with rising ids.
#[derive(Debug, Default)]
pub(super) struct Gallery {
    pub(super) portraits: Vec<Portrait>,
    left: Features,
    right: Features,
    /// Landmark `i` has keypoint `i` on both sides.
    matches: Vec<StereoMatch>,
}

impl Gallery {
    pub(super) fn clear(&mut self) {
        self.portraits.clear();
        self.matches.clear();
        for side in [&mut self.left, &mut self.right] {
            side.keypoints.clear();
            side.descriptors.clear();
        }
    }

    /// Adds a landmark that is seen for the first time.
    pub(super) fn add(&mut self, portrait: Portrait, pair: &DescribedPair, m: StereoMatch) {
        let index = self.portraits.len() as u32;
        self.portraits.push(portrait);
        self.matches.push(StereoMatch {
            left: index,
            right: index,
        });
        for (side, from, at) in [
            (&mut self.left, &pair.left, m.left),
            (&mut self.right, &pair.right, m.right),
        ] {
            let (keypoint, descriptor) = of(from, at);
            side.descriptor_len = from.features.descriptor_len;
            side.keypoints.push(keypoint);
            side.descriptors.extend_from_slice(descriptor);
        }
    }

    /// Takes note of how a landmark looks by now.
    pub(super) fn recognised(&mut self, index: usize, pair: &DescribedPair, m: StereoMatch) {
        for (side, from, at) in [
            (&mut self.left, &pair.left, m.left),
            (&mut self.right, &pair.right, m.right),
        ] {
            let (keypoint, descriptor) = of(from, at);
            let len = side.descriptor_len;
            side.keypoints[index] = keypoint;
            side.descriptors[index * len..][..len].copy_from_slice(descriptor);
        }
    }

    /// Takes note of which landmarks the present pair shows and which it should.
    pub(super) fn grow_older(&mut self) {
        for portrait in &mut self.portraits {
            portrait.age += u32::from(portrait.found);
            portrait.missed = if portrait.found {
                0
            } else {
                portrait.missed + 1
            };
        }
    }

    /// A motion that proves not to be the robot's says nothing of those that did not agree with it.
    pub(super) fn forget_doubts(&mut self) {
        for portrait in &mut self.portraits {
            portrait.disagreed = false;
        }
    }

    /// Drops the landmarks that `keep` does not want.
    pub(super) fn retain(&mut self, mut keep: impl FnMut(&Portrait) -> bool) {
        let mut kept = 0;
        for i in 0..self.portraits.len() {
            if !keep(&self.portraits[i]) {
                continue;
            }
            self.portraits[kept] = self.portraits[i];
            for side in [&mut self.left, &mut self.right] {
                let len = side.descriptor_len;
                side.keypoints[kept] = side.keypoints[i];
                side.descriptors
                    .copy_within(i * len..(i + 1) * len, kept * len);
            }
            kept += 1;
        }
        self.portraits.truncate(kept);
        self.matches.truncate(kept);
        for side in [&mut self.left, &mut self.right] {
            side.keypoints.truncate(kept);
            side.descriptors.truncate(kept * side.descriptor_len);
        }
    }

    /// For the matcher.
    pub(super) fn matched(&self) -> MatchedPair<'_> {
        MatchedPair {
            left: &self.left,
            right: &self.right,
            matches: &self.matches,
        }
    }
}

fn of(from: &Described, at: u32) -> (Keypoint, &[f32]) {
    let features = &from.features;
    (
        features.keypoints[at as usize],
        features.descriptor(at as usize),
    )
}
