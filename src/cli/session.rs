//! What a run of the pipeline writes and publishes, for every command that runs it.

use super::attendant::Pulse;
#[cfg(feature = "ipc")]
use super::health::Health;
use super::metrics::{Metrics, Totals};
use super::{Failure, progress, summary};
use crate::capture::PairSource;
use crate::capture::camera::realtime_ns;
use crate::capture::live::{Monitor, Snapshot};
use crate::config::Config;
use crate::features;
use crate::geometry::{Severity, StereoRig, check_rig};
use crate::output::csv::OdometryCsvWriter;
#[cfg(feature = "ipc")]
use crate::output::features::FeaturesMessage;
#[cfg(feature = "foxglove")]
use crate::output::foxglove::FoxgloveServer;
use crate::output::last_pose::{Keeper, Legacy};
#[cfg(feature = "mcap")]
use crate::output::mcap::McapRecorder;
#[cfg(feature = "ipc")]
use crate::output::publisher::Publisher;
use crate::output::row::OdometryRow;
use crate::output::tum::TumWriter;
use crate::pipeline::{
    self, Delivery, DropCount, Fault, Method, RunCounts, RunFigures, Share, Stage, Statistics,
    Undelivered,
};
use crate::rig_watch::RigState;
use crate::service::budget::{FrameBudget, Timing};
use crate::service::metrics::Exposition;
use indicatif::ProgressBar;
use std::fs::File;
use std::io;
use std::net::SocketAddr;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Sees each row as it comes.
type RowWatcher = Box<dyn FnMut(&OdometryRow)>;

/// Where the rows of a run go.
pub(crate) struct Session {
    config: Config,
    rig: StereoRig,
    csv: Option<(PathBuf, OdometryCsvWriter<File>)>,
    trajectory: Option<(PathBuf, TumWriter<File>)>,
    #[cfg(feature = "mcap")]
    mcap: Option<(PathBuf, McapRecorder)>,
    #[cfg(feature = "foxglove")]
    foxglove: Option<FoxgloveServer>,
    rows: Option<Vec<OdometryRow>>,
    #[cfg(feature = "ipc")]
    publisher: Option<Publisher>,
    #[cfg(feature = "ipc")]
    features: Box<FeaturesMessage>,
    #[cfg(feature = "ipc")]
    health: Health,
    published: u64,
    publish_failures: u64,
    each_row: Option<RowWatcher>,
    live: Option<Live>,
    metrics: Option<(Metrics, Exposition)>,
    legacy: Legacy,
    keeper: Option<Keeper>,
    warned_of_first_order: bool,
    warned_of_rig: [bool; 2],
}

/// What there is besides where the pairs come from cameras.
struct Live {
    cameras: Monitor,
    pulse: Pulse,
    budget: FrameBudget,
    share: Share,
}

/// What a run came to.
pub(crate) struct Finished {
    /// Its figures.
    pub(crate) figures: RunFigures,
    /// All rows, where they were asked for.
    pub(crate) rows: Vec<OdometryRow>,
    /// The last row.
    pub(crate) last: Option<OdometryRow>,
    /// Messages published.
    pub(crate) published: u64,
    /// Messages that could not be published.
    pub(crate) publish_failures: u64,
    /// Why the first unusable pair was not usable.
    pub(crate) first_unusable: Option<String>,
    /// What became of the cameras, where there were any.
    pub(crate) cameras: Option<Snapshot>,
    /// How the rig is, where it was watched.
    pub(crate) rig: Option<RigState>,
    /// All that was lost on the way.
    pub(crate) drops: Vec<DropCount>,
}

