//! What the cameras' threads, the source of pairs and its monitors share: one assembly, behind a lock.

use super::assembly::Assembly;
use super::name_of;
use super::queue::Delivery;
use super::status::State;
use crate::capture::Side;
use crate::capture::camera::{Clock, Frame, FrameSource, Loss, monotonic_ns};
use crate::capture::settings::Settings;
use crate::image::GrayImage;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// What the threads share.
#[derive(Debug)]
pub(in crate::capture) struct Shared {
    pub(super) settings: Settings,
    assembly: Mutex<Assembly>,
    changed: Condvar,
    /// When each camera's thread last showed itself, CLOCK_MONOTONIC.
    pub(super) looks_ns: [AtomicI64; 2],
}

impl Shared {
    pub(super) fn new(
        settings: Settings,
        delivery: Delivery,
        sources: [&dyn FrameSource; 2],
    ) -> Self {
        let assembly = Assembly::new(&settings, delivery, sources);
        Self {
            settings,
            assembly: Mutex::new(assembly),
            changed: Condvar::new(),
            looks_ns: [(); 2].map(|()| AtomicI64::new(monotonic_ns())),
        }
    }

    pub(super) fn lock(&self) -> MutexGuard<'_, Assembly> {
        // What a panicking thread leaves behind is whole: each change is a few assignments.
        self.assembly.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn wait<'a>(
        &self,
        assembly: MutexGuard<'a, Assembly>,
        time: Duration,
    ) -> MutexGuard<'a, Assembly> {
        let waited = self.changed.wait_timeout(assembly, time);
        waited.map_or_else(|e| e.into_inner().0, |(assembly, _)| assembly)
    }

    /// A camera's thread shows itself, and is told whether the run is over.
    pub(in crate::capture) fn look(&self, side: Side) -> bool {
        self.looks_ns[side as usize].store(monotonic_ns(), Ordering::Relaxed);
        self.lock().is_over
    }

    pub(super) fn stop(&self) {
        self.lock().is_over = true;
        self.changed.notify_all();
    }

    /// Waits; true if the run ended meanwhile.
    pub(in crate::capture) fn waits_out(&self, time: Duration) -> bool {
        let deadline = Instant::now() + time;
        let mut assembly = self.lock();
        while !assembly.is_over {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            assembly = self.wait(assembly, left);
        }
        true
    }

    pub(in crate::capture) fn frames(&self, side: Side) -> u64 {
        self.lock().cameras[side as usize].frames
    }

    pub(in crate::capture) fn take_spare(&self, side: Side) -> Option<GrayImage> {
        self.lock().spares.take(side)
    }

    pub(in crate::capture) fn end(&self, side: Side) {
        self.lock().ended[side as usize] = true;
        self.changed.notify_all();
    }

    pub(in crate::capture) fn set_state(&self, side: Side, state: State, cause: &str) {
        let camera = name_of(side);
        let mut assembly = self.lock();
        let status = &mut assembly.cameras[side as usize];
        let is_new = status.state != state || *status.cause != *cause;
        status.state = state;
        if is_new {
            status.cause = cause.into();
        }
        drop(assembly);
        if is_new {
            let state = state.as_str();
            tracing::warn!(
                camera,
                state,
                cause,
                "the {camera} camera is {state}: {cause}"
            );
        }
    }

    /// A camera was opened anew: its counts and its clock began anew.
    pub(in crate::capture) fn reopened(&self, side: Side, clock: Clock) {
        self.lock().reopen(side, clock);
        let camera = name_of(side);
        tracing::info!(camera, "the {camera} camera was opened anew");
    }

    pub(in crate::capture) fn lost(&self, side: Side, kind: Loss, frames: u64) {
        self.lock().lose(side, kind, frames);
    }

    pub(in crate::capture) fn frame(&self, side: Side, frame: Frame) {
        let mut assembly = self.lock();
        let was = assembly.cameras[side as usize].state;
        assembly.take(side, frame);
        drop(assembly);
        self.changed.notify_all();
        if was != State::Streaming {
            let camera = name_of(side);
            tracing::info!(camera, "the {camera} camera streams");
        }
    }
}
