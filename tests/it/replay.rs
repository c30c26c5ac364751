//! `visod replay` as a user runs it: what it writes, and what becomes of bad images.

use nalgebra::{Isometry3, Matrix6};
use serde_json::Value;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Arc, Mutex, Weak};
use tempfile::TempDir;
use visod::estimation::Status;
use visod::evaluation::read_trajectory;
use visod::geometry::rig_to_toml;
use visod::output::csv::{header_line, read_odometry_csv};
use visod::output::row::OdometryRow;
use visod::simulation::{
    DatasetWriter, SceneName, Settings, Simulation, TrajectoryName, small_rig,
};

/// Pairs of the rendered recording.
pub(crate) const PAIRS: u64 = 12;
/// Largest distance, m, between its path of 0.6 m as it is estimated and as it is: thrice what was
/// measured.
const MAX_ERROR_M: f64 = 0.015;

pub(crate) fn visod() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_visod"));
    command.env_remove("RUST_BACKTRACE");
    command
}

pub(crate) fn stderr_of(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// A small recording of a furnished room: rendered once for all tests that run at the same time.
pub(crate) struct Recording {
    folder: TempDir,
}

impl Recording {
    pub(crate) fn shared() -> Arc<Self> {
        static SHARED: Mutex<Weak<Recording>> = Mutex::new(Weak::new());
        let mut shared = SHARED
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        shared.upgrade().unwrap_or_else(|| {
            let rendered = Arc::new(Self::render());
            *shared = Arc::downgrade(&rendered);
            rendered
        })
    }

    fn render() -> Self {
        let settings = Settings {
            frames: PAIRS,
            ..Settings::default()
        };
        let (scene, way) = (SceneName::Room, TrajectoryName::LoopRoom);
        let simulation = Simulation::new(scene, way, small_rig(), settings).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let mut writer = DatasetWriter::create(folder.path(), simulation.rig()).unwrap();
        for frame in 0..PAIRS {
            let (pair, odom_from_camera) = simulation.pair(frame);
            writer.add(&pair, &odom_from_camera).unwrap();
        }
        writer.finish().unwrap();
        Self { folder }
    }

    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }

    /// A copy to spoil.
    pub(crate) fn copy(&self) -> TempDir {
        let copy = tempfile::tempdir().unwrap();
        for part in ["left", "right"] {
            std::fs::create_dir(copy.path().join(part)).unwrap();
            for entry in std::fs::read_dir(self.path().join(part)).unwrap() {
                let name = Path::new(part).join(entry.unwrap().file_name());
                std::fs::copy(self.path().join(&name), copy.path().join(&name)).unwrap();
            }
        }
        for name in ["rig.toml", "times.txt", "poses.txt"] {
            std::fs::copy(self.path().join(name), copy.path().join(name)).unwrap();
        }
        copy
    }

    fn truth(&self) -> Vec<Isometry3<f64>> {
        true_poses(self.path())
    }
}

pub(crate) fn true_poses(recording: &Path) -> Vec<Isometry3<f64>> {
    let truth = read_trajectory(&recording.join("poses.txt")).unwrap();
    truth.world_from_body
}

/// Everything that a replay leaves behind.
pub(crate) struct Replayed {
    pub(crate) output: Output,
    pub(crate) csv: String,
    pub(crate) rows: Vec<OdometryRow>,
    pub(crate) tum: String,
    pub(crate) summary: Value,
}

impl Replayed {
    pub(crate) fn statuses(&self) -> Vec<Status> {
        self.rows.iter().map(|row| row.status).collect()
    }
}

/// Replays a recording, which must succeed, without publishing unless `more` says where.
pub(crate) fn replay(recording: &Path, more: &[&str]) -> Replayed {
    let results = tempfile::tempdir().unwrap();
    let file = |name: &str| -> PathBuf { results.path().join(name) };
    let mut command = visod();
    command.arg("replay").arg(recording).arg("--json");
    command.arg("--odometry").arg(file("odometry.csv"));
    command.arg("--trajectory").arg(file("trajectory.txt"));
    command.arg("--summary").arg(file("summary.json"));
    let output = command.args(more).output().unwrap();
    assert!(output.status.success(), "{}", stderr_of(&output));
    let read = |name: &str| std::fs::read_to_string(file(name)).unwrap();
    let summary = read("summary.json");
    assert_eq!(summary, String::from_utf8(output.stdout.clone()).unwrap());
    Replayed {
        output,
        csv: read("odometry.csv"),
        rows: read_odometry_csv(&file("odometry.csv")).unwrap(),
        tum: read("trajectory.txt"),
        summary: serde_json::from_str(&summary).unwrap(),
    }
}