impl Session {
    /// A run for one rig, with no output yet.
    pub(crate) fn new(config: Config, rig: StereoRig) -> Self {
        for finding in check_rig(&rig) {
            let how = match finding.severity {
                Severity::Warning => "unusual",
                Severity::Error => "cannot be right",
            };
            eprintln!(
                "visod: warning: rig: {} {how}: {}",
                finding.key, finding.message
            );
        }
        Self {
            config,
            rig,
            csv: None,
            trajectory: None,
            #[cfg(feature = "mcap")]
            mcap: None,
            #[cfg(feature = "foxglove")]
            foxglove: None,
            rows: None,
            #[cfg(feature = "ipc")]
            publisher: None,
            #[cfg(feature = "ipc")]
            features: Box::default(),
            #[cfg(feature = "ipc")]
            health: Health::default(),
            published: 0,
            publish_failures: 0,
            each_row: None,
            live: None,
            metrics: None,
            legacy: Legacy::default(),
            keeper: None,
            warned_of_first_order: false,
            warned_of_rig: [false; 2],
        }
    }

    /// The pairs come from cameras: their own times go out, and their state; `pulse` shows each row, and
    /// features are trimmed where time is short.
    pub(crate) fn watch(&mut self, cameras: Monitor, pulse: Pulse) {
        let service = &self.config.service;
        self.live = Some(Live {
            cameras,
            pulse,
            budget: FrameBudget::new(service.deadline(), service.trim),
            share: Share::default(),
        });
    }

    /// Answers those who fetch figures, where the configuration says so; after [`watch`](Self::watch).
    pub(crate) fn serve_metrics(&mut self) -> Result<(), Failure> {
        if let Some(live) = &self.live {
            self.metrics = Metrics::serve(&self.config, live.cameras.clone())?;
        }
        Ok(())
    }

    /// Continues what an earlier run has left, and has `keeper` know where this one stands.
    pub(crate) fn continuing(&mut self, legacy: Legacy, keeper: Option<Keeper>) {
        self.legacy = legacy;
        self.keeper = keeper;
    }

    /// Writes the odometry CSV.
    pub(crate) fn write_csv(&mut self, file: Option<&Path>) -> Result<(), Failure> {
        if let Some(file) = file {
            let csv = OdometryCsvWriter::create(file).map_err(|e| unwritable(file, &e))?;
            self.csv = Some((file.to_owned(), csv));
        }
        Ok(())
    }

    /// Writes the trajectory in TUM format.
    pub(crate) fn write_trajectory(&mut self, file: Option<&Path>) -> Result<(), Failure> {
        if let Some(file) = file {
            let trajectory = TumWriter::create(file).map_err(|e| unwritable(file, &e))?;
            self.trajectory = Some((file.to_owned(), trajectory));
        }
        Ok(())
    }

    /// Records images and estimates as messages of ROS 2. Where the pairs come from cameras, images
    /// are left out rather than waited for.
    #[cfg(feature = "mcap")]
    pub(crate) fn write_mcap(&mut self, file: Option<&Path>) -> Result<(), Failure> {
        if let Some(file) = file {
            let waits = self.live.is_none();
            let mcap =
                McapRecorder::create(file, &self.rig, waits).map_err(|e| unwritable(file, &e))?;
            self.mcap = Some((file.to_owned(), mcap));
        }
        Ok(())
    }

    #[cfg(not(feature = "mcap"))]
    pub(crate) fn write_mcap(&mut self, file: Option<&Path>) -> Result<(), Failure> {
        match file {
            Some(_) => Err(Failure::usage(
                "--mcap: this visod was built without the feature mcap",
            )),
            None => Ok(()),
        }
    }

    /// Shows the run to Foxglove: at the address given, else at that of the configuration, if any.
    pub(crate) fn show(&mut self, address: Option<SocketAddr>) -> Result<(), Failure> {
        match address.or(self.config.publish.foxglove) {
            Some(address) => self.show_at(address),
            None => Ok(()),
        }
    }

    #[cfg(feature = "foxglove")]
    fn show_at(&mut self, address: SocketAddr) -> Result<(), Failure> {
        let server = FoxgloveServer::start(address, &self.rig)
            .map_err(|e| Failure::other(format!("foxglove: cannot listen at {address}: {e}")))?;
        eprintln!("visod: Foxglove finds this run at {}", server.url());
        self.foxglove = Some(server);
        Ok(())
    }

