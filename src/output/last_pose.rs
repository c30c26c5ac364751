//! Rows in; a small file that outlives the process out, and in the next run what it says.
//!
//! The file holds the number of the run's last epoch, so that epochs rise from run to run, and the last pose
//! that was known with its covariance. While the run lasts, the number is some epochs ahead: a run that is killed
//! may have begun epochs that the file never heard of. Writing it is somebody's work beside the pipeline, which only
//! leaves a copy of its latest pose here; it is written to a file beside it first and then renamed, so that a loss of
//! power leaves either the old one or the new one.

use crate::estimation::{Odometry, Start, Status};
use crate::settings::SettingError;
use crate::text_file;
use nalgebra::{Isometry3, Matrix6, Quaternion, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// The version of the file's layout.
const VERSION: u32 = 1;
/// By how much a quaternion's length may differ from 1.
const MAX_LENGTH_ERROR: f64 = 1e-6;

/// The settings of `[last_pose]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// The file that keeps the last pose and its epoch from run to run. Path; relative to the configuration's
    /// own folder. Default none: every run begins at the origin, with epoch 0.
    pub file: Option<PathBuf>,
    /// Begin where the last run ended instead of at the origin. Yes or no, default no: whoever moves the robot
    /// while the daemon is down has to know that it guesses.
    pub restore: bool,
    /// Time between two writings of the file. s, 1 to 3600, default 10: spares the disk.
    pub every_s: f64,
    /// Age beyond which a pose is not restored. s, 1 to 86400, default 300: beyond, the robot may be anywhere.
    pub max_age_s: f64,
    /// 1 σ of the robot's speed along an axis while nothing was seen. m/s, 0 to 100, default 0.5: one that
    /// drives as fast as people walk.
    pub sigma_speed_m_s: f64,
    /// 1 σ of its turn about an axis while nothing was seen. rad/s, 0 to 10, default 0.2: likewise.
    pub sigma_turn_rad_s: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            file: None,
            restore: false,
            every_s: 10.0,
            max_age_s: 300.0,
            sigma_speed_m_s: 0.5,
            sigma_turn_rad_s: 0.2,
        }
    }
}

impl Settings {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn check(&self) -> Result<(), SettingError> {
        if self.restore && self.file.is_none() {
            return Err(SettingError {
                key: "restore",
                cause: "takes last_pose.file, which says where the last pose is kept".to_owned(),
            });
        }
        SettingError::unless_in("every_s", self.every_s, 1.0..=3600.0)?;
        SettingError::unless_in("max_age_s", self.max_age_s, 1.0..=86_400.0)?;
        SettingError::unless_in("sigma_speed_m_s", self.sigma_speed_m_s, 0.0..=100.0)?;
        SettingError::unless_in("sigma_turn_rad_s", self.sigma_turn_rad_s, 0.0..=10.0)
    }
}

/// What the file holds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    version: u32,
    epoch: u32,
    pose: Option<KnownPose>,
}

/// A pose of the past: of the left camera in the odometry frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct KnownPose {
    /// CLOCK_REALTIME, which goes on while the computer is off.
    realtime_ns: i64,
    position_m: [f64; 3],
    quaternion_xyzw: [f64; 4],
    /// Of the error `[t_est − t ; Log(R_est Rᵀ)]`.
    covariance: [[f64; 6]; 6],
}

impl KnownPose {
    fn of(odometry: &Odometry, realtime_ns: i64) -> Self {
        let pose = &odometry.odom_from_camera;
        Self {
            realtime_ns,
            position_m: pose.translation.vector.into(),
            quaternion_xyzw: pose.rotation.coords.into(),
            covariance: odometry.cov_pose.into(),
        }
    }

