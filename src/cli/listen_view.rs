//! What `visod listen` shows on a terminal: the last estimate and how things are, drawn in place.

use crate::output::health::{CameraState, HealthMessage, RigCondition};
use crate::output::message::{OdometryMessage, PoseFrame};
use crate::output::row::OdometryRow;
use console::{Style, Term, truncate_str};
use std::io;
use std::time::{Duration, Instant};

/// Pictures a second at most: more than that nobody reads.
const PERIOD: Duration = Duration::from_millis(66);
/// Width of a bar, characters.
const BAR: usize = 40;
/// The parts of the error budget, in the message's order: each differs in its shade as well as in its
/// colour, so that a bar can be read without either.
const SHADES: [char; 4] = ['█', '▓', '▒', '░'];

/// What there is to show.
pub(super) struct Scene<'a> {
    pub(super) message: &'a OdometryMessage,
    pub(super) rate_hz: Option<f64>,
    /// Messages that came faster than they were read.
    pub(super) lost: u64,
    /// Since the last message.
    pub(super) silence: Duration,
    /// From the publisher to here.
    pub(super) transport_ns: i64,
    pub(super) health: Option<&'a HealthMessage>,
}

/// The colours, or none.
struct Palette {
    title: Style,
    quiet: Style,
    good: Style,
    doubtful: Style,
    bad: Style,
    parts: [Style; 4],
}

impl Palette {
    fn new(colours: bool) -> Self {
        let style = || Style::new().force_styling(colours);
        Self {
            title: style().bold(),
            quiet: style().dim(),
            good: style().cyan(),
            doubtful: style().yellow(),
            bad: style().red().bold(),
            parts: [
                style().blue(),
                style().yellow(),
                style().cyan(),
                style().magenta(),
            ],
        }
    }
}

/// The picture, line by line; nothing where the message's status is not defined.
pub(super) fn picture(scene: &Scene<'_>, colours: bool) -> Vec<String> {
    let palette = Palette::new(colours);
    let Some(row) = OdometryRow::from_message(scene.message) else {
        return Vec::new();
    };
    let mut lines = vec![title(scene, &row, &palette), String::new()];
    lines.extend(pose(&row));
    lines.push(String::new());
    lines.extend(budget(scene.message, &palette));
    lines.push(String::new());
    lines.push(features(&row));
    lines.extend(undetermined(&row, &palette));
    lines.push(latency(scene));
    lines.extend(scene.health.map(|health| state(health, &palette)));
    lines
}

fn title(scene: &Scene<'_>, row: &OdometryRow, palette: &Palette) -> String {
    use crate::estimation::Status::{Degraded, Initializing, Lost, Tracking};
    let style = match row.status {
        Tracking => &palette.good,
        Initializing | Degraded => &palette.doubtful,
        Lost => &palette.bad,
    };
    let frame = match scene.message.frame() {
        Some(PoseFrame::Base) => "robot base",
        _ => "left camera",
    };
    let source = if scene.message.is_replay() {
        "replay"
    } else {
        "live"
    };
    let rate = match (scene.silence >= Duration::from_secs(1), scene.rate_hz) {
        (true, _) => {
            let silence = format!("no data for {:.0} s", scene.silence.as_secs_f64().floor());
            palette.bad.apply_to(silence).to_string()
        }
        (false, Some(rate_hz)) => format!("{rate_hz:.1} Hz"),
        (false, None) => "– Hz".to_owned(),
    };
    let lost = match scene.lost {
        0 => String::new(),
        lost => palette
            .doubtful
            .apply_to(format!("   {lost} messages missed"))
            .to_string(),
    };
    format!(
        "{}  {}  pair {}  epoch {}  {frame}, {source}  {rate}{lost}",
        palette.title.apply_to("visod"),
        style.apply_to(row.status.as_str()),
        row.sequence,
        row.epoch,
    )
}

/// Position and rotation vector ± 1 σ.
fn pose(row: &OdometryRow) -> Vec<String> {
    let t = row.odom_from_camera.translation.vector;
    let r = row.odom_from_camera.rotation.scaled_axis();
    let sigma = |i: usize| row.cov_pose[(i, i)].max(0.0).sqrt();
    ["x", "y", "z"]
        .into_iter()
        .enumerate()
        .map(|(i, axis)| {
            format!(
                "  {axis} {:>10.3} ± {:<8.4} m      r{axis} {:>9.3} ± {:<8.4}°",
                t[i],
                sigma(i),
                r[i].to_degrees(),
                sigma(i + 3).to_degrees(),
            )
        })
        .collect()
}