    #[cfg(not(feature = "foxglove"))]
    fn show_at(&mut self, address: SocketAddr) -> Result<(), Failure> {
        Err(Failure::usage(format!(
            "foxglove: nothing can be shown at {address}: this visod was built without the feature foxglove"
        )))
    }

    /// Keeps all rows for a report.
    pub(crate) fn keep_rows(&mut self) {
        self.rows = Some(Vec::new());
    }

    /// Calls `see` with each row as it comes.
    pub(crate) fn on_each_row(&mut self, see: impl FnMut(&OdometryRow) + 'static) {
        self.each_row = Some(Box::new(see));
    }

    /// Publishes each row over shared memory.
    #[cfg(feature = "ipc")]
    pub(crate) fn publish(&mut self) -> Result<&Publisher, crate::output::IpcError> {
        let publisher = Publisher::new(&self.config.publish)?;
        Ok(self.publisher.insert(publisher))
    }

    /// Runs a whole source through the pipeline.
    pub(crate) fn run<S: PairSource>(mut self, source: S) -> Result<Finished, Failure> {
        let mut method = Method::new(
            self.rig.clone(),
            self.config.matching.clone(),
            self.config.estimation.clone(),
        )
        .ok_or_else(|| {
            Failure::usage("the rig's cameras stand behind one another: no depth can be measured")
        })?
        .watching_rig(&self.config.rig_watch)
        .continuing(self.legacy.epoch, self.legacy.start.take());
        let share = self.live.as_ref().map(|live| live.share.clone());
        let bound = |extractor| match &share {
            Some(share) => share.bound(extractor),
            None => extractor,
        };
        let extractors = (0..self.config.pipeline.worker_count())
            .map(|_| features::extractor(&self.config.features).map(bound))
            .collect::<Result<Vec<_>, _>>()
            .map_err(|e| Failure::usage(format!("features.{}: {}", e.key, e.cause)))?;
        let bar = progress::pairs(source.len_hint());
        let mut statistics = Statistics::start();
        let mut first_unusable = None;
        let mut repeats = false;
        let mut last = None;
        pipeline::run(source, extractors, &mut method, |delivery| {
            statistics.add(delivery.odometry, &delivery.latencies, delivery.unusable);
            repeats &= delivery.unusable.is_some();
            if let Some(Fault { stage, why }) = delivery.unusable {
                let sequence = delivery.odometry.sequence;
                // Cameras say themselves what happens to them, once and not for each pair.
                // A frozen one does not.
                let begins = stage == Stage::Repeats && !std::mem::replace(&mut repeats, true);
                match self.live {
                    Some(_) if begins => tracing::warn!(sequence, "{why}"),
                    Some(_) => tracing::debug!(sequence, why, "pair not usable"),
                    None => bar.suspend(|| {
                        eprintln!("visod: warning: pair {sequence} is not usable: {why}");
                    }),
                }
                first_unusable.get_or_insert_with(|| why.to_owned());
            }
            self.warn_of_first_order(&delivery, &bar);
            self.warn_of_rig(&delivery, &bar);
            last = Some(self.deliver(&delivery, &bar)?);
            self.leave_figures(&delivery, statistics.counts());
            bar.inc(1);
            Ok::<_, io::Error>(ControlFlow::Continue(()))
        })
        .map_err(Failure::other)?;
        bar.finish_and_clear();
        let undelivered = self.undelivered();
        if let Some((file, csv)) = self.csv {
            csv.finish().map_err(|e| unwritable(&file, &e))?;
        }
        if let Some((file, trajectory)) = self.trajectory {
            trajectory.finish().map_err(|e| unwritable(&file, &e))?;
        }
        #[cfg(feature = "mcap")]
        if let Some((file, mcap)) = self.mcap {
            let left_out = undelivered.unrecorded;
            mcap.finish().map_err(|e| unwritable(&file, &e))?;
            if left_out > 0 {
                eprintln!(
                    "visod: warning: {}: the images of {left_out} pairs were left out, as the disk was behind",
                    file.display()
                );
            }
        }
        #[cfg(feature = "foxglove")]
        if let Some(server) = self.foxglove {
            drop(server);
            let left_out = undelivered.unshown;
            if left_out > 0 {
                eprintln!(
                    "visod: warning: foxglove: {left_out} pairs were not shown, as there was no time to"
                );
            }
        }
        #[cfg(feature = "ipc")]
        if let Some(publisher) = self.publisher {
            publisher.close();
        }
        let cameras = self.live.as_ref().map(|live| live.cameras.snapshot());
        let rig = method.rig_state();
        let mut figures = statistics.figures();
        figures.counts.dropped = cameras.as_ref().map_or(0, |c| c.dropped);
        Ok(Finished {
            drops: pipeline::drops(cameras.as_ref(), &figures.counts, &undelivered),
            figures,
            cameras,
            rows: self.rows.unwrap_or_default(),
            last,
            published: self.published,
            publish_failures: self.publish_failures,
            first_unusable,
            rig,
        })
    }

