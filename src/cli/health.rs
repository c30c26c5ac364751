//! The state of a run, as `visod/health` tells it.

use crate::capture::live::{Snapshot, State};
use crate::estimation::Status;
use crate::output::health::{CameraState, HealthMessage, RigCondition};
use crate::output::message::status_code;
use crate::pipeline::Delivery;
use crate::rig_watch::RigState;
use crate::service::budget::FrameBudget;
use std::time::{Duration, Instant};

/// How often health is published, at least.
const HEALTH_PERIOD: Duration = Duration::from_secs(1);

/// The state that goes to `visod/health`: every second, and whenever the status changes.
pub(crate) struct Health {
    started: Instant,
    message: HealthMessage,
    status: Option<Status>,
    first_epoch: Option<u32>,
    changed: bool,
    published: Option<Instant>,
    busy_total: Duration,
    camera_states: (u32, u32),
}

impl Default for Health {
    /// A daemon that starts now.
    fn default() -> Self {
        Self {
            started: Instant::now(),
            message: HealthMessage::default(),
            status: None,
            first_epoch: None,
            changed: false,
            published: None,
            busy_total: Duration::ZERO,
            camera_states: (0, 0),
        }
    }
}

impl Health {
    /// Takes note of a pair. A recording's cameras stream as long as it has images.
    pub(crate) fn add(&mut self, delivery: &Delivery<'_>) {
        let odometry = delivery.odometry;
        let took = &delivery.latencies;
        let busy = took.features + took.matching + took.estimation;
        self.changed |= self.status != Some(odometry.status);
        self.status = Some(odometry.status);
        self.busy_total += busy;
        let ns = |d: Duration| u64::try_from(d.as_nanos()).unwrap_or(u64::MAX);
        let m = &mut self.message;
        m.odometry_status = status_code(odometry.status);
        let first_epoch = *self.first_epoch.get_or_insert(odometry.epoch);
        m.restarts = u64::from(odometry.epoch.saturating_sub(first_epoch));
        m.pairs_processed += 1;
        m.left_state = CameraState::Streaming as u32;
        m.right_state = CameraState::Streaming as u32;
        if delivery.unusable.is_some() {
            m.pairs_unusable += 1;
        } else {
            m.left_frames += 1;
            m.right_frames += 1;
        }
        m.pairs_lost += u64::from(odometry.status == Status::Lost);
        m.pairs_degraded += u64::from(odometry.status == Status::Degraded);
        m.busy_max_ns = m.busy_max_ns.max(ns(busy));
        m.busy_mean_ns = ns(self.busy_total) / m.pairs_processed;
        if let Some(rig) = &delivery.rig {
            self.add_rig(rig);
        }
    }

    /// Takes note of how the rig is.
    fn add_rig(&mut self, rig: &RigState) {
        let condition = if rig.has_moved {
            RigCondition::Moved
        } else if rig.misfits {
            RigCondition::Misfits
        } else {
            RigCondition::Good
        } as u32;
        let m = &mut self.message;
        self.changed |= m.rig_state != condition;
        m.rig_state = condition;
        // Beyond two radians, which no rig turns by, the cast saturates.
        [m.rig_pitch_nrad, m.rig_yaw_nrad, m.rig_roll_nrad] =
            [0, 1, 2].map(|i| (rig.turn_rad[i] * 1e9).round() as i32);
    }

    /// Takes note of how the cameras are.
    pub(crate) fn add_cameras(&mut self, cameras: &Snapshot) {
        let state = |state: State| match state {
            State::Opening => CameraState::Opening,
            State::Streaming => CameraState::Streaming,
            State::Stalled => CameraState::Stalled,
            State::Lost => CameraState::Lost,
        } as u32;
        let [left, right] = &cameras.cameras;
        let m = &mut self.message;
        let states = (state(left.state), state(right.state));
        self.changed |= states != self.camera_states;
        self.camera_states = states;
        (m.left_state, m.right_state) = states;
        (m.left_frames, m.right_frames) = (left.frames, right.frames);
        (m.left_reconnects, m.right_reconnects) = (left.reconnects, right.reconnects);
        (m.left_last_monotonic_ns, m.right_last_monotonic_ns) =
            (left.last_arrived_ns, right.last_arrived_ns);
        (m.left_lost_in_transport, m.right_lost_in_transport) =
            (left.losses.in_transport(), right.losses.in_transport());
        (m.left_unreadable, m.right_unreadable) = (left.losses.unusable(), right.losses.unusable());
        (m.left_unmatched, m.right_unmatched) = (left.unmatched.total(), right.unmatched.total());
        m.pairs_dropped = cameras.dropped;
    }

    /// Takes note of how the time goes.
    pub(crate) fn add_budget(&mut self, budget: &FrameBudget, period_ns: i64) {
        let m = &mut self.message;
        let permille = (budget.share() * 1000.0).round() as u32;
        self.changed |= m.features_permille != permille;
        m.features_permille = permille;
        m.degraded_mode = u32::from(permille < 1000);
        m.budget_ns = u64::try_from(period_ns).unwrap_or(0);
        m.over_budget = budget.over_period();
        m.overruns = budget.overruns();
    }

    /// The message, with what the publisher knows.
    pub(crate) fn message(&self, subscribers: usize, publish_failures: u64) -> HealthMessage {
        HealthMessage {
            subscribers: subscribers as u64,
            publish_failures,
            uptime_ns: u64::try_from(self.started.elapsed().as_nanos()).unwrap_or(u64::MAX),
            ..self.message
        }
    }

    /// Whether it is time to publish; if so, the time counts from now.
    pub(crate) fn is_due(&mut self) -> bool {
        let due = self.changed || self.published.is_none_or(|t| t.elapsed() >= HEALTH_PERIOD);
        if due {
            self.changed = false;
            self.published = Some(Instant::now());
        }
        due
    }
}