    /// The pose and its covariance, if they are such.
    fn checked(&self) -> Result<(Isometry3<f64>, Matrix6<f64>), String> {
        let quaternion = Quaternion::from(self.quaternion_xyzw);
        let is_of_length_one = (quaternion.norm() - 1.0).abs() < MAX_LENGTH_ERROR;
        if !is_of_length_one {
            return Err("quaternion_xyzw is not of length 1".to_owned());
        }
        let position = Vector3::from(self.position_m);
        if !position.iter().all(|x| x.is_finite()) {
            return Err("position_m is no position".to_owned());
        }
        let cov = Matrix6::from(self.covariance);
        let is_symmetric = (cov - cov.transpose()).amax() <= 1e-9 * cov.amax();
        if !is_symmetric || cov.cholesky().is_none() {
            return Err("covariance is none: not symmetric and positive".to_owned());
        }
        let rotation = UnitQuaternion::from_quaternion(quaternion);
        Ok((
            Isometry3::from_parts(Translation3::from(position), rotation),
            cov,
        ))
    }
}

/// What the run before has left.
#[derive(Clone, Debug, Default)]
pub struct Legacy {
    /// The epoch that this run begins with.
    pub epoch: u32,
    /// Where it begins, if not at the origin.
    pub start: Option<Start>,
    /// Why it begins at the origin although a pose was to be restored, or what is wrong with the file.
    pub warning: Option<String>,
    pose: Option<KnownPose>,
}

impl Legacy {
    /// Reads what the run before has left, at the time `realtime_ns`. Whatever is wrong with it is a warning,
    /// and this run begins afresh.
    #[must_use]
    pub fn read(settings: &Settings, realtime_ns: i64) -> Self {
        let Some(file) = &settings.file else {
            return Self::default();
        };
        let afresh = |epoch, pose, why: &str| Self {
            epoch,
            pose,
            start: None,
            warning: Some(format!("{}: {why}", file.display())),
        };
        let kept = match load(file) {
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Self::default(),
            Err(e) => {
                return afresh(
                    0,
                    None,
                    &format!("the last pose cannot be read, the epoch begins with 0: {e}"),
                );
            }
            Ok(kept) => kept,
        };
        let epoch = kept.epoch.saturating_add(1);
        if !settings.restore {
            return Self {
                epoch,
                pose: kept.pose,
                ..Self::default()
            };
        }
        match restore(settings, kept.pose.as_ref(), realtime_ns) {
            Ok(start) => Self {
                epoch,
                start,
                warning: None,
                pose: kept.pose,
            },
            Err(why) => afresh(
                epoch,
                None,
                &format!("the last pose is not restored: {why}"),
            ),
        }
    }
}

/// Longest file that is read, bytes: one pose has two thousand.
const MAX_BYTES: u64 = 1 << 16;

fn load(file: &Path) -> io::Result<Kept> {
    let damaged = |cause: String| io::Error::new(io::ErrorKind::InvalidData, cause);
    let text = text_file::read(file, MAX_BYTES).map_err(|fault| {
        let kind = fault.kind.unwrap_or(io::ErrorKind::InvalidData);
        io::Error::new(kind, fault.to_string())
    })?;
    // The parser's further lines show the place, which nobody has typed.
    let kept: Kept = toml::from_str(&text)
        .map_err(|e| damaged(format!("it is damaged: {}", e.message().trim_end())))?;
    if kept.version != VERSION {
        return Err(damaged(format!(
            "it has version {}, not {VERSION}",
            kept.version
        )));
    }
    if let Some(pose) = &kept.pose {
        pose.checked()
            .map_err(|why| damaged(format!("it is damaged: {why}")))?;
    }
    Ok(kept)
}

fn restore(
    settings: &Settings,
    pose: Option<&KnownPose>,
    realtime_ns: i64,
) -> Result<Option<Start>, String> {
    let Some(pose) = pose else {
        return Ok(None);
    };
    let (odom_from_camera, cov_pose) = pose.checked()?;
    let age_s = realtime_ns.saturating_sub(pose.realtime_ns) as f64 * 1e-9;
    if age_s < 0.0 {
        return Err(format!(
            "it lies {:.0} s in the future: the clock has been set",
            -age_s
        ));
    }
    if age_s > settings.max_age_s {
        return Err(format!(
            "it is {age_s:.0} s old, and last_pose.max_age_s = {}",
            settings.max_age_s
        ));
    }
    Ok(Some(Start {
        odom_from_camera,
        cov_pose,
        gap: Duration::from_secs_f64(age_s),
        made: Instant::now(),
        sigma_speed_m_s: settings.sigma_speed_m_s,
        sigma_turn_rad_s: settings.sigma_turn_rad_s,
    }))
}

