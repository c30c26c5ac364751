//! How long a message takes to a subscriber in another process, and what eight of them, one that has been
//! stopped and one that is killed over and over, cost the publisher: `cargo bench --bench publication`.
//!
//! Messages are published at 200 Hz, as a robot's cameras would at their fastest. The subscribers wait for
//! events, as `visod listen` does; one that polls instead shows what of the time is the waking up.

mod common;

use common::quantile_us;
use nalgebra::{Isometry3, Matrix6, Vector6};
use std::io::{BufRead, BufReader};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};
use visod::estimation::{Counts, ErrorBudget, Odometry, Status};
use visod::output::message::{CaptureTime, Latencies, OdometryMessage};
use visod::output::monotonic_ns;
use visod::output::publication::Settings;
use visod::output::publisher::Publisher;
use visod::output::subscriber::{OdometrySubscriber, Wake};

const PERIOD: Duration = Duration::from_millis(5);
const MESSAGES: usize = 4000;
/// Set in a process that is a subscriber.
const ROOT: &str = "VISOD_BENCH_ROOT";
/// Set where it does not wait for events.
const POLLS: &str = "VISOD_BENCH_POLLS";

type Outcome = Result<(), Box<dyn std::error::Error>>;

fn main() -> Outcome {
    if let Some(root) = std::env::var_os(ROOT) {
        return subscribe(&settings(root.into()));
    }
    println!("\n### Publication, {MESSAGES} messages at 200 Hz\n");
    println!(
        "| subscribers | sending: median µs | p99 µs | max µs | arrival: median µs | p99 µs | max µs |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|");
    measure("one, polling", 1, true, |_| ())?;
    measure("one", 1, false, |_| ())?;
    measure("eight", 8, false, |_| ())?;
    measure("eight, one of them stopped", 8, false, |listeners| {
        listeners.stop_second();
    })?;
    measure(
        "eight, one stopped, one killed and started anew every 250 ms",
        8,
        false,
        |listeners| {
            listeners.stop_second();
            listeners.replace_last();
        },
    )
}

/// A system that nobody else meets.
fn settings(root: PathBuf) -> Settings {
    Settings {
        root: Some(root),
        prefix: Some("visod_bench_".to_owned()),
        ..Settings::default()
    }
}

fn message(sequence: u64) -> OdometryMessage {
    let odometry = Odometry {
        sequence,
        timestamp_ns: monotonic_ns(),
        epoch: 0,
        status: Status::Tracking,
        odom_from_camera: Isometry3::identity(),
        cov_pose: Matrix6::identity(),
        prev_from_now: Isometry3::identity(),
        cov_motion: Matrix6::identity(),
        twist: Vector6::zeros(),
        cov_twist: Matrix6::identity(),
        budget: ErrorBudget::default(),
        counts: Counts::default(),
        variance_factor: 1.0,
        innovation_ratio: 0.25,
    };
    let stamp = CaptureTime::Recorded(odometry.timestamp_ns);
    OdometryMessage::new(&odometry, None, stamp, Latencies::default())
}

