//! An estimate or a message in, named columns out: what the odometry CSV and `listen --json` share.

use super::message::{OdometryMessage, flags};
use crate::estimation::{Axes, Counts, Odometry, Status};
use nalgebra::{Isometry3, Matrix6, Quaternion, Translation3, UnitQuaternion};

/// One row of the odometry CSV.
#[derive(Clone, Debug, PartialEq)]
pub struct OdometryRow {
    /// The number of the pair in its recording.
    pub sequence: u64,
    /// When the left image was taken, ns.
    pub timestamp_ns: i64,
    /// How far this estimate can be trusted.
    pub status: Status,
    /// Pose: maps a point of the left camera into the odometry frame, m; w ≥ 0.
    pub odom_from_camera: Isometry3<f64>,
    /// Covariance of the pose; its upper triangle is what is written.
    pub cov_pose: Matrix6<f64>,
    /// Motion since the pair before; w ≥ 0.
    pub prev_from_now: Isometry3<f64>,
    /// Covariance of the motion; its upper triangle is what is written.
    pub cov_motion: Matrix6<f64>,
    /// What the estimate rests on.
    pub counts: Counts,
    /// A-posteriori variance factor; not a number where nothing was measured.
    pub variance_factor: f64,
    /// From the complete pair to the estimate, ms, where it is a property of the run: a replay's
    /// output has none, so that two replays of one recording are the same to the byte.
    pub latency_ms: Option<f64>,
    /// Rises whenever the odometry frame begins anew.
    pub epoch: u32,
    /// Of the noise model: below 0.5 it is fine, above 1 it does not hold; not a number where nothing
    /// was measured.
    pub innovation_ratio: f64,
    /// 1 σ that each part of the error budget gives the pose, m and rad: x, y, z, rx, ry, rz by
    /// detection, then by calibration, synchronisation and bridging.
    pub budget_sigmas: [f64; 24],
    /// Whether the covariance describes the pose's error, to first order.
    pub is_first_order: bool,
    /// Axes of the motion that the images leave open.
    pub undetermined: Axes,
}

/// One value of a row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    /// A whole number.
    Integer(i128),
    /// A word.
    Word(&'static str),
    /// A number.
    Float(f64),
}

/// Names of the columns of [`OdometryRow::budget_sigmas`].
#[rustfmt::skip]
pub const BUDGET_COLUMNS: [&str; 24] = [
    "sigma_detection_x", "sigma_detection_y", "sigma_detection_z",
    "sigma_detection_rx", "sigma_detection_ry", "sigma_detection_rz",
    "sigma_calibration_x", "sigma_calibration_y", "sigma_calibration_z",
    "sigma_calibration_rx", "sigma_calibration_ry", "sigma_calibration_rz",
    "sigma_synchronisation_x", "sigma_synchronisation_y", "sigma_synchronisation_z",
    "sigma_synchronisation_rx", "sigma_synchronisation_ry", "sigma_synchronisation_rz",
    "sigma_bridging_x", "sigma_bridging_y", "sigma_bridging_z",
    "sigma_bridging_rx", "sigma_bridging_ry", "sigma_bridging_rz",
];

/// Where the diagonal stands in an upper triangle.
const DIAGONAL: [usize; 6] = [0, 6, 11, 15, 18, 20];

/// Names of the upper triangle's entries after their first letter, row by row.
const TRIANGLE: [&str; 21] = [
    "00", "01", "02", "03", "04", "05", "11", "12", "13", "14", "15", "22", "23", "24", "25", "33",
    "34", "35", "44", "45", "55",
];

impl OdometryRow {
    /// The row of an estimate, with its latency where that belongs into the file.
    #[must_use]
    pub fn new(odometry: &Odometry, latency_ms: Option<f64>) -> Self {
        Self {
            sequence: odometry.sequence,
            timestamp_ns: odometry.timestamp_ns,
            status: odometry.status,
            odom_from_camera: canonical(&odometry.odom_from_camera),
            cov_pose: odometry.cov_pose,
            prev_from_now: canonical(&odometry.prev_from_now),
            cov_motion: odometry.cov_motion,
            counts: odometry.counts,
            variance_factor: odometry.variance_factor,
            latency_ms,
            epoch: odometry.epoch,
            innovation_ratio: odometry.innovation_ratio,
            budget_sigmas: sigmas(
                odometry
                    .budget
                    .parts()
                    .map(|(_, part)| std::array::from_fn(|i| part[(i, i)])),
            ),
            is_first_order: odometry.is_first_order(),
            undetermined: odometry.undetermined(),
        }
    }