/// Without leaving anything in shared memory.
pub(crate) fn replay_quietly(recording: &Path, more: &[&str]) -> Replayed {
    replay(recording, &[&["--no-publish"], more].concat())
}

pub(crate) fn assert_covariances_hold(rows: &[OdometryRow]) {
    for row in rows {
        for (of, cov) in [("pose", row.cov_pose), ("motion", row.cov_motion)] {
            assert_eq!(cov, cov.transpose(), "{of} of seq {}", row.sequence);
            // Entries in m² and rad²: the factorisation needs no common scale.
            let factor = cov.cholesky();
            assert!(
                factor.is_some(),
                "{of} of seq {} is not positive definite: {cov}",
                row.sequence
            );
        }
    }
}

/// Distances between estimate and truth, m; both begin at the same pose.
pub(crate) fn errors_m(rows: &[OdometryRow], truth: &[Isometry3<f64>]) -> Vec<f64> {
    rows.iter()
        .map(|row| {
            let truth = &truth[row.sequence as usize];
            (row.odom_from_camera.translation.vector - truth.translation.vector).norm()
        })
        .collect()
}

fn assert_near_truth(rows: &[OdometryRow], truth: &[Isometry3<f64>]) {
    for (row, error_m) in rows.iter().zip(errors_m(rows, truth)) {
        assert!(error_m < MAX_ERROR_M, "seq {}: {error_m} m", row.sequence);
    }
}

fn position_variance(cov: &Matrix6<f64>) -> f64 {
    cov.fixed_view::<3, 3>(0, 0).trace()
}

/// What a good run of [`PAIRS`] pairs says, but for `lost`.
fn statuses_with(lost: &[usize]) -> Vec<Status> {
    let mut statuses = vec![Status::Tracking; PAIRS as usize];
    statuses[0] = Status::Initializing;
    for &seq in lost {
        statuses[seq] = Status::Lost;
    }
    statuses
}

#[test]
fn a_replay_writes_a_row_a_pair_near_the_truth() {
    let recording = Recording::shared();
    let run = replay_quietly(recording.path(), &[]);
    assert_eq!(stderr_of(&run.output), "");
    assert_eq!(run.csv.lines().next(), Some(header_line().as_str()));
    assert_eq!(run.csv.lines().count() as u64, 1 + PAIRS);
    assert_eq!(run.statuses(), statuses_with(&[]));
    for (seq, row) in (0..).zip(&run.rows) {
        assert_eq!(row.sequence, seq);
        assert_eq!(row.timestamp_ns, 100_000_000 * seq as i64);
        assert_eq!(row.epoch, 0);
        assert!(row.counts.inliers <= row.counts.tracks);
        assert!(row.counts.stereo_matches <= row.counts.keypoints_left);
    }
    assert_covariances_hold(&run.rows);
    assert_near_truth(&run.rows, &recording.truth());
    for pair in run.rows.windows(2) {
        let motion = pair[0].odom_from_camera.inverse() * pair[1].odom_from_camera;
        let same = motion.inverse() * pair[1].prev_from_now;
        // The window learns about the earlier pose, too, once the later one is seen.
        assert!(same.translation.vector.norm() < 2e-3 && same.rotation.angle() < 1e-3);
    }
}

#[test]
fn the_trajectory_is_that_of_the_rows() {
    let recording = Recording::shared();
    let run = replay_quietly(recording.path(), &[]);
    assert_eq!(run.tum.lines().count(), run.rows.len());
    for (line, row) in run.tum.lines().zip(run.csv.lines().skip(1)) {
        let columns: Vec<&str> = row.split(',').collect();
        let (seconds, pose) = line.split_once(' ').unwrap();
        assert_eq!(pose, columns[3..10].join(" "));
        let ns: i64 = columns[1].parse().unwrap();
        let (whole, fraction) = (ns / 1_000_000_000, ns % 1_000_000_000);
        assert_eq!(seconds, format!("{whole}.{fraction:09}"));
    }
}

