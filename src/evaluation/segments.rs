//! Paired poses in, KITTI's segment errors out: drift in % and deg/m over fixed lengths of path.
//!
//! The formula of the KITTI odometry benchmark's development kit (Geiger, Lenz, Urtasun, *Are we
//! ready for autonomous driving?*, CVPR 2012): a segment begins at a frame and ends at the first
//! frame that lies farther along the true path than its length; its error is that of the motion
//! from beginning to end, divided by the length.

use super::alignment::angle_between;
use nalgebra::Isometry3;

/// The lengths of the benchmark, m.
pub const KITTI_LENGTHS_M: [f64; 8] = [100., 200., 300., 400., 500., 600., 700., 800.];

/// The mean errors of all segments, or of those of one length.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct SegmentErrors {
    /// Length of each segment, m; `None` for the mean over all lengths.
    pub length_m: Option<f64>,
    /// How many segments there are.
    pub segments: usize,
    /// Mean error of the translation, % of the length; `None` without a segment.
    pub translation_percent: Option<f64>,
    /// Mean error of the rotation, deg per metre of the length; `None` without a segment.
    pub rotation_deg_per_m: Option<f64>,
}

/// The segment errors of a run: over all lengths, and by length in the order asked for.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct SegmentReport {
    /// Frames from one segment's beginning to the next one's.
    pub step: usize,
    /// The mean over all segments of all lengths.
    pub all: SegmentErrors,
    /// The mean over the segments of each length.
    pub by_length: Vec<SegmentErrors>,
}

/// One segment's error.
struct Segment {
    length: usize,
    translation_percent: f64,
    rotation_deg_per_m: f64,
}

/// The segment errors of paired poses. No segment spans two runs.
#[must_use]
pub fn segment_errors<'a>(
    runs: impl Iterator<Item = (&'a [Isometry3<f64>], &'a [Isometry3<f64>])>,
    lengths_m: &[f64],
    step: usize,
) -> SegmentReport {
    let mut segments = Vec::new();
    for (estimate, truth) in runs {
        segments_of_run(estimate, truth, lengths_m, step.max(1), &mut segments);
    }
    let by_length = (0..lengths_m.len())
        .map(|i| {
            mean(
                Some(lengths_m[i]),
                segments.iter().filter(|s| s.length == i),
            )
        })
        .collect();
    SegmentReport {
        step: step.max(1),
        all: mean(None, segments.iter()),
        by_length,
    }
}

fn segments_of_run(
    estimate: &[Isometry3<f64>],
    truth: &[Isometry3<f64>],
    lengths_m: &[f64],
    step: usize,
    segments: &mut Vec<Segment>,
) {
    let path_m = path_lengths_m(truth);
    for first in (0..truth.len()).step_by(step) {
        for (length, &length_m) in lengths_m.iter().enumerate() {
            let end_m = path_m[first] + length_m;
            // The path never shrinks, so the first frame beyond the end is found by halving.
            let last = path_m.partition_point(|&path| path <= end_m);
            if last == truth.len() {
                continue;
            }
            let motion = estimate[first].inv_mul(&estimate[last]);
            let error = motion.inv_mul(&truth[first].inv_mul(&truth[last]));
            let angle_rad = angle_between(&Isometry3::identity(), &error);
            segments.push(Segment {
                length,
                translation_percent: 100.0 * error.translation.vector.norm() / length_m,
                rotation_deg_per_m: angle_rad.to_degrees() / length_m,
            });
        }
    }
}

fn mean<'a>(length_m: Option<f64>, of: impl Iterator<Item = &'a Segment>) -> SegmentErrors {
    let (mut count, mut translation, mut rotation) = (0_usize, 0.0, 0.0);
    for segment in of {
        count += 1;
        translation += segment.translation_percent;
        rotation += segment.rotation_deg_per_m;
    }
    let average = |sum: f64| (count > 0).then(|| sum / count as f64);
    SegmentErrors {
        length_m,
        segments: count,
        translation_percent: average(translation),
        rotation_deg_per_m: average(rotation),
    }
}

/// How far along the path each pose lies, m.
#[must_use]
pub fn path_lengths_m(poses: &[Isometry3<f64>]) -> Vec<f64> {
    let mut path_m = 0.0;
    let mut before = poses.first();
    poses
        .iter()
        .map(|pose| {
            if let Some(before) = before {
                path_m += (pose.translation.vector - before.translation.vector).norm();
            }
            before = Some(pose);
            path_m
        })
        .collect()
}
