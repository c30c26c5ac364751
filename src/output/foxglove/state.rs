//! An estimate in, the numbers that plots want out, as JSON.

use crate::estimation::Odometry;
use crate::output::message::Latencies;
use nalgebra::Matrix6;
use serde_json::{Map, Value, json};

/// What [`of`] writes.
pub(super) const SCHEMA: &str = r#"{
  "title": "visod.State",
  "type": "object",
  "properties": {
    "sequence": {"type": "integer"},
    "epoch": {"type": "integer"},
    "status": {"type": "string"},
    "sigma_position_m": {"type": "number"},
    "sigma_rotation_deg": {"type": "number"},
    "sigma_motion_m": {"type": "number"},
    "variance_factor": {"type": "number"},
    "innovation_ratio": {"type": "number"},
    "undetermined": {"type": "integer"},
    "budget_position_percent": {"type": "object"},
    "budget_rotation_percent": {"type": "object"},
    "latency_ms": {"type": "object"},
    "counts": {"type": "object"}
  }
}"#;

/// σ of position and rotation (the root of the three variances' sum), shares of the error budget, latencies
/// and counts. What is no number is `null`.
pub(super) fn of(estimate: &Odometry, latencies: &Latencies) -> Value {
    let counts = &estimate.counts;
    let ms = |ns: u64| ns as f64 / 1e6;
    json!({
        "sequence": estimate.sequence,
        "epoch": estimate.epoch,
        "status": estimate.status.as_str(),
        "sigma_position_m": variance(&estimate.cov_pose, 0).sqrt(),
        "sigma_rotation_deg": variance(&estimate.cov_pose, 3).sqrt().to_degrees(),
        "sigma_motion_m": variance(&estimate.cov_motion, 0).sqrt(),
        "variance_factor": estimate.variance_factor,
        "innovation_ratio": estimate.innovation_ratio,
        "undetermined": estimate.undetermined().bits(),
        "budget_position_percent": shares(estimate, 0),
        "budget_rotation_percent": shares(estimate, 3),
        "latency_ms": {
            "capture": ms(latencies.capture_ns),
            "features": ms(latencies.features_ns),
            "matching": ms(latencies.matching_ns),
            "estimation": ms(latencies.estimation_ns),
            "total": ms(latencies.total_ns),
        },
        "counts": {
            "keypoints_left": counts.keypoints_left,
            "keypoints_right": counts.keypoints_right,
            "stereo_matches": counts.stereo_matches,
            "tracks": counts.tracks,
            "inliers": counts.inliers,
        },
    })
}

/// Of three coordinates from `first` on.
fn variance(cov: &Matrix6<f64>, first: usize) -> f64 {
    (first..first + 3).map(|i| cov[(i, i)]).sum()
}

/// Each source's share in that of the whole, per cent.
fn shares(estimate: &Odometry, first: usize) -> Value {
    let whole = variance(&estimate.budget.total(), first);
    let parts = estimate.budget.parts();
    let shares = parts.map(|(name, part)| {
        let percent = 100.0 * variance(part, first) / whole;
        (name.to_owned(), json!(percent))
    });
    Value::Object(Map::from_iter(shares))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::row::tests::sample_odometry;

    #[test]
    fn every_number_stands_under_the_name_that_the_schema_has() {
        let mut estimate = sample_odometry(3);
        estimate.budget.detection.fill_with_identity();
        estimate.budget.calibration = estimate.budget.detection * 3.0;
        estimate.budget.synchronisation.fill(0.0);
        estimate.budget.bridging.fill(0.0);
        estimate.variance_factor = f64::NAN;
        let latencies = Latencies {
            total_ns: 2_500_000,
            ..Latencies::default()
        };
        let state = of(&estimate, &latencies);
        let schema: Value = serde_json::from_str(SCHEMA).unwrap();
        let names = |v: &Value| v.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        assert_eq!(names(&state), names(&schema["properties"]));
        assert_eq!(state["budget_position_percent"]["calibration"], 75.0);
        assert_eq!(state["budget_rotation_percent"]["detection"], 25.0);
        assert_eq!(state["latency_ms"]["total"], 2.5);
        assert!(state["variance_factor"].is_null());
    }
}
