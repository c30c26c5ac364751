//! A run's figures as Prometheus wants them: counts, and the stages' latencies as histograms.
//!
//! The pipeline leaves its totals here, row by row, which is a copy of a few numbers; all else is done when
//! somebody asks.

use super::Failure;
use crate::capture::live::{Monitor, Snapshot, State};
use crate::config::Config;
use crate::pipeline::{self, Delivery, RunCounts, StageLatencies, Undelivered};
use crate::service::metrics::Exposition;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{
    DescriptorEncoder, EncodeLabelSet, EncodeMetric, MetricEncoder, prometheus_text,
};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Upper ends of the latencies' bins, s.
const BINS_S: [f64; 14] = [
    0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.03, 0.05, 0.075, 0.1, 0.2, 0.5, 1.0, 2.0,
];
const STAGES: [&str; 4] = ["features", "matching", "estimation", "total"];

/// What the pipeline has counted.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Totals {
    /// Rows by fate.
    pub(crate) counts: RunCounts,
    /// Messages of `visod/odometry` published.
    pub(crate) published: u64,
    /// What could not be handed on.
    pub(crate) undelivered: Undelivered,
    /// Subscribers of `visod/odometry`.
    pub(crate) subscribers: usize,
    /// Rows that came after the deadline.
    pub(crate) overruns: u64,
    /// Rows that took more work than there is time between two pairs.
    pub(crate) over_period: u64,
    /// Share of the features that is looked for, 0 to 1.
    pub(crate) share: f32,
}

/// The figures of a run that somebody may ask for.
#[derive(Clone, Debug)]
pub(crate) struct Metrics(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    cameras: Monitor,
    totals: Mutex<Totals>,
    latencies: [Histogram; STAGES.len()],
}

impl Metrics {
    /// Begins to answer questions about a run, if the configuration wants it.
    pub(crate) fn serve(
        config: &Config,
        cameras: Monitor,
    ) -> Result<Option<(Self, Exposition)>, Failure> {
        let address = config
            .metrics
            .address()
            .map_err(|e| Failure::usage(format!("metrics.{}: {}", e.key, e.cause)))?;
        let Some(address) = address else {
            return Ok(None);
        };
        let metrics = Self(Arc::new(Inner {
            cameras,
            totals: Mutex::default(),
            latencies: STAGES.map(|_| Histogram::new(BINS_S)),
        }));
        let mut registry = Registry::with_prefix("visod");
        registry.register_collector(Box::new(metrics.clone()));
        let exposition = Exposition::start(&address, move || {
            let mut text = String::new();
            // Writing to a String cannot fail.
            let _ = prometheus_text::encode(&mut text, &registry);
            text
        })
        .map_err(|e| Failure::other(format!("metrics.listen: {e}")))?;
        tracing::info!("figures for Prometheus are at {}", exposition.address());
        Ok(Some((metrics, exposition)))
    }

    /// Takes note of a row.
    pub(crate) fn add(&self, delivery: &Delivery<'_>, totals: Totals) {
        *self.totals() = totals;
        if delivery.unusable.is_none() {
            let StageLatencies {
                features,
                matching,
                estimation,
                total,
            } = delivery.latencies;
            let took = [features, matching, estimation, total];
            for (histogram, took) in self.0.latencies.iter().zip(took) {
                histogram.observe(took.as_secs_f64());
            }
        }
    }

    fn totals(&self) -> MutexGuard<'_, Totals> {
        self.0.totals.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Collector for Metrics {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let totals = *self.totals();
        let cameras = self.0.cameras.snapshot();
        let mut page = Page(encoder);
        page.pipeline(&totals, &cameras)?;
        page.cameras(&cameras)?;
        page.family(
            "stage_seconds",
            "Time that a stage took for a pair; total is from its arrival to its row",
            MetricType::Histogram,
            STAGES
                .into_iter()
                .zip(&self.0.latencies)
                .map(|(stage, histogram)| ([("stage", stage)], histogram.clone())),
        )
    }
}

/// What is written for one question.
struct Page<'a>(DescriptorEncoder<'a>);

