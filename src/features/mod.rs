//! Features: one raw image in, its keypoints with descriptors out.
//!
//! Positions are raw image pixels (distorted, unrectified), pixel centres at integers.

mod choice;
mod descriptor;
mod draw;
mod extrema;
mod hessian;
mod integral;
#[cfg(feature = "opencv")]
pub mod opencv;
mod orientation;
mod patch;
mod pyramid;
mod spread;
pub mod surf;
mod upright;

pub use choice::{DetectorName, Settings, extractor};

use crate::image::GrayImage;

/// One distinctive point of an image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Keypoint {
    /// Column of the centre, px.
    pub x_px: f32,
    /// Row of the centre, px.
    pub y_px: f32,
    /// Diameter of the meaningful neighbourhood, px (SURF: 9 px at scale 1.2).
    pub size_px: f32,
    /// Dominant direction, rad in [0, 2π), from the x axis towards the y axis (down).
    pub angle_rad: f32,
    /// Strength of the detector's answer (SURF: determinant of the Hessian).
    pub response: f32,
    /// Octave in which it was found, counted from 0.
    pub octave: i32,
    /// Sign of the Laplacian: +1 a dark blob on light ground, −1 the other way, 0 unknown.
    pub laplacian: i8,
    /// Standard deviation of the position in x and y, px, before the run's own variance factor.
    pub sigma_px: f32,
}

/// The features of one image: keypoint `i` has descriptor `i`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Features {
    /// The keypoints.
    pub keypoints: Vec<Keypoint>,
    /// How many floats a descriptor has.
    pub descriptor_len: usize,
    /// All descriptors, one after the other, each of unit length.
    pub descriptors: Vec<f32>,
}

impl Features {
    /// The number of keypoints.
    #[must_use]
    pub fn len(&self) -> usize {
        self.keypoints.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.keypoints.is_empty()
    }

    /// The descriptor of keypoint `index`.
    ///
    /// # Panics
    /// If there is no such keypoint, as a slice index does.
    #[must_use]
    pub fn descriptor(&self, index: usize) -> &[f32] {
        &self.descriptors[index * self.descriptor_len..][..self.descriptor_len]
    }
}

/// Something that finds and describes features: SURF, or one of OpenCV's.
pub trait Extractor: Send {
    /// Finds and describes the features of `image`, replacing what `features` held and re-using its
    /// memory. The same image gives the same bits, whoever calls and in whatever order.
    ///
    /// # Errors
    /// The detector could not do its job; a featureless image is no error.
    fn extract(&mut self, image: &GrayImage, features: &mut Features) -> Result<(), ExtractError>;

    /// Looks from now on for that share of the features, 0 to 1: those that come first where there is a
    /// budget. A detector that cannot looks for all.
    fn set_share(&mut self, share: f32) {
        let _ = share;
    }
}

/// Why a detector could not do its job.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ExtractError {
    /// A library that the detector rests on failed.
    #[error("feature detection with {detector} failed: {cause}")]
    Library {
        /// The detector's name.
        detector: &'static str,
        /// What the library said.
        cause: String,
    },
}

/// Room for `count` elements in all, whatever the vector holds now.
fn make_room<T>(vector: &mut Vec<T>, count: usize) {
    vector.reserve(count.saturating_sub(vector.len()));
}