/// Keeps the file up to date: told by the pipeline, written by somebody else.
#[derive(Clone, Debug)]
pub struct Keeper(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    file: PathBuf,
    every: Duration,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    kept: Kept,
    changed: bool,
    /// Whether an epoch has begun that the file does not know of.
    has_new_epoch: bool,
    written: Instant,
}

/// So many epochs the file is ahead of a run that goes on. More cannot begin between two looks at whether it has to
/// be written: each takes some pairs.
const EPOCHS_AHEAD: u32 = 4;

impl Keeper {
    /// Keeps what a run comes to, if the settings want it. The file is written at once, for a run that ends
    /// before its first pose has begun an epoch all the same.
    ///
    /// # Errors
    /// The file cannot be written; the message names it.
    pub fn start(settings: &Settings, legacy: &Legacy) -> io::Result<Option<Self>> {
        let Some(file) = settings.file.clone() else {
            return Ok(None);
        };
        let kept = Kept {
            version: VERSION,
            epoch: legacy.epoch,
            pose: legacy.pose,
        };
        let keeper = Self(Arc::new(Inner {
            file,
            every: Duration::from_secs_f64(settings.every_s),
            state: Mutex::new(State {
                kept,
                changed: true,
                has_new_epoch: true,
                written: Instant::now(),
            }),
        }));
        keeper.write(EPOCHS_AHEAD)?;
        Ok(Some(keeper))
    }

    /// Takes note of a row whose pair was taken at `realtime_ns`. Costs a copy.
    pub fn note(&self, odometry: &Odometry, realtime_ns: i64) {
        let mut state = self.state();
        if state.kept.epoch != odometry.epoch {
            state.kept.epoch = odometry.epoch;
            state.has_new_epoch = true;
            state.changed = true;
        }
        // A row that only begins knows nothing that the file did not know better.
        if odometry.status != Status::Initializing {
            state.kept.pose = Some(KnownPose::of(odometry, realtime_ns));
            state.changed = true;
        }
    }

    /// Writes the file if it is due: from time to time, and soon after an epoch has begun.
    ///
    /// # Errors
    /// The file cannot be written; the message names it.
    pub fn write_if_due(&self) -> io::Result<()> {
        let is_due = {
            let state = self.state();
            state.changed && (state.has_new_epoch || state.written.elapsed() >= self.0.every)
        };
        if is_due {
            self.write(EPOCHS_AHEAD)?;
        }
        Ok(())
    }

    /// Writes the file for the last time: the run begins no epoch any more.
    ///
    /// # Errors
    /// The file cannot be written; the message names it.
    pub fn close(&self) -> io::Result<()> {
        self.write(0)
    }