/// Which source of error the pose's uncertainty is due to, position and rotation, as bars.
fn budget(message: &OdometryMessage, palette: &Palette) -> Vec<String> {
    let parts = message.budget();
    let bar_of = |name: &str, diagonal: [usize; 3]| {
        let variances = parts
            .each_ref()
            .map(|(_, _, part)| diagonal.iter().map(|i| part[*i]).sum::<f64>());
        format!("  {name:<9}{}", bar(variances, palette))
    };
    let key: Vec<String> = (0..4)
        .map(|i| {
            let shade = palette.parts[i].apply_to(SHADES[i]);
            format!("{shade} {}", parts[i].0)
        })
        .collect();
    vec![
        format!("  {:<9}{}", "variance", key.join("  ")),
        bar_of("position", [0, 6, 11]),
        bar_of("rotation", [15, 18, 20]),
    ]
}

/// A bar of which each part has its share.
fn bar(values: [f64; 4], palette: &Palette) -> String {
    let total: f64 = values.iter().sum();
    if total.is_nan() || total <= 0.0 {
        return palette.quiet.apply_to("·".repeat(BAR)).to_string();
    }
    let (mut bar, mut percents) = (String::new(), String::new());
    let (mut sum, mut end) = (0.0, 0);
    for (i, value) in values.into_iter().enumerate() {
        sum += value;
        let begin = std::mem::replace(&mut end, (sum / total * BAR as f64).round() as usize);
        let cells = SHADES[i].to_string().repeat(end - begin.min(end));
        bar.push_str(&palette.parts[i].apply_to(cells).to_string());
        percents.push_str(&format!(" {:>3.0}", 100.0 * value / total));
    }
    format!("{bar} {percents} %")
}

fn features(row: &OdometryRow) -> String {
    let counts = &row.counts;
    format!(
        "  features {} left, {} right → {} matched → {} tracked → {} inliers   variance factor {:.2}, \
         innovation {:.2}",
        counts.keypoints_left,
        counts.keypoints_right,
        counts.stereo_matches,
        counts.tracks,
        counts.inliers,
        row.variance_factor,
        row.innovation_ratio,
    )
}

/// The axes that the images leave open, if there are any.
fn undetermined(row: &OdometryRow, palette: &Palette) -> Option<String> {
    let axes: Vec<&str> = row.undetermined.names().collect();
    let said = || format!("  images do not tell {}", axes.join(", "));
    (!axes.is_empty()).then(|| palette.bad.apply_to(said()).to_string())
}

fn latency(scene: &Scene<'_>) -> String {
    let took = scene.message.latencies();
    let ms = |ns: u64| match ns {
        0 => "–".to_owned(),
        ns => format!("{:.1}", ns as f64 / 1e6),
    };
    format!(
        "  latency {} ms: capture {}, features {}, matching {}, estimation {}; then {:.2} to here",
        ms(took.capture_ns + took.total_ns),
        ms(took.capture_ns),
        ms(took.features_ns),
        ms(took.matching_ns),
        ms(took.estimation_ns),
        scene.transport_ns as f64 / 1e6,
    )
}

/// How the daemon is.
fn state(health: &HealthMessage, palette: &Palette) -> String {
    let camera = |code: u32| {
        let words = ["closed", "opening", "streaming", "stalled", "lost"];
        let word = words.get(code as usize).copied().unwrap_or("unknown");
        let style = match code {
            code if code == CameraState::Streaming as u32 => &palette.good,
            code if code == CameraState::Closed as u32 => &palette.quiet,
            _ => &palette.bad,
        };
        style.apply_to(word).to_string()
    };
    let rig = match health.rig_state {
        code if code == RigCondition::Moved as u32 => "   rig moved",
        code if code == RigCondition::Misfits as u32 => "   rig misfits",
        _ => "",
    };
    format!(
        "  cameras {} and {}   pairs {}, dropped {}, unusable {}, lost {}{}",
        camera(health.left_state),
        camera(health.right_state),
        health.pairs_processed,
        health.pairs_dropped,
        health.pairs_unusable,
        health.pairs_lost,
        palette.bad.apply_to(rig),
    )
}

