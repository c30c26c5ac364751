//! A feature under way: a point that stays where it is, as the present pair of images shows it.

use super::{Landmark, StereoMeasurement};

/// One of the features that an estimate rests on, or that later ones may rest on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackedFeature {
    /// Names the point for as long as it is followed.
    pub id: u64,
    /// Pairs before this one that showed it; 0 where it is new.
    pub age: u32,
    /// Where the present pair shows it.
    pub measurement: StereoMeasurement,
    /// Where it is: in the left camera's frame, with the covariance that the noise of pixels gives it,
    /// the cameras' poses being given.
    pub landmark: Landmark,
}
