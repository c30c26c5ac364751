//! `visod listen`: subscribes like any consumer and prints what comes.

use super::Failure;
use crate::output::publication::Settings;
use std::path::PathBuf;

/// Print odometry as it is published: pose ± σ, rate and latency.
///
/// On a terminal a picture of the last estimate with its error budget and the state of the cameras; in a
/// pipe a line an estimate. Colours are off in pipes and where NO_COLOR is set.
///
/// Waits for a publisher if there is none yet. Ends with success on SIGINT, SIGTERM, after --count
/// messages, or when its output is closed.
#[derive(clap::Args)]
#[command(
    after_help = "Examples:\n  visod listen\n  visod listen --json --count 1 --timeout 5\n  \
                        visod listen --csv > odometry.csv"
)]
pub(crate) struct Args {
    /// Print one JSON object a line, with all that was published.
    #[arg(long, conflicts_with_all = ["csv", "lines"])]
    json: bool,
    /// Print the odometry CSV that `replay --odometry` writes.
    #[arg(long, conflicts_with = "lines")]
    csv: bool,
    /// Print a line an estimate on a terminal, too, where one picture is drawn over and over otherwise.
    #[arg(long)]
    lines: bool,
    /// End after this many messages.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// Fail after this many seconds without a message [default: wait for ever].
    #[arg(long, value_name = "S", value_parser = parse_seconds)]
    timeout: Option<std::time::Duration>,
    /// Directory of iceoryx2's files, as the publisher's `publish.root`.
    #[arg(long, value_name = "DIR")]
    service_root: Option<PathBuf>,
    /// Prefix of iceoryx2's files, as the publisher's `publish.prefix`.
    #[arg(long, value_name = "NAME")]
    service_prefix: Option<String>,
}

/// Seconds, more than 0 and at most a day.
fn parse_seconds(text: &str) -> Result<std::time::Duration, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s <= 86_400.0 => Ok(std::time::Duration::from_secs_f64(s)),
        _ => Err("must be seconds, more than 0 and at most 86400".to_owned()),
    }
}

#[cfg(not(feature = "ipc"))]
pub(crate) fn run(_: &Args) -> Result<(), Failure> {
    Err(Failure::usage(
        "this visod was built without the feature ipc, so it cannot listen",
    ))
}

#[cfg(feature = "ipc")]
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let settings = args.settings();
    settings
        .check()
        .map_err(|e| Failure::usage(format!("--service-{}: {}", e.key, e.cause)))?;
    running::listen(args, &settings)
}

impl Args {
    /// Whether a picture is drawn.
    #[cfg(feature = "ipc")]
    fn is_view(&self) -> bool {
        use std::io::IsTerminal;
        let can_draw = std::env::var_os("TERM").is_some_and(|term| term != "dumb");
        !self.json && !self.csv && !self.lines && can_draw && std::io::stdout().is_terminal()
    }

    #[cfg_attr(
        not(feature = "ipc"),
        expect(dead_code, reason = "only a listener reads them")
    )]
    fn settings(&self) -> Settings {
        Settings {
            root: self.service_root.clone(),
            prefix: self.service_prefix.clone(),
            ..Settings::default()
        }
    }
}

#[cfg(feature = "ipc")]
mod running {
    use super::super::listen_view::{Scene, Screen};
    use super::{Args, Failure};
    use crate::output::health::HealthMessage;
    use crate::output::message::{OdometryMessage, PoseFrame};
    use crate::output::publication::Settings;
    use crate::output::row::OdometryRow;
    use crate::output::subscriber::{HealthSubscriber, OdometrySubscriber, Received, Wake};
    use crate::output::{csv, json};
    use std::collections::VecDeque;
    use std::fmt::Write as _;
    use std::io::{self, ErrorKind, Write as _};
    use std::time::{Duration, Instant};

    /// A stream that is silent for longer is told of.
    const SILENCE: Duration = Duration::from_secs(1);
    /// Intervals that the rate is the mean of.
    const RATE_WINDOW: usize = 20;

    /// Whether to go on.
    #[derive(PartialEq)]
    enum Next {
        Continue,
        End,
    }

    pub(super) fn listen(args: &Args, settings: &Settings) -> Result<(), Failure> {
        let mut subscriber = OdometrySubscriber::handling_signals("visod listen", settings)
            .map_err(Failure::other)?;
        let mut shown = Shown::new(args, settings)?;
        if args.csv && print_line(&csv::header_line())? == Next::End {
            return Ok(());
        }
        let mut silence = Silence::new(args.timeout, matches!(shown, Shown::View(_)));
        let mut messages = 0;
        let mut complaint = String::new();
        loop {
            match subscriber.wait(silence.patience()) {
                Ok(Wake::Terminated) => return Ok(()),
                Ok(Wake::Timeout) => silence.note(&subscriber)?,
                Ok(Wake::Message) => match subscriber.receive() {
                    Ok(None) => {}
                    Ok(Some(received)) => {
                        silence.end();
                        complaint.clear();
                        messages += 1;
                        let is_last = args.count == Some(messages);
                        if shown.take(&received, is_last)? == Next::End || is_last {
                            return Ok(());
                        }
                    }
                    Err(e) => {
                        shown.complain(&e.to_string(), &mut complaint);
                        silence.note(&subscriber)?;
                    }
                },
                Err(e) => {
                    shown.complain(&e.to_string(), &mut complaint);
                    silence.note(&subscriber)?;
                }
            }
            if shown.pass_time(&silence)? == Next::End {
                return Ok(());
            }
        }
    }