/// Publishes to `count` subscribers, and prints how long that took, and how long it took the first of them
/// to have each message. `torment` is done to them every 250 ms.
fn measure(
    name: &str,
    count: usize,
    polls: bool,
    torment: impl Fn(&mut Listeners) + Send,
) -> Outcome {
    let folder = tempfile::tempdir()?;
    let settings = settings(folder.path().join("iox"));
    let mut publisher = Publisher::new(&settings)?;
    let mut listeners = Listeners::start(&settings, &publisher, count, polls)?;
    let over = AtomicBool::new(false);
    let mut sending = Vec::with_capacity(MESSAGES);
    let sent = std::thread::scope(|scope| {
        let over = &over;
        let listeners = &mut listeners;
        scope.spawn(move || {
            while !over.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(250));
                torment(listeners);
            }
        });
        let mut due = Instant::now();
        let sent = (0..MESSAGES).try_for_each(|n| {
            std::thread::sleep(due.saturating_duration_since(Instant::now()));
            due += PERIOD;
            let message = message(n as u64);
            let started = Instant::now();
            publisher.publish(&message)?;
            sending.push(started.elapsed());
            Ok::<_, visod::output::IpcError>(())
        });
        over.store(true, Ordering::Relaxed);
        sent
    });
    sent?;
    let arrivals = listeners.end()?;
    let [send, arrive] = [sending, arrivals].map(|mut times| {
        times.sort_unstable();
        [0.5, 0.99, 1.0].map(|share| quantile_us(&times, share))
    });
    println!(
        "| {name} | {:.1} | {:.1} | {:.0} | {:.1} | {:.1} | {:.0} |",
        send[0], send[1], send[2], arrive[0], arrive[1], arrive[2]
    );
    Ok(())
}

/// Subscribers in processes of their own; the first says how long each message took to it.
struct Listeners {
    settings: Settings,
    processes: Vec<Child>,
}

impl Listeners {
    fn start(
        settings: &Settings,
        publisher: &Publisher,
        count: usize,
        polls: bool,
    ) -> Result<Self, Box<dyn std::error::Error>> {
        let processes = (0..count)
            .map(|_| start_one(settings, polls))
            .collect::<Result<_, _>>()?;
        if !publisher.wait_for_subscribers(count, Duration::from_secs(20)) {
            return Err("the subscribers do not come".into());
        }
        Ok(Self {
            settings: settings.clone(),
            processes,
        })
    }

    /// Stops the second, which has messages wait for it from then on.
    fn stop_second(&self) {
        let pid = rustix::process::Pid::from_child(&self.processes[1]);
        let _ = rustix::process::kill_process(pid, rustix::process::Signal::STOP);
    }

    /// Kills the last and starts it anew.
    fn replace_last(&mut self) {
        if let (Some(mut last), Ok(new)) = (self.processes.pop(), start_one(&self.settings, false))
        {
            let _ = last.kill();
            let _ = last.wait();
            self.processes.push(new);
        }
    }

    /// What the first has measured, once it has the last message; the others are killed.
    fn end(mut self) -> Result<Vec<Duration>, Box<dyn std::error::Error>> {
        let first = &mut self.processes[0];
        let out = first.stdout.take().ok_or("it has no output")?;
        let times: Result<Vec<_>, _> = BufReader::new(out)
            .lines()
            .map(|line| Ok::<_, Box<dyn std::error::Error>>(Duration::from_nanos(line?.parse()?)))
            .collect();
        for process in &mut self.processes {
            let _ = process.kill();
            let _ = process.wait();
        }
        times
    }
}

fn start_one(settings: &Settings, polls: bool) -> std::io::Result<Child> {
    let root = settings.root.clone().unwrap_or_default();
    let mut command = Command::new(std::env::current_exe()?);
    if polls {
        command.env(POLLS, "yes");
    }
    command.env(ROOT, root).stdout(Stdio::piped()).spawn()
}

/// Receives until the last message, then prints how long each took, ns.
fn subscribe(settings: &Settings) -> Outcome {
    let mut subscriber = OdometrySubscriber::new("bench", settings)?;
    let mut took = Vec::with_capacity(MESSAGES);
    let polls = std::env::var_os(POLLS).is_some();
    // One that comes late, or is never killed, ends some time.
    let patience = Duration::from_secs(20);
    while polls || subscriber.wait(patience)? == Wake::Message {
        let mut is_last = false;
        while let Some(received) = subscriber.receive()? {
            took.push(monotonic_ns() - received.message.published_monotonic_ns);
            is_last = received.message.sequence == MESSAGES as u64 - 1;
        }
        if is_last {
            break;
        }
    }
    for ns in took {
        println!("{ns}");
    }
    Ok(())
}