    /// Says once that the pose's covariance does not describe its error any more.
    fn warn_of_first_order(&mut self, delivery: &Delivery<'_>, bar: &ProgressBar) {
        if self.warned_of_first_order || delivery.odometry.is_first_order() {
            return;
        }
        self.warned_of_first_order = true;
        let sequence = delivery.odometry.sequence;
        if self.live.is_some() {
            tracing::warn!(
                sequence,
                "rotation too uncertain for a covariance of the pose"
            );
        } else {
            bar.suspend(|| {
                eprintln!(
                    "visod: warning: from pair {sequence} on the rotation is uncertain by more than 0.2 rad: \
                     the covariance does not describe the pose's error any more, that of the motion does"
                );
            });
        }
    }

    /// Says once, of each, that the rig has moved and that it does not belong to the images.
    fn warn_of_rig(&mut self, delivery: &Delivery<'_>, bar: &ProgressBar) {
        let Some(rig) = &delivery.rig else {
            return;
        };
        let sequence = delivery.odometry.sequence;
        let moved = summary::turn_to_text(rig);
        let misfits = "left and right images miss each other by more than the rig's uncertainty: calibrate anew, \
                       or look at it with visod rig check";
        for (i, (holds, what)) in [(rig.has_moved, moved.as_str()), (rig.misfits, misfits)]
            .into_iter()
            .enumerate()
        {
            if !holds || std::mem::replace(&mut self.warned_of_rig[i], true) {
                continue;
            }
            if self.live.is_some() {
                tracing::warn!(sequence, "{what}");
            } else {
                bar.suspend(|| eprintln!("visod: warning: at pair {sequence}: {what}"));
            }
        }
    }

    /// Hands one row to everything that wants it.
    fn deliver(&mut self, delivery: &Delivery<'_>, bar: &ProgressBar) -> io::Result<OdometryRow> {
        // Latency belongs to the run, not to the recording: two replays write the same bytes.
        let total_ms = delivery.latencies.total.as_secs_f64() * 1e3;
        let latency_ms = self.live.is_some().then_some(total_ms);
        let row = OdometryRow::new(delivery.odometry, latency_ms);
        if let Some(live) = &mut self.live {
            live.see(delivery);
        }
        self.send(delivery);
        if let Some(keeper) = &self.keeper {
            let age_ns = i64::try_from(delivery.latencies.total.as_nanos()).unwrap_or(0);
            keeper.note(delivery.odometry, realtime_ns() - age_ns);
        }
        let is_live = self.live.is_some();
        write_to(&mut self.csv, is_live, |csv| {
            csv.write_row(&row).and_then(|()| csv.flush())
        })?;
        write_to(&mut self.trajectory, is_live, |trajectory| {
            trajectory.write(row.timestamp_ns, &delivery.odometry.odom_from_camera)
        })?;
        #[cfg(feature = "mcap")]
        write_to(&mut self.mcap, is_live, |mcap| {
            mcap.add(delivery.odometry, delivery.method.tracked(), delivery.pair)
        })?;
        #[cfg(feature = "foxglove")]
        self.present(delivery);
        if let Some(see) = &mut self.each_row {
            bar.suspend(|| see(&row));
        }
        if let Some(rows) = &mut self.rows {
            // A report is about this run, so that it shows how long things took.
            rows.push(OdometryRow {
                latency_ms: delivery.unusable.is_none().then_some(total_ms),
                ..row.clone()
            });
        }
        Ok(row)
    }