    /// Watches for a stream that stops.
    struct Silence {
        since: Instant,
        told: bool,
        timeout: Option<Duration>,
        /// Somebody looks at a picture, which tells of it.
        is_shown: bool,
    }

    impl Silence {
        fn new(timeout: Option<Duration>, is_shown: bool) -> Self {
            Self {
                since: Instant::now(),
                told: is_shown,
                timeout,
                is_shown,
            }
        }

        fn end(&mut self) {
            self.since = Instant::now();
            self.told = self.is_shown;
        }

        /// How long to wait before the next thing there is to say.
        fn patience(&self) -> Duration {
            let quiet = self.since.elapsed();
            let to_timeout = self.timeout.map_or(SILENCE, |t| t.saturating_sub(quiet));
            if self.told {
                to_timeout.min(SILENCE)
            } else {
                to_timeout.min(SILENCE.saturating_sub(quiet))
            }
        }

        /// Nothing came: warns once, and gives up when the time is over.
        fn note(&mut self, subscriber: &OdometrySubscriber) -> Result<(), Failure> {
            let quiet = self.since.elapsed();
            if let Some(timeout) = self.timeout.filter(|t| quiet >= *t) {
                let cause = if subscriber.publishers() == 0 {
                    "there is no publisher"
                } else {
                    "although there is a publisher"
                };
                let seconds = timeout.as_secs_f64();
                return Err(Failure::other(format!(
                    "no odometry for {seconds} s: {cause}"
                )));
            }
            if !self.told && quiet >= SILENCE {
                self.told = true;
                if subscriber.publishers() > 0 {
                    eprintln!(
                        "visod: no data for {:.1} s, although there is a publisher",
                        quiet.as_secs_f64()
                    );
                }
            }
            Ok(())
        }
    }

    /// Where messages go: a line each, or one picture of the last.
    enum Shown<'a> {
        Lines(Lines<'a>),
        View(Box<View>),
    }

    impl<'a> Shown<'a> {
        fn new(args: &'a Args, settings: &Settings) -> Result<Self, Failure> {
            if !args.is_view() {
                return Ok(Self::Lines(Lines::new(args)));
            }
            let health = HealthSubscriber::new("visod listen", settings).map_err(Failure::other)?;
            Ok(Self::View(Box::new(View::new(health))))
        }

        fn take(
            &mut self,
            received: &Received<OdometryMessage>,
            is_last: bool,
        ) -> Result<Next, Failure> {
            match self {
                Self::Lines(lines) => lines.print(received),
                Self::View(view) => {
                    view.take(received);
                    if is_last {
                        view.draw(Duration::ZERO)
                    } else {
                        Ok(Next::Continue)
                    }
                }
            }
        }

        /// Draws what has changed, if it is time to.
        fn pass_time(&mut self, silence: &Silence) -> Result<Next, Failure> {
            match self {
                Self::View(view) if view.screen.is_due() => view.draw(silence.since.elapsed()),
                _ => Ok(Next::Continue),
            }
        }

        /// Says what is wrong, once as long as it is the same: a publisher of another version would have it said
        /// for every message. `last` is what was said before.
        fn complain(&mut self, cause: &str, last: &mut String) {
            if last == cause {
                return;
            }
            cause.clone_into(last);
            eprintln!("visod: {cause}");
            if let Self::View(view) = self {
                view.screen.move_on();
            }
        }
    }

    /// The rate at which messages come.
    struct Arrivals(VecDeque<Instant>);

    impl Arrivals {
        fn new() -> Self {
            Self(VecDeque::with_capacity(RATE_WINDOW + 1))
        }

        fn note(&mut self, new_publisher: bool) {
            if new_publisher {
                self.0.clear();
            }
            self.0.push_back(Instant::now());
            if self.0.len() > RATE_WINDOW + 1 {
                self.0.pop_front();
            }
        }

        fn rate_hz(&self) -> Option<f64> {
            let (first, last) = (self.0.front()?, self.0.back()?);
            let span_s = (*last - *first).as_secs_f64();
            (span_s > 0.0).then(|| (self.0.len() - 1) as f64 / span_s)
        }
    }

    /// A picture of the last message.
    struct View {
        screen: Screen,
        arrivals: Arrivals,
        lost: u64,
        last: Option<(OdometryMessage, i64)>,
        health: HealthSubscriber,
        last_health: Option<HealthMessage>,
    }