    /// The row of a message; `None` if its status, or an axis, is not defined. The latency of a replay is left
    /// out, as it is in the file.
    #[must_use]
    pub fn from_message(message: &OdometryMessage) -> Option<Self> {
        let total_ns = message.latency_total_ns;
        Some(Self {
            sequence: message.sequence,
            timestamp_ns: message.realtime_ns,
            status: message.status()?,
            odom_from_camera: isometry(message.position_m, message.orientation_xyzw),
            cov_pose: Matrix6::from_row_slice(&message.cov_pose),
            prev_from_now: isometry(message.motion_translation_m, message.motion_rotation_xyzw),
            cov_motion: Matrix6::from_row_slice(&message.cov_motion),
            counts: Counts {
                keypoints_left: message.keypoints_left,
                keypoints_right: message.keypoints_right,
                stereo_matches: message.stereo_matches,
                tracks: message.tracks,
                inliers: message.inliers,
            },
            variance_factor: message.variance_factor,
            latency_ms: (total_ns > 0 && !message.is_replay()).then(|| latency_ms(total_ns)),
            epoch: message.epoch,
            innovation_ratio: message.innovation_ratio,
            budget_sigmas: sigmas(
                message
                    .budget()
                    .map(|(_, _, part)| DIAGONAL.map(|i| part[i])),
            ),
            is_first_order: message.flags & flags::BEYOND_FIRST_ORDER == 0,
            undetermined: Axes::from_bits(message.undetermined)?,
        })
    }

    /// Hands out every column by name, in the order of the CSV.
    pub fn for_each(&self, mut column: impl FnMut(&str, Value)) {
        use Value::{Float, Integer, Word};
        column("seq", Integer(self.sequence.into()));
        column("timestamp_ns", Integer(self.timestamp_ns.into()));
        column("status", Word(self.status.as_str()));
        each_of_pose("", &self.odom_from_camera, &mut column);
        each_of_triangle('c', &self.cov_pose, &mut column);
        each_of_pose("m", &self.prev_from_now, &mut column);
        each_of_triangle('m', &self.cov_motion, &mut column);
        let counts = &self.counts;
        column("keypoints_left", Integer(counts.keypoints_left.into()));
        column("keypoints_right", Integer(counts.keypoints_right.into()));
        column("stereo_matches", Integer(counts.stereo_matches.into()));
        column("tracks", Integer(counts.tracks.into()));
        column("inliers", Integer(counts.inliers.into()));
        column("variance_factor", Float(self.variance_factor));
        column("latency_ms", Float(self.latency_ms.unwrap_or(f64::NAN)));
        column("epoch", Integer(self.epoch.into()));
        column("innovation_ratio", Float(self.innovation_ratio));
        for (name, sigma) in BUDGET_COLUMNS.into_iter().zip(self.budget_sigmas) {
            column(name, Float(sigma));
        }
        column("first_order", Integer(i128::from(self.is_first_order)));
        column("undetermined", Integer(self.undetermined.bits().into()));
    }
}

/// Standard deviations from the variances of each part of the budget.
fn sigmas(parts: [[f64; 6]; 4]) -> [f64; 24] {
    let mut variances = parts.into_iter().flatten();
    std::array::from_fn(|_| variances.next().map_or(0.0, |v| v.max(0.0).sqrt()))
}

/// Nanoseconds as the milliseconds of `latency_ms`.
#[must_use]
pub fn latency_ms(ns: u64) -> f64 {
    ns as f64 / 1e6
}

/// A rotation's quaternion x, y, z, w with the sign that makes it unique: the last component that
/// is not zero is positive.
#[must_use]
pub fn canonical_xyzw(rotation: &UnitQuaternion<f64>) -> [f64; 4] {
    let xyzw = [rotation.i, rotation.j, rotation.k, rotation.w];
    let decisive = xyzw.iter().rev().find(|v| **v != 0.0);
    if decisive.is_some_and(|v| *v < 0.0) {
        xyzw.map(|v| -v)
    } else {
        xyzw
    }
}

