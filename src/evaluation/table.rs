//! An evaluation in, the text that a person reads out.

use super::consistency::{Anees, Consistency, LEVEL};
use super::segments::SegmentErrors;
use super::statistics::Statistics;
use super::{Evaluation, StatusCounts};
use std::fmt::{Display, Formatter, Result};

impl Display for Evaluation {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        write!(
            f,
            "{} poses, {} with truth, {:.3} m of path",
            self.poses, self.associated, self.path_m
        )?;
        if let Some(status) = &self.status {
            write!(f, "; {status}")?;
        }
        writeln!(f)?;
        let percent = 100.0 * self.end_error_m / self.path_m;
        write!(f, "end position off by {:.3} m", self.end_error_m)?;
        if percent.is_finite() {
            write!(f, ", {percent:.3} % of the path")?;
        }
        writeln!(f, " (first poses brought together)")?;
        self.write_segments(f)?;
        self.write_pose_errors(f)?;
        if let Some(consistency) = &self.consistency {
            write_consistency(f, consistency)?;
        }
        if !self.notes.is_empty() || !self.errors.is_empty() {
            writeln!(f)?;
        }
        for note in &self.notes {
            writeln!(f, "note: {note}")?;
        }
        for error in &self.errors {
            writeln!(f, "error: {error}")?;
        }
        Ok(())
    }
}

impl Display for StatusCounts {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        write!(
            f,
            "{} initializing, {} tracking, {} degraded, {} lost",
            self.initializing, self.tracking, self.degraded, self.lost
        )
    }
}

impl Evaluation {
    fn write_segments(&self, f: &mut Formatter<'_>) -> Result {
        writeln!(
            f,
            "\nKITTI segment errors, a segment every {}",
            match self.segments.step {
                1 => "frame".to_owned(),
                step => format!("{step} frames"),
            }
        )?;
        writeln!(
            f,
            "{:>12} {:>10} {:>15} {:>16}",
            "length m", "segments", "translation %", "rotation deg/m"
        )?;
        for errors in &self.segments.by_length {
            write_segment_row(f, errors)?;
        }
        write_segment_row(f, &self.segments.all)
    }

    fn write_pose_errors(&self, f: &mut Formatter<'_>) -> Result {
        writeln!(f, "\n{:<22}{HEADINGS}", "Absolute error (ATE)")?;
        for ate in &self.ate {
            let scale = match ate.scale {
                1.0 => String::new(),
                scale => format!("  scale {scale:.6}"),
            };
            let how = match ate.alignment {
                super::Alignment::None => "not aligned",
                super::Alignment::First => "first pose",
                super::Alignment::Se3 => "SE(3) aligned",
                super::Alignment::Sim3 => "Sim(3) aligned",
            };
            write_statistics(f, &format!("{how}, m"), &ate.translation_m, &scale)?;
            write_statistics(f, &format!("{how}, deg"), &ate.rotation_deg, "")?;
        }
        if let Some(rpe) = &self.rpe {
            writeln!(f, "\n{:<22}{HEADINGS}", "Relative error (RPE)")?;
            write_statistics(f, "frame to frame, m", &rpe.translation_m, "")?;
            write_statistics(f, "frame to frame, deg", &rpe.rotation_deg, "")?;
        }
        Ok(())
    }
}

fn write_segment_row(f: &mut Formatter<'_>, errors: &SegmentErrors) -> Result {
    let length = match errors.length_m {
        Some(length_m) => format!("{length_m}"),
        None => "all".to_owned(),
    };
    write!(f, "{length:>12} {:>10} ", errors.segments)?;
    match (errors.translation_percent, errors.rotation_deg_per_m) {
        (Some(translation), Some(rotation)) => writeln!(f, "{translation:>15.4} {rotation:>16.6}"),
        _ => writeln!(f, "{:>32}", "no segment: path too short"),
    }
}

/// Above the columns of [`write_statistics`].
const HEADINGS: &str =
    "        rmse         mean       median          std          min          max            sse";

fn write_statistics(f: &mut Formatter<'_>, name: &str, s: &Statistics, after: &str) -> Result {
    writeln!(
        f,
        "  {name:<20}{:>12.6} {:>12.6} {:>12.6} {:>12.6} {:>12.6} {:>12.6} {:>14.6}{after}",
        s.rmse, s.mean, s.median, s.std, s.min, s.max, s.sse
    )
}

