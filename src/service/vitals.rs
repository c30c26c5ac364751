//! Signs of life in; whether the daemon is alive, or what hangs, out.
//!
//! A camera that is away is no reason to restart, for a new process would have to wait for it just the
//! same and would lose the odometry frame. A thread that hangs is: so every camera's thread must show
//! itself, each camera that claims to stream must send frames, and rows must leave the pipeline.

use std::time::Duration;

/// When a camera, and the thread that attends to it, last showed itself.
#[derive(Clone, Copy, Debug)]
pub struct CameraSigns {
    /// Whether it is said to send frames.
    pub streams: bool,
    /// Since its last frame.
    pub since_frame: Duration,
    /// Since its thread last looked at it.
    pub since_look: Duration,
}

/// When the parts of the daemon last showed themselves.
#[derive(Clone, Copy, Debug)]
pub struct Signs {
    /// Left, right.
    pub cameras: [CameraSigns; 2],
    /// Since the last row left the pipeline, or since the start.
    pub since_row: Duration,
}

/// How long a part may be silent.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// A camera that streams, before its own thread must have noticed.
    pub frame: Duration,
    /// A camera's thread, which may have to wait for a driver.
    pub look: Duration,
    /// The pipeline.
    pub row: Duration,
}

impl Limits {
    /// For cameras that count as stalled after `stall`: their threads notice by then, or within twice that
    /// where frames arrive but are unusable; drivers answer, and pairs are done, within `patience`.
    #[must_use]
    pub fn new(stall: Duration, patience: Duration) -> Self {
        Self {
            frame: 2 * stall + Duration::from_secs(1),
            look: patience,
            row: patience,
        }
    }
}

/// Whether all is alive.
///
/// # Errors
/// What hangs, in a few words.
pub fn judge(signs: &Signs, limits: &Limits) -> Result<(), String> {
    for (side, camera) in ["left", "right"].into_iter().zip(&signs.cameras) {
        if camera.since_look > limits.look {
            return Err(format!(
                "the thread of the {side} camera has not shown itself for {:.1} s",
                camera.since_look.as_secs_f64()
            ));
        }
        if camera.streams && camera.since_frame > limits.frame {
            return Err(format!(
                "the {side} camera is said to stream, but has sent nothing for {:.1} s",
                camera.since_frame.as_secs_f64()
            ));
        }
    }
    if signs.since_row > limits.row {
        return Err(format!(
            "no row has left the pipeline for {:.1} s",
            signs.since_row.as_secs_f64()
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits {
        frame: Duration::from_secs(5),
        look: Duration::from_secs(8),
        row: Duration::from_secs(6),
    };

    fn signs() -> Signs {
        let camera = CameraSigns {
            streams: true,
            since_frame: Duration::from_millis(50),
            since_look: Duration::from_millis(10),
        };
        Signs {
            cameras: [camera; 2],
            since_row: Duration::from_millis(60),
        }
    }

    fn why(change: impl FnOnce(&mut Signs)) -> Option<String> {
        let mut signs = signs();
        change(&mut signs);
        judge(&signs, &LIMITS).err()
    }

    #[test]
    fn what_flows_is_alive() {
        assert_eq!(why(|_| ()), None);
    }

    #[test]
    fn a_camera_that_is_known_to_be_away_is_no_reason_to_die() {
        let away = |signs: &mut Signs| {
            signs.cameras[1].streams = false;
            signs.cameras[1].since_frame = Duration::from_secs(3600);
        };
        assert_eq!(why(away), None);
    }

    #[test]
    fn each_part_that_hangs_is_noticed() {
        let long = Duration::from_secs(9);
        let frames = why(|s| s.cameras[0].since_frame = long);
        assert!(frames.is_some_and(|w| w.contains("left camera is said to stream")));
        let thread = why(|s| s.cameras[1].since_look = long);
        assert!(thread.is_some_and(|w| w.contains("thread of the right camera")));
        let rows = why(|s| s.since_row = long);
        assert!(rows.is_some_and(|w| w.contains("no row")));
    }
}
