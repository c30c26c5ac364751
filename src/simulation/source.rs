//! A simulation in, its pairs one after the other out: a camera that needs no hardware.

use super::Simulation;
use crate::capture::{PairEvent, PairSource};
use nalgebra::Isometry3;
use std::sync::Arc;

/// Hands out a simulation's pairs in order, each rendered when it is asked for.
pub struct SimulatedSource {
    simulation: Arc<Simulation>,
    next: u64,
}

impl SimulatedSource {
    /// A source that begins with the simulation's first pair.
    #[must_use]
    pub fn new(simulation: Arc<Simulation>) -> Self {
        Self {
            simulation,
            next: 0,
        }
    }

    /// The simulation, which knows the truth.
    #[must_use]
    pub fn simulation(&self) -> &Simulation {
        &self.simulation
    }

    /// The true pose of pair `sequence`.
    #[must_use]
    pub fn truth(&self, sequence: u64) -> Isometry3<f64> {
        self.simulation.odom_from_camera(sequence)
    }
}

impl PairSource for SimulatedSource {
    fn next_event(&mut self) -> Option<PairEvent> {
        if self.next >= self.simulation.settings().frames {
            return None;
        }
        let (pair, _) = self.simulation.pair(self.next);
        self.next += 1;
        Some(PairEvent::Pair(pair))
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.simulation.settings().frames)
    }
}