#[test]
fn the_summary_has_the_figures_of_the_run() {
    let recording = Recording::shared();
    let run = replay_quietly(recording.path(), &[]);
    for (key, expected) in [
        ("pairs", PAIRS),
        ("initializing", 1),
        ("tracking", PAIRS - 1),
        ("degraded", 0),
        ("lost", 0),
        ("unusable", 0),
        ("dropped", 0),
        ("restarts", 0),
        ("published", 0),
        ("publish_failures", 0),
    ] {
        assert_eq!(run.summary[key].as_u64(), Some(expected), "{key}");
    }
    for key in [
        "path_m",
        "wall_s",
        "pairs_per_s",
        "cpu_ms_per_pair",
        "mean_inliers",
    ] {
        let value = run.summary[key].as_f64().unwrap();
        assert!(value > 0.0 && value.is_finite(), "{key}: {value}");
    }
    let recorded_s = run.summary["recorded_s"].as_f64().unwrap();
    assert!((recorded_s - 1.1).abs() < 1e-9, "{recorded_s}");
    let last = run.rows.last().unwrap();
    for axis in 0..3 {
        let of = |key: &str| run.summary[key][axis].as_f64().unwrap();
        let sigma_m = last.cov_pose[(axis, axis)].sqrt();
        assert_eq!(
            of("end_position_m"),
            last.odom_from_camera.translation.vector[axis]
        );
        assert!((of("end_sigma_m") / sigma_m - 1.0).abs() < 1e-12);
    }
    for (n, stage) in ["features", "matching", "estimation", "total"]
        .iter()
        .enumerate()
    {
        let figures = &run.summary["latency_ms"][n];
        assert_eq!(figures["stage"], *stage);
        let ms = ["median", "p99", "max"].map(|key| figures[key].as_f64().unwrap());
        assert!(0.0 < ms[0] && ms[0] <= ms[1] && ms[1] <= ms[2], "{ms:?}");
    }
}

#[test]
fn the_output_is_the_same_to_the_byte_whatever_the_threads_and_the_pace() {
    let recording = Recording::shared();
    let folder = tempfile::tempdir().unwrap();
    let default = replay_quietly(recording.path(), &[]);
    for workers in [1, 3] {
        let config = folder.path().join(format!("{workers}.toml"));
        std::fs::write(&config, format!("[pipeline]\nworkers = {workers}\n")).unwrap();
        let run = replay_quietly(recording.path(), &["--config", config.to_str().unwrap()]);
        assert!(run.csv == default.csv, "{workers} workers: another CSV");
        assert!(
            run.tum == default.tum,
            "{workers} workers: another trajectory"
        );
    }
    let realtime = replay_quietly(recording.path(), &["--pace", "realtime"]);
    assert!(realtime.csv == default.csv, "another CSV in real time");
    assert!(
        realtime.tum == default.tum,
        "another trajectory in real time"
    );
}

#[test]
fn images_that_cannot_be_used_are_bridged() {
    fn keep_half(file: &Path) {
        let bytes = std::fs::read(file).unwrap();
        std::fs::write(file, &bytes[..bytes.len() / 2]).unwrap();
    }
    fn remove(file: &Path) {
        std::fs::remove_file(file).unwrap();
    }
    fn shrink(file: &Path) {
        image::GrayImage::new(160, 120).save(file).unwrap();
    }
    type Spoil = fn(&Path);
    let spoilt: [(&str, &str, Spoil); 7] = [
        ("left missing", "left/000005.png", remove),
        ("right missing", "right/000005.png", remove),
        ("left truncated", "left/000005.png", keep_half),
        ("right truncated", "right/000005.png", keep_half),
        ("left empty", "left/000005.png", |file| {
            std::fs::write(file, "").unwrap();
        }),
        ("right of another size", "right/000005.png", shrink),
        ("left no image", "left/000005.png", |file| {
            std::fs::write(file, "not an image at all\n").unwrap();
        }),
    ];
    let recording = Recording::shared();
    // What calibration is supposed to be off by would hide what a gap adds.
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("visod.toml");
    std::fs::write(&config, "[estimation]\nconsider_calibration = false\n").unwrap();
    let args = ["--config", config.to_str().unwrap()];
    for (what, name, spoil) in spoilt {
        let copy = recording.copy();
        spoil(&copy.path().join(name));
        let run = replay_quietly(copy.path(), &args);
        let said = stderr_of(&run.output);
        assert_eq!(said.lines().count(), 1, "{what}: {said}");
        assert!(said.starts_with("visod: warning: "), "{what}: {said}");
        assert!(said.contains("000005"), "{what}: {said}");
        assert_eq!(run.statuses(), statuses_with(&[5]), "{what}");
        assert_eq!(run.summary["unusable"].as_u64(), Some(1), "{what}");
        assert_eq!(run.rows[5].timestamp_ns, 500_000_000, "{what}");
        let variances = [4, 5, 6].map(|seq: usize| position_variance(&run.rows[seq].cov_pose));
        // A tenth of a second at an unknown change of velocity, beside tenths of a millimetre.
        assert!(variances[1] > 10.0 * variances[0], "{what}: {variances:?}");
        assert!(variances[2] < variances[1] / 10.0, "{what}: {variances:?}");
        assert_covariances_hold(&run.rows);
        assert_near_truth(&run.rows, &recording.truth());
    }
}

