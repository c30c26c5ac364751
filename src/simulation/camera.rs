//! A simulation in; one of its cameras out, at the simulation's own pace.

use super::Simulation;
use crate::capture::Side;
use crate::capture::camera::{CameraError, CameraEvent, Clock, Frame, FrameSource, monotonic_ns};
use std::sync::Arc;
use std::time::Duration;

/// One camera of a [`Simulation`]: each frame is rendered when it is asked for, which takes as long as
/// it takes.
pub struct SimulatedCamera {
    simulation: Arc<Simulation>,
    side: Side,
    next: u64,
    is_running: bool,
}

impl SimulatedCamera {
    /// The camera of one side, which begins with the first frame.
    #[must_use]
    pub fn new(simulation: Arc<Simulation>, side: Side) -> Self {
        Self {
            simulation,
            side,
            next: 0,
            is_running: false,
        }
    }
}

impl FrameSource for SimulatedCamera {
    fn size_px(&self) -> (u32, u32) {
        let rig = self.simulation.rig();
        let camera = match self.side {
            Side::Left => &rig.left,
            Side::Right => &rig.right,
        };
        (camera.width, camera.height)
    }

    fn identity(&self) -> String {
        format!("simulated {:?} camera", self.side).to_lowercase()
    }

    fn clock(&self) -> Clock {
        Clock::Shared
    }

    fn start(&mut self) -> Result<(), CameraError> {
        self.is_running = true;
        Ok(())
    }

    fn next(&mut self, patience: Duration) -> Result<CameraEvent, CameraError> {
        if !self.is_running {
            std::thread::sleep(patience);
            return Ok(CameraEvent::Quiet);
        }
        if self.next >= self.simulation.settings().frames {
            return Ok(CameraEvent::End);
        }
        let number = self.next;
        self.next += 1;
        Ok(CameraEvent::Frame(Frame {
            number,
            stamp_ns: self.simulation.timestamp_ns(number),
            arrived_ns: monotonic_ns(),
            image: self.simulation.image(number, self.side),
        }))
    }

    fn stop(&mut self) {
        self.is_running = false;
    }
}