impl Page<'_> {
    fn pipeline(&mut self, totals: &Totals, cameras: &Snapshot) -> fmt::Result {
        let Totals { counts, .. } = totals;
        let by_status = [
            ("initializing", counts.initializing),
            ("tracking", counts.tracking),
            ("degraded", counts.degraded),
            ("lost", counts.lost),
        ];
        self.counters(
            "rows",
            "Rows of odometry by status",
            by_status.map(|(status, n)| ([("status", status)], n)),
        )?;
        let drops = pipeline::drops(Some(cameras), counts, &totals.undelivered);
        self.counters(
            "drops",
            "What was lost by stage and reason: frames of one camera, else pairs or messages",
            drops.iter().map(|d| {
                let labels = [
                    ("stage", d.stage),
                    ("reason", d.reason),
                    ("camera", d.camera),
                ];
                (labels, d.count)
            }),
        )?;
        self.counter(
            "epochs",
            "Times that the odometry frame began anew",
            counts.restarts,
        )?;
        self.counter(
            "overruns",
            "Rows that came after service.deadline_s",
            totals.overruns,
        )?;
        self.counter(
            "over_period",
            "Rows that took more work than there is time between two pairs",
            totals.over_period,
        )?;
        self.counter("published", "Messages of visod/odometry", totals.published)?;
        self.gauge(
            "subscribers",
            "Subscribers of visod/odometry",
            totals.subscribers as f64,
        )?;
        self.gauge(
            "features_share",
            "Share of the features that is looked for",
            f64::from(totals.share),
        )?;
        self.gauge(
            "pairs_waiting",
            "Pairs that wait for the stages",
            cameras.waiting as f64,
        )?;
        let period = Duration::from_nanos(u64::try_from(cameras.period_ns).unwrap_or(0));
        self.gauge(
            "period_seconds",
            "Time between two pairs, as it usually is",
            period.as_secs_f64(),
        )
    }

    fn cameras(&mut self, cameras: &Snapshot) -> fmt::Result {
        let sides = || ["left", "right"].into_iter().zip(&cameras.cameras);
        let of = |side| [("camera", side)];
        self.counters(
            "frames",
            "Frames received",
            sides().map(|(side, c)| (of(side), c.frames)),
        )?;
        self.counters(
            "reconnects",
            "Times that a camera was opened anew",
            sides().map(|(side, c)| (of(side), c.reconnects)),
        )?;
        self.counters(
            "clock_steps",
            "Times that a camera's clock was set or began anew",
            sides().map(|(side, c)| (of(side), c.clock_steps)),
        )?;
        self.family(
            "camera_streams",
            "Whether a camera sends frames",
            MetricType::Gauge,
            sides().map(|(side, c)| {
                let streams = u32::from(c.state == State::Streaming);
                (of(side), ConstGauge::new(streams))
            }),
        )
    }

    fn counter(&mut self, name: &str, help: &str, count: u64) -> fmt::Result {
        let encoder = self
            .0
            .encode_descriptor(name, help, None, MetricType::Counter)?;
        ConstCounter::new(count).encode(encoder)
    }

    fn gauge(&mut self, name: &str, help: &str, value: f64) -> fmt::Result {
        let encoder = self
            .0
            .encode_descriptor(name, help, None, MetricType::Gauge)?;
        ConstGauge::new(value).encode(encoder)
    }

    fn counters<L: EncodeLabelSet>(
        &mut self,
        name: &str,
        help: &str,
        counts: impl IntoIterator<Item = (L, u64)>,
    ) -> fmt::Result {
        let counts = counts.into_iter();
        let counts = counts.map(|(labels, count)| (labels, ConstCounter::new(count)));
        self.family(name, help, MetricType::Counter, counts)
    }

    fn family<L: EncodeLabelSet, M: EncodeMetric>(
        &mut self,
        name: &str,
        help: &str,
        of: MetricType,
        members: impl IntoIterator<Item = (L, M)>,
    ) -> fmt::Result {
        let mut encoder: MetricEncoder<'_> = self.0.encode_descriptor(name, help, None, of)?;
        for (labels, metric) in members {
            metric.encode(encoder.encode_family(&labels)?)?;
        }
        Ok(())
    }
}