    /// What could not be handed on until now.
    fn undelivered(&self) -> Undelivered {
        #[cfg(feature = "mcap")]
        let unrecorded = self.mcap.as_ref().map_or(0, |(_, mcap)| mcap.left_out());
        #[cfg(not(feature = "mcap"))]
        let unrecorded = 0;
        #[cfg(feature = "foxglove")]
        let unshown = self.foxglove.as_ref().map_or(0, FoxgloveServer::left_out);
        #[cfg(not(feature = "foxglove"))]
        let unshown = 0;
        Undelivered {
            unpublished: self.publish_failures,
            unrecorded,
            unshown,
        }
    }

    /// Leaves the totals up to a row to those who fetch figures.
    fn leave_figures(&self, delivery: &Delivery<'_>, counts: &RunCounts) {
        let (Some((metrics, _)), Some(live)) = (&self.metrics, &self.live) else {
            return;
        };
        #[cfg(feature = "ipc")]
        let subscribers = self.publisher.as_ref().map_or(0, Publisher::subscribers);
        #[cfg(not(feature = "ipc"))]
        let subscribers = 0;
        let totals = Totals {
            counts: *counts,
            published: self.published,
            undelivered: self.undelivered(),
            subscribers,
            overruns: live.budget.overruns(),
            over_period: live.budget.over_period(),
            share: live.budget.share(),
        };
        metrics.add(delivery, totals);
    }

    /// Shows one row to Foxglove; where that fails nobody looks any more.
    #[cfg(feature = "foxglove")]
    fn present(&mut self, delivery: &Delivery<'_>) {
        let (_, capture_ns) = self.captured(delivery);
        if let Some(server) = &mut self.foxglove {
            let shown = server.add(
                delivery.odometry,
                latencies(&delivery.latencies, capture_ns),
                delivery.method.tracked(),
                delivery.pair,
            );
            if let Err(cause) = shown {
                eprintln!("visod: warning: foxglove: {cause}");
                self.foxglove = None;
            }
        }
    }

    #[cfg(feature = "ipc")]
    fn send(&mut self, delivery: &Delivery<'_>) {
        use crate::output::message::OdometryMessage;

        let captured = self.captured(delivery);
        let Some(publisher) = &mut self.publisher else {
            return;
        };
        let mounting = self.rig.base_from_camera.as_ref();
        let message = OdometryMessage::new(
            delivery.odometry,
            mounting.filter(|_| self.config.publish.base_frame),
            captured.0,
            latencies(&delivery.latencies, captured.1),
        );
        let mut sent = publisher.publish(&message);
        self.published += u64::from(sent.is_ok());
        if publisher.publishes_features() {
            let tracked = delivery.method.tracked();
            self.features.fill(delivery.odometry, captured.0, tracked);
            sent = sent.and(publisher.publish_features(&self.features));
        }
        if let Err(e) = sent {
            self.publish_failures += 1;
            if self.publish_failures == 1 {
                eprintln!("visod: warning: {e}");
            }
        }
        self.health.add(delivery);
        if let Some(live) = &self.live {
            let cameras = live.cameras.snapshot();
            self.health.add_cameras(&cameras);
            self.health.add_budget(&live.budget, cameras.period_ns);
        }
        if self.health.is_due() {
            let message = self
                .health
                .message(publisher.subscribers(), self.publish_failures);
            // Health is repeated every second: one that fails is not missed.
            let _ = publisher.publish_health(&message);
        }
    }