/// The part of a terminal that is drawn over and over.
pub(super) struct Screen {
    term: Term,
    colours: bool,
    drawn_lines: usize,
    drawn_at: Option<Instant>,
}

impl Screen {
    pub(super) fn new() -> Self {
        Self {
            term: Term::buffered_stdout(),
            colours: console::colors_enabled(),
            drawn_lines: 0,
            drawn_at: None,
        }
    }

    /// Whether it is time for another picture.
    pub(super) fn is_due(&self) -> bool {
        self.drawn_at.is_none_or(|at| at.elapsed() >= PERIOD)
    }

    /// Draws a scene over the last one.
    ///
    /// # Errors
    /// The terminal is gone.
    pub(super) fn draw(&mut self, scene: &Scene<'_>) -> io::Result<()> {
        self.drawn_at = Some(Instant::now());
        let (height, width) = self.term.size();
        let mut lines = picture(scene, self.colours);
        // What does not fit would scroll away, and the next picture would not meet it.
        lines.truncate(usize::from(height).saturating_sub(1).max(1));
        if self.drawn_lines > 0 {
            self.term.move_cursor_up(self.drawn_lines)?;
        }
        self.term.clear_to_end_of_screen()?;
        for line in &lines {
            let line = truncate_str(line, usize::from(width), "…");
            self.term.write_line(&line)?;
        }
        self.drawn_lines = lines.len();
        self.term.flush()
    }

    /// Something else has been written meanwhile: the next picture goes below it.
    pub(super) fn move_on(&mut self) {
        self.drawn_lines = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::message::{CaptureTime, Latencies};
    use crate::output::row::tests::sample_odometry;
    use console::{measure_text_width, strip_ansi_codes};

    fn message() -> OdometryMessage {
        let latencies = Latencies {
            capture_ns: 1_000_000,
            features_ns: 5_500_000,
            matching_ns: 0,
            estimation_ns: 2_000_000,
            total_ns: 9_000_000,
        };
        let mut estimate = sample_odometry(7);
        estimate.budget.detection.fill_with_identity();
        estimate.budget.calibration = estimate.budget.detection * 2.0;
        estimate.budget.synchronisation.fill(0.0);
        estimate.budget.bridging = estimate.budget.detection;
        OdometryMessage::new(&estimate, None, CaptureTime::Recorded(1), latencies)
    }

    fn scene<'a>(message: &'a OdometryMessage, health: Option<&'a HealthMessage>) -> Scene<'a> {
        Scene {
            message,
            rate_hz: Some(19.96),
            lost: 0,
            silence: Duration::ZERO,
            transport_ns: 40_000,
            health,
        }
    }

    #[test]
    fn the_picture_holds_pose_state_rate_latency_and_budget() {
        let (message, health) = (message(), HealthMessage::default());
        let text = picture(&scene(&message, Some(&health)), false).join("\n");
        for part in [
            "pair 7",
            "left camera, replay  20.0 Hz",
            "latency 10.0 ms: capture 1.0, features 5.5, matching –, estimation 2.0; then 0.04 to here",
            "cameras closed and closed",
        ] {
            assert!(text.contains(part), "{part} is not in\n{text}");
        }
        let bar = format!("{}{}{}", "█".repeat(10), "▓".repeat(20), "░".repeat(10));
        assert_eq!(text.matches(&bar).count(), 2, "{text}");
        assert!(text.contains("  25  50   0  25 %"), "{text}");
    }

    #[test]
    fn colours_change_no_letter() {
        let (message, health) = (message(), HealthMessage::default());
        let scene = scene(&message, Some(&health));
        let (plain, coloured) = (picture(&scene, false), picture(&scene, true));
        assert!(plain.iter().all(|line| !line.contains('\x1b')));
        assert!(coloured.iter().any(|line| line.contains('\x1b')));
        for (plain, coloured) in plain.iter().zip(&coloured) {
            assert_eq!(strip_ansi_codes(coloured), *plain);
            assert!(measure_text_width(plain) <= 120, "{plain}");
        }
    }

    #[test]
    fn silence_and_loss_stand_in_the_title() {
        let message = message();
        let silent = Scene {
            silence: Duration::from_millis(3700),
            lost: 12,
            ..scene(&message, None)
        };
        let title = &picture(&silent, false)[0];
        assert!(
            title.contains("no data for 3 s   12 messages missed"),
            "{title}"
        );
    }
}
