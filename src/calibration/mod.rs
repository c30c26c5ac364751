//! Calibration: views of a board in; a rig, and how well each of its parameters is known, out.
//!
//! | module | does |
//! |---|---|
//! | [`Board`], [`View`] | what was shown and what was seen of it |
//! | `detect` | images to views, by OpenCV |
//! | `initial` | a start: homographies (Zhang 2000), one camera at a time |
//! | `normal`, `adjustment` | one joint adjustment of cameras, extrinsics and placements |
//! | `estimate` | the whole: robust fit, outliers, covariance |
//! | `covariance` | what the misses say of the parameters' errors |
//! | [`depth`] | what the rig's covariance means for depths |
//! | [`advice`] | what views are missing, in words |
//! | [`guidance`] | while capturing: which view adds something |
//! | [`report`] | one HTML page |
//! | [`simulated`] | boards before a known rig, as points and as images |
//! | [`formats`] | other tools' files |
//! | [`epipolar`] | images against a rig: does it belong to them? |
//!
//! Errors of a rig are those of [`rig_parameters`](crate::geometry::rig_parameters).

mod adjustment;
pub mod advice;
mod board;
mod covariance;
pub mod depth;
#[cfg(feature = "opencv")]
pub mod detect;
pub mod epipolar;
mod estimate;
pub mod folders;
pub mod formats;
pub mod guidance;
mod homography;
mod initial;
mod lens;
mod normal;
pub mod report;
pub mod simulated;
#[cfg(test)]
mod tests;
mod view;

pub use board::{Board, Pattern};
pub use estimate::{
    Calibration, CalibrationError, LeftOut, OutlierPoint, Residual, Stage, ViewResult, calibrate,
};

pub use lens::Lens;
pub use view::{SeenPoints, View, views_from_csv, views_to_csv};