    fn write(&self, epochs_ahead: u32) -> io::Result<()> {
        let mut kept = {
            let mut state = self.state();
            state.written = Instant::now();
            state.changed = false;
            state.has_new_epoch = false;
            state.kept
        };
        kept.epoch = kept.epoch.saturating_add(epochs_ahead);
        let file = &self.0.file;
        save(file, &kept).map_err(|e| {
            self.state().changed = true;
            io::Error::other(format!(
                "{}: the last pose cannot be kept: {e}",
                file.display()
            ))
        })
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Replaces the file as a whole.
fn save(file: &Path, kept: &Kept) -> io::Result<()> {
    let text = toml::to_string(kept).map_err(io::Error::other)?;
    let mut beside = file.as_os_str().to_owned();
    beside.push(".new");
    let mut new = File::create(&beside)?;
    new.write_all(text.as_bytes())?;
    new.sync_all()?;
    std::fs::rename(&beside, file)?;
    let folder = file
        .parent()
        .filter(|folder| !folder.as_os_str().is_empty());
    File::open(folder.unwrap_or(Path::new(".")))?.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::{Counts, ErrorBudget};
    use crate::geometry::se3;
    use nalgebra::Vector6;

    const NOW_NS: i64 = 1_700_000_000_000_000_000;
    const SECOND_NS: i64 = 1_000_000_000;

    fn settings(folder: &tempfile::TempDir) -> Settings {
        Settings {
            file: Some(folder.path().join("last_pose.toml")),
            restore: true,
            ..Settings::default()
        }
    }

    fn row(status: Status, epoch: u32) -> Odometry {
        let sigma = Vector6::new(0.1, 0.2, 0.3, 0.01, 0.02, 0.03);
        Odometry {
            sequence: 7,
            timestamp_ns: 1,
            epoch,
            status,
            odom_from_camera: se3::exp(&Vector6::new(1.0, 2.0, 3.0, 0.3, -0.2, 0.1)),
            cov_pose: Matrix6::from_diagonal(&sigma.component_mul(&sigma)),
            prev_from_now: Isometry3::identity(),
            cov_motion: Matrix6::identity(),
            twist: Vector6::zeros(),
            cov_twist: Matrix6::identity(),
            budget: ErrorBudget::default(),
            counts: Counts::default(),
            variance_factor: 1.0,
            innovation_ratio: 0.25,
        }
    }

    /// A run that begins with what `legacy` says, gives these rows and ends.
    fn run(settings: &Settings, legacy: &Legacy, rows: &[Odometry]) {
        let keeper = Keeper::start(settings, legacy)
            .expect("writable")
            .expect("wanted");
        for row in rows {
            keeper.note(row, NOW_NS);
        }
        keeper.close().expect("writable");
    }

    #[test]
    fn the_next_run_begins_where_the_last_one_ended() {
        let folder = tempfile::tempdir().expect("a folder");
        let settings = settings(&folder);
        let first = Legacy::read(&settings, NOW_NS);
        assert!((first.epoch, first.start.is_none(), first.warning.is_none()) == (0, true, true));
        let tracked = row(Status::Tracking, 0);
        run(
            &settings,
            &first,
            &[row(Status::Initializing, 0), tracked.clone()],
        );
        let next = Legacy::read(&settings, NOW_NS + 3 * SECOND_NS);
        assert_eq!((next.epoch, &next.warning), (1, &None));
        let start = next.start.expect("restored");
        let apart = start.odom_from_camera.inverse() * tracked.odom_from_camera;
        assert!(se3::log(&apart).norm() < 1e-12);
        assert_eq!(start.cov_pose, tracked.cov_pose);
        assert_eq!(start.gap, Duration::from_secs(3));
    }

    #[test]
    fn a_run_that_sees_nothing_leaves_the_pose_of_the_one_before_and_an_epoch_of_its_own() {
        let folder = tempfile::tempdir().expect("a folder");
        let settings = settings(&folder);
        run(&settings, &Legacy::default(), &[row(Status::Tracking, 0)]);
        let blind = Legacy::read(&settings, NOW_NS + SECOND_NS);
        run(&settings, &blind, &[row(Status::Initializing, blind.epoch)]);
        let next = Legacy::read(&settings, NOW_NS + 2 * SECOND_NS);
        assert_eq!(next.epoch, 2);
        assert_eq!(next.start.expect("restored").gap, Duration::from_secs(2));
    }

    #[test]
    fn epochs_rise_past_those_that_a_killed_run_had_no_time_to_write_down() {
        let folder = tempfile::tempdir().expect("a folder");
        let settings = settings(&folder);
        let mut highest = None;
        for epochs in [1, 2, 3, 1] {
            let legacy = Legacy::read(&settings, NOW_NS);
            assert!(highest.is_none_or(|highest| legacy.epoch > highest));
            let keeper = Keeper::start(&settings, &legacy)
                .expect("writable")
                .expect("wanted");
            for began in 0..epochs {
                keeper.note(&row(Status::Initializing, legacy.epoch + began), NOW_NS);
            }
            // Killed: nobody writes.
            highest = Some(legacy.epoch + epochs - 1);
        }
    }

    #[test]
    fn a_new_epoch_is_written_at_once_and_a_pose_when_it_is_time() {
        let folder = tempfile::tempdir().expect("a folder");
        let settings = settings(&folder);
        let keeper = Keeper::start(&settings, &Legacy::default())
            .expect("writable")
            .expect("wanted");
        let written = || load(settings.file.as_deref().expect("set")).expect("readable");
        keeper.note(&row(Status::Tracking, 0), NOW_NS);
        keeper.write_if_due().expect("writable");
        assert!(written().pose.is_none());
        keeper.note(&row(Status::Initializing, 1), NOW_NS);
        keeper.write_if_due().expect("writable");
        assert_eq!(written().epoch, 1 + EPOCHS_AHEAD);
        assert!(written().pose.is_some());
        keeper.close().expect("writable");
        assert_eq!(written().epoch, 1);
    }

    #[test]
    fn too_old_or_of_the_future_is_a_warning_and_the_epoch_still_rises() {
        let folder = tempfile::tempdir().expect("a folder");
        let settings = settings(&folder);
        run(&settings, &Legacy::default(), &[row(Status::Lost, 0)]);
        for (now_ns, why) in [
            (NOW_NS + 301 * SECOND_NS, "301 s old"),
            (NOW_NS - 20 * SECOND_NS, "20 s in the future"),
        ] {
            let legacy = Legacy::read(&settings, now_ns);
            assert!(legacy.start.is_none());
            assert_eq!(legacy.epoch, 1);
            let warning = legacy.warning.expect("one");
            assert!(warning.contains(why), "{warning}");
        }
    }

    #[test]
    fn a_damaged_file_is_one_warning() {
        let folder = tempfile::tempdir().expect("a folder");
        let settings = settings(&folder);
        run(&settings, &Legacy::default(), &[row(Status::Tracking, 0)]);
        let file = settings.file.clone().expect("set");
        let whole = std::fs::read_to_string(&file).expect("readable");
        let cut = whole[..whole.len() / 2].to_owned();
        let other = whole.replace("version = 1", "version = 9");
        let bent = whole.replace("quaternion_xyzw = [", "quaternion_xyzw = [9.0, ");
        let long = whole.replacen("quaternion_xyzw = [0", "quaternion_xyzw = [7", 1);
        for (text, why) in [
            (cut, "it is damaged"),
            (String::new(), "it is damaged"),
            (other, "version 9"),
            (bent, "it is damaged"),
            (long, "not of length 1"),
        ] {
            std::fs::write(&file, &text).expect("writable");
            let legacy = Legacy::read(&settings, NOW_NS);
            assert!(legacy.start.is_none() && legacy.epoch == 0, "{text}");
            let warning = legacy.warning.expect("one");
            assert!(
                warning.contains(why) && warning.lines().count() == 1,
                "{warning}"
            );
        }
    }

    #[test]
    fn without_restoring_only_the_epoch_goes_on() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut settings = settings(&folder);
        settings.restore = false;
        run(&settings, &Legacy::default(), &[row(Status::Tracking, 4)]);
        let legacy = Legacy::read(&settings, NOW_NS + SECOND_NS);
        assert_eq!(
            (legacy.epoch, legacy.start.is_none(), legacy.warning),
            (5, true, None)
        );
    }

    #[test]
    fn to_restore_takes_a_file() {
        let restore = Settings {
            restore: true,
            ..Settings::default()
        };
        assert_eq!(restore.check().expect_err("refused").key, "restore");
        assert_eq!(Settings::default().check(), Ok(()));
    }
}