    impl View {
        fn new(health: HealthSubscriber) -> Self {
            Self {
                screen: Screen::new(),
                arrivals: Arrivals::new(),
                lost: 0,
                last: None,
                health,
                last_health: None,
            }
        }

        fn take(&mut self, received: &Received<OdometryMessage>) {
            let message = received.message;
            let transport_ns = crate::output::monotonic_ns() - message.published_monotonic_ns;
            self.arrivals.note(received.new_publisher);
            self.lost += received.lost_before;
            self.last = Some((message, transport_ns));
        }

        fn draw(&mut self, silence: Duration) -> Result<Next, Failure> {
            // Health that cannot be used is not shown; the next one comes within a second.
            while let Ok(Some(health)) = self.health.receive() {
                self.last_health = Some(health.message);
            }
            let Some((message, transport_ns)) = &self.last else {
                return Ok(Next::Continue);
            };
            let scene = Scene {
                message,
                rate_hz: self.arrivals.rate_hz(),
                lost: self.lost,
                silence,
                transport_ns: *transport_ns,
                health: self.last_health.as_ref(),
            };
            written(self.screen.draw(&scene))
        }
    }

    /// A line a message.
    struct Lines<'a> {
        args: &'a Args,
        line: String,
        arrivals: Arrivals,
    }

    impl<'a> Lines<'a> {
        fn new(args: &'a Args) -> Self {
            Self {
                args,
                line: String::with_capacity(4096),
                arrivals: Arrivals::new(),
            }
        }

        fn print(&mut self, received: &Received<OdometryMessage>) -> Result<Next, Failure> {
            if received.lost_before > 0 {
                eprintln!(
                    "visod: {} messages lost before seq {}, since they came faster than they were read",
                    received.lost_before, received.message.sequence
                );
            }
            self.arrivals.note(received.new_publisher);
            let mut line = std::mem::take(&mut self.line);
            line.clear();
            self.format(&mut line, &received.message);
            let next = print_line(&line)?;
            self.line = line;
            Ok(next)
        }

        fn format(&self, line: &mut String, message: &OdometryMessage) {
            let now_ns = crate::output::monotonic_ns();
            if self.args.json {
                json::push_message(line, message, now_ns);
            } else if let Some(row) = OdometryRow::from_message(message) {
                if self.args.csv {
                    csv::push_row(line, &row);
                } else {
                    describe(line, message, &row, self.arrivals.rate_hz(), now_ns);
                }
            }
        }
    }

    /// Writes a line at once.
    fn print_line(line: &str) -> Result<Next, Failure> {
        let mut out = io::stdout().lock();
        written(
            out.write_all(line.as_bytes())
                .and_then(|()| out.write_all(b"\n"))
                .and_then(|()| out.flush()),
        )
    }

    /// A reader that has gone is no failure.
    fn written(result: io::Result<()>) -> Result<Next, Failure> {
        match result {
            Ok(()) => Ok(Next::Continue),
            Err(e) if e.kind() == ErrorKind::BrokenPipe => Ok(Next::End),
            Err(e) => Err(Failure::other(format!("cannot write the output: {e}"))),
        }
    }

    /// One estimate for the eye: position and rotation vector ± 1 σ, rate, latency.
    fn describe(
        line: &mut String,
        message: &OdometryMessage,
        row: &OdometryRow,
        rate_hz: Option<f64>,
        now_ns: i64,
    ) {
        let t = row.odom_from_camera.translation.vector;
        let r = row.odom_from_camera.rotation.scaled_axis();
        let sigma = |i: usize| row.cov_pose[(i, i)].max(0.0).sqrt();
        let frame = match message.frame() {
            Some(PoseFrame::Base) => "base",
            _ => "camera",
        };
        // Writing to a `String` cannot fail.
        let _ = write!(
            line,
            "{:>6} {:<12} {frame}",
            row.sequence,
            row.status.as_str()
        );
        for (i, axis) in ["x", "y", "z"].into_iter().enumerate() {
            let _ = write!(line, "  {axis} {:+.3} ±{:.3}", t[i], sigma(i));
        }
        line.push_str(" m ");
        for (i, axis) in ["rx", "ry", "rz"].into_iter().enumerate() {
            let (degrees, sigma) = (r[i].to_degrees(), sigma(i + 3).to_degrees());
            let _ = write!(line, " {axis} {degrees:+.2} ±{sigma:.2}");
        }
        line.push('°');
        if let Some(rate) = rate_hz {
            let _ = write!(line, "  {rate:.1} Hz");
        }
        let (what, since_ns) = if message.monotonic_ns > 0 {
            ("latency", message.monotonic_ns)
        } else {
            // A recording's capture time says nothing of today: only the way through shared memory.
            ("transport", message.published_monotonic_ns)
        };
        let _ = write!(line, "  {what} {:.2} ms", (now_ns - since_ns) as f64 / 1e6);
    }
}
