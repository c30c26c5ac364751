//! What a run of the pipeline writes and publishes, for every command that runs it.

#[cfg(feature = "ipc")]
use super::health::Health;
use super::{Failure, progress};
use crate::capture::PairSource;
use crate::config::Config;
use crate::features;
use crate::geometry::{Severity, StereoRig, check_rig};
use crate::output::csv::OdometryCsvWriter;
#[cfg(feature = "ipc")]
use crate::output::publisher::Publisher;
use crate::output::row::OdometryRow;
use crate::output::tum::TumWriter;
use crate::pipeline::{self, Delivery, Method, RunFigures, Statistics};
use indicatif::ProgressBar;
use std::fs::File;
use std::io;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// Sees each row as it comes.
type RowWatcher = Box<dyn FnMut(&OdometryRow)>;

/// Where the rows of a run go.
pub(crate) struct Session {
    config: Config,
    rig: StereoRig,
    csv: Option<(PathBuf, OdometryCsvWriter<File>)>,
    trajectory: Option<(PathBuf, TumWriter<File>)>,
    rows: Option<Vec<OdometryRow>>,
    #[cfg(feature = "ipc")]
    publisher: Option<Publisher>,
    #[cfg(feature = "ipc")]
    health: Health,
    published: u64,
    publish_failures: u64,
    each_row: Option<RowWatcher>,
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
            rows: None,
            #[cfg(feature = "ipc")]
            publisher: None,
            #[cfg(feature = "ipc")]
            health: Health::default(),
            published: 0,
            publish_failures: 0,
            each_row: None,
        }
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
        })?;
        let extractors = (0..self.config.pipeline.worker_count())
            .map(|_| features::extractor(&self.config.features))
            .collect::<Result<Vec<_>, _>>()
            .map_err(|e| Failure::usage(format!("features.{}: {}", e.key, e.cause)))?;
        let bar = progress::pairs(source.len_hint());
        let mut statistics = Statistics::start();
        let mut first_unusable = None;
        let mut last = None;
        pipeline::run(source, extractors, &mut method, |delivery| {
            statistics.add(
                delivery.odometry,
                &delivery.latencies,
                delivery.unusable.is_none(),
            );
            if let Some(why) = delivery.unusable {
                bar.suspend(|| {
                    eprintln!(
                        "visod: warning: pair {} is not usable: {why}",
                        delivery.odometry.sequence
                    );
                });
                first_unusable.get_or_insert_with(|| why.to_owned());
            }
            last = Some(self.deliver(&delivery, &bar)?);
            bar.inc(1);
            Ok::<_, io::Error>(ControlFlow::Continue(()))
        })
        .map_err(Failure::other)?;
        bar.finish_and_clear();
        if let Some((file, csv)) = self.csv {
            csv.finish().map_err(|e| unwritable(&file, &e))?;
        }
        if let Some((file, trajectory)) = self.trajectory {
            trajectory.finish().map_err(|e| unwritable(&file, &e))?;
        }
        #[cfg(feature = "ipc")]
        if let Some(publisher) = self.publisher {
            publisher.close();
        }
        Ok(Finished {
            figures: statistics.figures(),
            rows: self.rows.unwrap_or_default(),
            last,
            published: self.published,
            publish_failures: self.publish_failures,
            first_unusable,
        })
    }

    /// Hands one row to everything that wants it.
    fn deliver(&mut self, delivery: &Delivery<'_>, bar: &ProgressBar) -> io::Result<OdometryRow> {
        // Latency belongs to the run, not to the recording: two replays write the same bytes.
        let row = OdometryRow::new(delivery.odometry, None);
        self.send(delivery);
        if let Some((file, csv)) = &mut self.csv {
            csv.write_row(&row)
                .and_then(|()| csv.flush())
                .map_err(|e| named(file, &e))?;
        }
        if let Some((file, trajectory)) = &mut self.trajectory {
            trajectory
                .write(row.timestamp_ns, &delivery.odometry.odom_from_camera)
                .map_err(|e| named(file, &e))?;
        }
        if let Some(see) = &mut self.each_row {
            bar.suspend(|| see(&row));
        }
        if let Some(rows) = &mut self.rows {
            rows.push(row.clone());
        }
        Ok(row)
    }

    #[cfg(feature = "ipc")]
    fn send(&mut self, delivery: &Delivery<'_>) {
        use crate::output::message::{CaptureTime, OdometryMessage};

        let Some(publisher) = &mut self.publisher else {
            return;
        };
        let mounting = self.rig.base_from_camera.as_ref();
        let message = OdometryMessage::new(
            delivery.odometry,
            mounting.filter(|_| self.config.publish.base_frame),
            CaptureTime::Recorded(delivery.odometry.timestamp_ns),
            latencies(&delivery.latencies),
        );
        match publisher.publish(&message) {
            Ok(_) => self.published += 1,
            Err(e) => {
                self.publish_failures += 1;
                if self.publish_failures == 1 {
                    eprintln!("visod: warning: {e}");
                }
            }
        }
        self.health.add(delivery);
        if self.health.is_due() {
            let message = self
                .health
                .message(publisher.subscribers(), self.publish_failures);
            // Health is repeated every second: one that fails is not missed.
            let _ = publisher.publish_health(&message);
        }
    }

    #[cfg(not(feature = "ipc"))]
    fn send(&mut self, _: &Delivery<'_>) {}
}

/// The stages' latencies as the message has them.
#[cfg(feature = "ipc")]
fn latencies(took: &pipeline::StageLatencies) -> crate::output::message::Latencies {
    let ns = |d: std::time::Duration| u64::try_from(d.as_nanos()).unwrap_or(u64::MAX);
    crate::output::message::Latencies {
        capture_ns: 0,
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

/// The system's error with the file's name before it.
fn named(file: &Path, cause: &io::Error) -> io::Error {
    io::Error::other(format!("{}: cannot be written: {cause}", file.display()))
}