#[test]
fn pairs_missing_at_the_ends_and_as_a_whole_do_not_shift_the_others() {
    let recording = Recording::shared();
    let truth = recording.truth();

    let fewer_right = recording.copy();
    for seq in 9..PAIRS {
        std::fs::remove_file(fewer_right.path().join(format!("right/{seq:06}.png"))).unwrap();
    }
    let run = replay_quietly(fewer_right.path(), &[]);
    assert_eq!(run.statuses(), statuses_with(&[9, 10, 11]));
    assert_eq!(run.summary["unusable"].as_u64(), Some(3));
    assert_eq!(stderr_of(&run.output).lines().count(), 3);
    assert_covariances_hold(&run.rows);

    let gap = recording.copy();
    for side in ["left", "right"] {
        std::fs::remove_file(gap.path().join(side).join("000005.png")).unwrap();
    }
    let run = replay_quietly(gap.path(), &[]);
    assert_eq!(run.statuses(), statuses_with(&[5]));
    assert_near_truth(&run.rows, &truth);

    let no_first = recording.copy();
    std::fs::write(no_first.path().join("left/000000.png"), "").unwrap();
    let run = replay_quietly(no_first.path(), &[]);
    assert_eq!(
        run.rows[..2].iter().map(|r| r.status).collect::<Vec<_>>(),
        [Status::Initializing; 2]
    );
    assert_eq!(run.statuses()[2..], statuses_with(&[])[2..]);
    let first_from_odom = truth[1].inverse();
    let truth: Vec<_> = truth.iter().map(|pose| first_from_odom * pose).collect();
    assert_near_truth(&run.rows[1..], &truth);
}

#[test]
fn darkness_is_bridged_with_a_growing_covariance() {
    let folder = tempfile::tempdir().unwrap();
    let (rig, dark) = (folder.path().join("rig.toml"), folder.path().join("dark"));
    std::fs::write(&rig, rig_to_toml(&small_rig())).unwrap();
    let output = visod()
        .args(["simulate", "--scene", "room", "--trajectory", "loop-room"])
        .args([
            "--frames",
            &PAIRS.to_string(),
            "--blackout",
            "5..8",
            "--rig",
        ])
        .args([&rig, &dark])
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", stderr_of(&output));
    let run = replay_quietly(&dark, &[]);
    assert_eq!(run.statuses(), statuses_with(&[5, 6, 7]));
    // A black image is an image.
    assert_eq!(run.summary["unusable"].as_u64(), Some(0));
    let variances: Vec<f64> = run
        .rows
        .iter()
        .map(|r| position_variance(&r.cov_pose))
        .collect();
    for seq in 5..8 {
        assert!(
            variances[seq] > 2.0 * variances[seq - 1],
            "seq {seq}: {variances:?}"
        );
    }
    assert!(variances[8] < variances[5], "{variances:?}");
    assert_covariances_hold(&run.rows);
    let truth = true_poses(&dark);
    assert_near_truth(&run.rows[8..], &truth);
    // While it is bridged the error stays within 3 σ.
    for row in &run.rows[5..8] {
        let error_m = errors_m(std::slice::from_ref(row), &truth)[0];
        assert!(error_m * error_m < 9.0 * position_variance(&row.cov_pose));
    }
}

#[test]
fn a_recording_without_times_is_replayed_with_a_warning() {
    let recording = Recording::shared();
    let copy = recording.copy();
    std::fs::remove_file(copy.path().join("times.txt")).unwrap();
    let run = replay_quietly(copy.path(), &[]);
    let mut expected = String::new();
    writeln!(
        expected,
        "visod: warning: {} has no times: pairs are taken to be 0.1 s apart",
        copy.path().display()
    )
    .unwrap();
    assert_eq!(stderr_of(&run.output), expected);
    // The recording's own times are 0.1 s apart, too.
    assert!(run.csv == replay_quietly(recording.path(), &[]).csv);
}