/// The upper triangle of a matrix, row by row.
#[must_use]
pub fn upper_triangle(m: &Matrix6<f64>) -> [f64; 21] {
    let mut entries = (0..6).flat_map(|i| (i..6).map(move |j| (i, j)));
    std::array::from_fn(|_| entries.next().map_or(0.0, |at| m[at]))
}

/// The symmetric matrix with this upper triangle.
#[must_use]
pub fn from_upper_triangle(triangle: &[f64; 21]) -> Matrix6<f64> {
    let mut m = Matrix6::zeros();
    let entries = (0..6).flat_map(|i| (i..6).map(move |j| (i, j)));
    for ((i, j), value) in entries.zip(triangle) {
        m[(i, j)] = *value;
        m[(j, i)] = *value;
    }
    m
}

/// A transform of exactly these numbers, of which the last four are taken to be of unit length.
pub(super) fn isometry(translation_m: [f64; 3], xyzw: [f64; 4]) -> Isometry3<f64> {
    let [x, y, z, w] = xyzw;
    Isometry3::from_parts(
        Translation3::from(translation_m),
        UnitQuaternion::new_unchecked(Quaternion::new(w, x, y, z)),
    )
}

fn canonical(a_from_b: &Isometry3<f64>) -> Isometry3<f64> {
    isometry(
        a_from_b.translation.vector.into(),
        canonical_xyzw(&a_from_b.rotation),
    )
}

fn each_of_pose(prefix: &str, pose: &Isometry3<f64>, column: &mut impl FnMut(&str, Value)) {
    let names = match prefix {
        "m" => ["mtx", "mty", "mtz", "mqx", "mqy", "mqz", "mqw"],
        _ => ["tx", "ty", "tz", "qx", "qy", "qz", "qw"],
    };
    let t = &pose.translation.vector;
    let [qx, qy, qz, qw] = canonical_xyzw(&pose.rotation);
    for (name, value) in names.into_iter().zip([t.x, t.y, t.z, qx, qy, qz, qw]) {
        column(name, Value::Float(value));
    }
}