    /// When a pair was taken, and how long it took to be complete, ns.
    #[cfg(any(feature = "ipc", feature = "foxglove"))]
    fn captured(&self, delivery: &Delivery<'_>) -> (crate::output::message::CaptureTime, u64) {
        use crate::capture::camera::monotonic_ns;
        use crate::output::message::CaptureTime;

        let odometry = delivery.odometry;
        let Some(live) = &self.live else {
            return (CaptureTime::Recorded(odometry.timestamp_ns), 0);
        };
        let now_ns = monotonic_ns();
        let (taken_ns, complete_ns) = live
            .cameras
            .captured(odometry.sequence)
            .map_or((now_ns, now_ns), |at| (at.monotonic_ns, at.complete_ns));
        let captured = CaptureTime::Live {
            realtime_ns: realtime_ns() - (now_ns - taken_ns),
            monotonic_ns: taken_ns,
        };
        (captured, u64::try_from(complete_ns - taken_ns).unwrap_or(0))
    }

    #[cfg(not(feature = "ipc"))]
    fn send(&mut self, _: &Delivery<'_>) {}
}

impl Live {
    /// Takes note of a row: how long it took, and whether pairs wait meanwhile.
    fn see(&mut self, delivery: &Delivery<'_>) {
        let (deadline, trims) = self.pulse.beat();
        self.budget.set(deadline, trims);
        if delivery.unusable.is_some() {
            return;
        }
        let cameras = self.cameras.snapshot();
        let took = &delivery.latencies;
        let changed = self.budget.add(&Timing {
            total: took.total,
            busy: took.features + took.matching + took.estimation,
            period: Duration::from_nanos(u64::try_from(cameras.period_ns).unwrap_or(0)),
            waiting: cameras.waiting,
        });
        let before = self.share.get();
        let now = changed.unwrap_or(self.budget.share());
        self.share.set(now);
        if now < before {
            tracing::warn!(share = now, "pairs wait: fewer features are looked for");
        } else if now > before {
            tracing::info!(share = now, "there is time for more features again");
        }
    }
}

/// The stages' latencies as the message has them.
#[cfg(any(feature = "ipc", feature = "foxglove"))]
fn latencies(
    took: &pipeline::StageLatencies,
    capture_ns: u64,
) -> crate::output::message::Latencies {
    let ns = |d: Duration| u64::try_from(d.as_nanos()).unwrap_or(u64::MAX);
    crate::output::message::Latencies {
        capture_ns,
        features_ns: ns(took.features),
        matching_ns: ns(took.matching),
        estimation_ns: ns(took.estimation),
        total_ns: ns(took.total),
    }
}

/// The failure that an output file cannot be written.
pub(crate) fn unwritable(file: &Path, cause: &io::Error) -> Failure {
    Failure::other(named(file, cause))
}

/// Writes to one of a run's files. Where that fails, a replay ends; a robot whose disk is full drives on, without
/// this file.
fn write_to<W>(
    file: &mut Option<(PathBuf, W)>,
    is_live: bool,
    write: impl FnOnce(&mut W) -> io::Result<()>,
) -> io::Result<()> {
    let Some((path, writer)) = file else {
        return Ok(());
    };
    match write(writer).map_err(|e| named(path, &e)) {
        Err(e) if is_live => {
            tracing::warn!("{e}: no more is written to it");
            *file = None;
            Ok(())
        }
        result => result,
    }
}

/// The system's error with the file's name before it.
fn named(file: &Path, cause: &io::Error) -> io::Error {
    io::Error::other(format!("{}: cannot be written: {cause}", file.display()))
}
