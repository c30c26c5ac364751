//! A landmark: a point that stays where it is, with what saw it.

use super::super::{StereoMeasurement, sight};
use super::Seen;
use crate::geometry::StereoRig;
use nalgebra::{Isometry3, Matrix3, Matrix4, Vector2, Vector3, Vector4};

/// Names a landmark for as long as it is tracked; later ones are larger.
pub type LandmarkId = u64;

/// One frame's sight of a landmark.
#[derive(Clone, Copy, Debug)]
pub struct Observation {
    /// The frame's serial.
    pub serial: u64,
    /// Where it was seen.
    pub measurement: StereoMeasurement,
    /// How much of the landmark's relief is in that, on the left and on the right, px.
    pub relief_px: Vector2<f64>,
}

impl Observation {
    /// What the frame of this serial saw.
    pub(super) fn new(serial: u64, seen: &Seen) -> Self {
        Self {
            serial,
            measurement: seen.measurement,
            relief_px: seen.relief_px,
        }
    }

    /// What the landmark's relief does to the sight, px.
    pub(super) fn by_relief(&self, relief: &Vector2<f64>) -> Vector4<f64> {
        let [left, right] = self.relief_px.into();
        Vector4::new(
            left * relief.x,
            left * relief.y,
            right * relief.x,
            right * relief.y,
        )
    }
}

/// A point in inverse depth in the left camera of the keyframe that first saw it, its *anchor*.
#[derive(Clone, Debug)]
pub struct Landmark {
    /// Its name.
    pub id: LandmarkId,
    /// The serial of its anchor.
    pub anchor: u64,
    /// (x, y, ρ): the point is (x, y, 1) / ρ in the anchor's left camera.
    pub inverse_depth: Vector3<f64>,
    /// By how much its sights are off in x and y because its surface is no plane: σ is 1, its unit what
    /// each sight's `relief_px` says.
    pub relief: Vector2<f64>,
    /// How many unknowns its sights settle: three, and as much of the relief as they tell.
    pub(super) settled: f64,
    /// Covariance of (x, y, ρ), the poses being given.
    pub cov: Matrix3<f64>,
    /// What saw it, the anchor first, in the order of time.
    pub observations: Vec<Observation>,
    /// Sights of it that proved to be wrong.
    pub wrong: u32,
}

impl Landmark {
    /// A landmark that its anchor alone has seen; `calibrated` is the measurement as a rig as
    /// calibrated would have made it. `None` where the sights do not meet.
    #[must_use]
    pub(super) fn new(
        rig: &StereoRig,
        id: LandmarkId,
        anchor: u64,
        measurement: StereoMeasurement,
        calibrated: &StereoMeasurement,
    ) -> Option<Self> {
        let inverse_depth = sight::inverse_depth(rig, calibrated)?;
        let by_point = sight::linearise(rig, &Isometry3::identity(), &inverse_depth)?.by_point;
        let info = Matrix4::from_diagonal(&measurement.sigma_px.map(|s| 1.0 / (s * s)));
        let cov = (by_point.transpose() * info * by_point)
            .cholesky()?
            .inverse();
        Some(Self {
            id,
            anchor,
            inverse_depth,
            relief: Vector2::zeros(),
            settled: 3.0,
            cov,
            observations: Vec::new(),
            wrong: 0,
        })
    }

    /// The landmark with what its anchor saw as the only sight in `sights`, whose memory is used again.
    pub(super) fn with_first_sight(
        mut self,
        mut sights: Vec<Observation>,
        first: Observation,
    ) -> Self {
        sights.clear();
        sights.push(first);
        self.observations = sights;
        self
    }

    /// Takes note of one more sight.
    pub(super) fn observe(&mut self, serial: u64, seen: &Seen) {
        self.observations.push(Observation::new(serial, seen));
    }

    /// Forgets what one frame saw.
    pub(super) fn forget(&mut self, serial: u64) {
        self.observations.retain(|o| o.serial != serial);
    }

    /// Whether a frame saw it.
    pub(super) fn saw(&self, serial: u64) -> bool {
        self.observations.iter().any(|o| o.serial == serial)
    }

    /// The serial of the frame that saw it last.
    #[must_use]
    pub fn last_seen(&self) -> u64 {
        self.observations.last().map_or(self.anchor, |o| o.serial)
    }

    /// The point in another frame: (x, y, ρ) there, and its covariance. `None` where it lies behind
    /// that frame's camera.
    #[must_use]
    pub fn seen_from(
        &self,
        other_from_anchor: &Isometry3<f64>,
    ) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        let rotation = other_from_anchor.rotation.to_rotation_matrix();
        let r = rotation.matrix();
        let t = other_from_anchor.translation.vector;
        let y = self.inverse_depth;
        let p = r * Vector3::new(y.x, y.y, 1.0) + t * y.z;
        if p.z <= 1e-6 {
            return None;
        }
        let moved = Vector3::new(p.x, p.y, y.z) / p.z;
        // d(p.x, p.y, ρ) − moved · dp.z, over p.z.
        let by_p = Matrix3::from_columns(&[r.column(0).into_owned(), r.column(1).into_owned(), t]);
        let mut numerator = by_p;
        numerator.set_row(2, &nalgebra::RowVector3::new(0.0, 0.0, 1.0));
        let jacobian = (numerator - moved * by_p.row(2)) / p.z;
        Some((moved, jacobian * self.cov * jacobian.transpose()))
    }
}