fn write_consistency(f: &mut Formatter<'_>, consistency: &Consistency) -> Result {
    let motion = &consistency.increments;
    let percent = 100.0 * LEVEL;
    writeln!(
        f,
        "\nConsistency of the motions: {} judged; left out: {} initializing, {} lost, {} without truth, {} with a bad covariance",
        motion.samples,
        motion.initializing,
        motion.lost,
        motion.without_truth,
        motion.bad_covariances
    )?;
    let parts = [
        ("all 6", &motion.full),
        ("translation", &motion.translation),
        ("rotation", &motion.rotation),
    ];
    if parts.iter().any(|(_, part)| part.is_some()) {
        writeln!(
            f,
            "  {:<14}{:>10}  {:<20}{:>10}  {:<18}",
            "",
            "ANEES",
            format!("{percent} % interval"),
            "coverage",
            format!("of {percent} % (interval)")
        )?;
    }
    for (name, part) in parts {
        if let Some(part) = part {
            write_anees(f, name, part)?;
        }
    }
    if let Some(white) = &motion.whiteness {
        let verdict = match white.autocorrelation.abs() <= white.limit {
            true => "white",
            false => {
                "not white: neighbouring motions share errors, so the intervals above hold only roughly"
            }
        };
        writeln!(
            f,
            "  lag-1 autocorrelation {:+.3}, ±{:.3} allowed over {} pairs: {verdict}",
            white.autocorrelation, white.limit, white.pairs
        )?;
    }
    write_axes(f, consistency)?;
    write_accumulated(f, consistency)
}

fn write_anees(f: &mut Formatter<'_>, name: &str, part: &Anees) -> Result {
    let interval = format!("[{:.3}, {:.3}]", part.interval.0, part.interval.1);
    let coverage = format!(
        "[{:.1} %, {:.1} %]",
        100.0 * part.coverage_interval.0,
        100.0 * part.coverage_interval.1
    );
    writeln!(
        f,
        "  {name:<14}{:>10.3}  {interval:<20}{:>8.1} %  {coverage:<20} {}",
        part.anees,
        100.0 * part.coverage,
        part.verdict
    )
}

fn write_axes(f: &mut Formatter<'_>, consistency: &Consistency) -> Result {
    let axes = &consistency.increments.axes;
    if axes.is_empty() {
        return Ok(());
    }
    writeln!(
        f,
        "  {:<14}{:>14} {:>14} {:>14} {:>14} {:>10}",
        "axis", "rms error", "rms sigma", "mean err/σ", "rms err/σ", "lag-1"
    )?;
    for (index, axis) in axes.iter().enumerate() {
        // Millimetres and millidegrees: what the errors of single steps are made of.
        let (unit, factor) = match index {
            0..3 => ("mm", 1e3),
            _ => ("mdeg", 1e3_f64.to_degrees()),
        };
        let name = format!("{} {unit}", axis.name);
        let lag = match axis.autocorrelation {
            Some(lag) => format!("{lag:+.3}"),
            None => String::new(),
        };
        writeln!(
            f,
            "    {name:<12}{:>14.3} {:>14.3} {:>+14.3} {:>14.3} {lag:>10}",
            factor * axis.rms_error,
            factor * axis.rms_sigma,
            axis.mean_normalised,
            axis.rms_normalised
        )?;
    }
    Ok(())
}

fn write_accumulated(f: &mut Formatter<'_>, consistency: &Consistency) -> Result {
    let pose = &consistency.pose;
    writeln!(
        f,
        "\nConsistency of the accumulated pose: {} judged",
        pose.samples
    )?;
    let (Some(end), Some(mean), Some(coverage)) =
        (&pose.end, pose.mean_nees_per_dof, pose.coverage)
    else {
        return Ok(());
    };
    let inside = match end.nees <= end.nees_limit {
        true => "inside",
        false => "outside",
    };
    writeln!(
        f,
        "  end (seq {}): NEES {:.3}, {inside} its {} % ellipsoid (limit {:.3}); NEES/3 translation {:.3}, rotation {:.3}",
        end.sequence,
        end.nees,
        100.0 * LEVEL,
        end.nees_limit,
        end.translation_nees_per_dof,
        end.rotation_nees_per_dof
    )?;
    writeln!(
        f,
        "  along the run: mean NEES/6 {mean:.3}, coverage {:.1} %. One run is one sample of the accumulated pose: no interval applies",
        100.0 * coverage
    )
}
