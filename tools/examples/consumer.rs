//! A consumer of visod's odometry in a few lines: `cargo run --release --example consumer`.
//!
//! Another crate needs `visod = { version = "0.1", default-features = false, features = ["ipc"] }`.

use std::time::Duration;
use visod::output::publication::Settings;
use visod::output::subscriber::{OdometrySubscriber, Wake};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let settings = Settings::default();
    let mut odometry = OdometrySubscriber::handling_signals("consumer example", &settings)?;
    loop {
        match odometry.wait(Duration::from_secs(1))? {
            Wake::Terminated => return Ok(()),
            // A publisher that was killed says nothing: a robot must act on silence.
            Wake::Timeout => eprintln!("no odometry for a second"),
            Wake::Message => {
                while let Some(received) = odometry.receive()? {
                    let m = received.message;
                    let sigma_x_m = m.cov_pose[0].sqrt();
                    println!(
                        "{} {:?} x = {:.3} m ± {sigma_x_m:.3} m",
                        m.sequence,
                        m.status(),
                        m.position_m[0]
                    );
                }
            }
        }
    }
}