fn each_of_triangle(letter: char, m: &Matrix6<f64>, column: &mut impl FnMut(&str, Value)) {
    let mut name = [0; 3];
    for (digits, value) in TRIANGLE.into_iter().zip(upper_triangle(m)) {
        let name = {
            name[0] = letter as u8;
            name[1..].copy_from_slice(digits.as_bytes());
            std::str::from_utf8(&name).unwrap_or(digits)
        };
        column(name, Value::Float(value));
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::capture::MAX_STAMP_NS;
    use crate::estimation::ErrorBudget;
    use crate::geometry::{se3, so3};
    use nalgebra::{Vector3, Vector6};
    use proptest::prelude::*;

    /// Any finite number, of every size down to the smallest and up to the largest.
    pub(crate) fn any_finite() -> impl Strategy<Value = f64> {
        use prop::num::f64::{NEGATIVE, NORMAL, POSITIVE, SUBNORMAL, ZERO};
        POSITIVE | NEGATIVE | NORMAL | SUBNORMAL | ZERO
    }

    fn any_symmetric() -> impl Strategy<Value = Matrix6<f64>> {
        prop::array::uniform21(any_finite()).prop_map(|t| from_upper_triangle(&t))
    }

    fn any_isometry() -> impl Strategy<Value = Isometry3<f64>> {
        prop::array::uniform6(-3.0..3.0_f64).prop_map(|v| {
            se3::exp(&Vector6::from(v)) * Isometry3::translation(50.0 * v[0], v[1], 9.0 * v[2])
        })
    }

    pub(crate) fn any_status() -> impl Strategy<Value = Status> {
        prop::sample::select(vec![
            Status::Initializing,
            Status::Tracking,
            Status::Degraded,
            Status::Lost,
        ])
    }

    prop_compose! {
        pub(crate) fn any_odometry()(
            (sequence, timestamp_ns, epoch) in (any::<u64>(), 1 - MAX_STAMP_NS..MAX_STAMP_NS, any::<u32>()),
            status in any_status(),
            (odom_from_camera, prev_from_now) in (any_isometry(), any_isometry()),
            (cov_pose, cov_motion, cov_twist) in (any_symmetric(), any_symmetric(), any_symmetric()),
            twist in prop::array::uniform6(-4.0..4.0_f64),
            (detection, calibration) in (any_symmetric(), any_symmetric()),
            (synchronisation, bridging) in (any_symmetric(), any_symmetric()),
            n in any::<[u32; 5]>(),
            (variance_factor, innovation_ratio) in (any_finite(), any_finite()),
        ) -> Odometry {
            Odometry {
                sequence, timestamp_ns, epoch, status, odom_from_camera, cov_pose, prev_from_now,
                cov_motion, twist: Vector6::from(twist), cov_twist,
                budget: ErrorBudget { detection, calibration, synchronisation, bridging },
                counts: Counts {
                    keypoints_left: n[0], keypoints_right: n[1], stereo_matches: n[2],
                    tracks: n[3], inliers: n[4],
                },
                variance_factor,
                innovation_ratio,
            }
        }
    }

    /// An estimate as it might occur, different for each number.
    pub(crate) fn sample_odometry(sequence: u64) -> Odometry {
        let s = sequence as f64;
        let spread = Matrix6::from_fn(|i, j| if i == j { 0.01 } else { 1e-4 / (1.0 + s) });
        Odometry {
            sequence,
            timestamp_ns: 1_700_000_000_000_000_000 + 50_000_000 * sequence as i64,
            epoch: 1,
            status: Status::Tracking,
            odom_from_camera: Isometry3::from_parts(
                Translation3::new(0.1 * s, -0.003 * s, s.sqrt()),
                so3::exp(&Vector3::new(0.01 * s, 0.3, -0.2)),
            ),
            cov_pose: spread * (1.0 + s),
            prev_from_now: Isometry3::translation(0.1, -0.003, 0.02),
            cov_motion: spread,
            twist: Vector6::new(2.0, 0.0, 0.4, 0.2, 0.0, 0.0),
            cov_twist: spread * 3.0,
            budget: ErrorBudget {
                detection: spread * (1.0 + s),
                calibration: spread * 0.1,
                synchronisation: Matrix6::zeros(),
                bridging: Matrix6::zeros(),
            },
            counts: Counts {
                keypoints_left: 900,
                keypoints_right: 880,
                stereo_matches: 500,
                tracks: 300,
                inliers: 260,
            },
            variance_factor: 1.0 / 3.0,
            innovation_ratio: 0.2,
        }
    }

    proptest! {
        #[test]
        fn a_message_gives_the_row_of_its_estimate(odometry in any_odometry()) {
            use crate::output::message::{CaptureTime, Latencies};
            let stamp = CaptureTime::Recorded(odometry.timestamp_ns);
            let message = OdometryMessage::new(&odometry, None, stamp, Latencies::default());
            let row = OdometryRow::from_message(&message);
            prop_assert_eq!(row, Some(OdometryRow::new(&odometry, None)));
        }

        #[test]
        fn both_quaternions_of_a_rotation_are_written_alike(q in any_isometry()) {
            let q = q.rotation;
            let other = UnitQuaternion::new_unchecked(-q.into_inner());
            prop_assert_eq!(canonical_xyzw(&q), canonical_xyzw(&other));
            prop_assert!(canonical_xyzw(&q)[3] >= 0.0);
        }

        #[test]
        fn triangle_and_matrix_hold_the_same(m in any_symmetric()) {
            prop_assert_eq!(from_upper_triangle(&upper_triangle(&m)), m);
        }
    }

    #[test]
    fn half_turns_have_one_sign() {
        let half_turn = |s: f64| UnitQuaternion::new_unchecked(Quaternion::new(0.0, s, 0.0, 0.0));
        assert_eq!(canonical_xyzw(&half_turn(-1.0))[0], 1.0);
        assert_eq!(canonical_xyzw(&half_turn(1.0))[0], 1.0);
    }
}
