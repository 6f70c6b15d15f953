//! Wiring: from the command line to running threads, and their end in order.

use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context as _, anyhow};
use teleop_common::hand::HandSide;
use teleop_common::key::Keys;
use teleop_common::master::{Gesture, MasterGeometry};
use teleop_common::net::clock::{now, random_epoch};
use teleop_common::net::{NetError, Session, SessionConfig, Stream};
use teleop_common::viz::{Scene, Viz};

use crate::cli::{Cli, Command, LogArgs, RunArgs, WatchArgs};
use crate::feedback::{Feedback, subscribe};
use crate::hand::PoseFinder;
use crate::pipeline::{Parts, Pipeline};
use crate::shutdown::Shutdown;
use crate::source::{GestureSource, Source, SourceError};
use crate::stream::PoseStream;
use crate::terminal::{RateMeter, Status, Terminal, say};
use crate::watch::{WatchOptions, watch};

/// Default log filter: the libraries speak up when something is wrong.
const LOG_FILTER: &str = "info,zenoh=warn,re_=warn,rerun=warn";
/// Refresh of the status line.
const REFRESH: Duration = Duration::from_millis(200);
/// Time the viewer gets to take what is queued.
const VIEWER_TIMEOUT: Duration = Duration::from_millis(500);

/// Why the program ends other than well.
#[derive(Debug)]
pub enum Failure {
    /// It was asked for something that cannot be.
    Usage(anyhow::Error),
    /// It failed while running.
    Runtime(anyhow::Error),
}

impl Failure {
    /// 2 for wrong usage or configuration, 1 for the rest.
    #[must_use]
    pub fn exit_code(&self) -> ExitCode {
        ExitCode::from(match self {
            Self::Usage(_) => 2,
            Self::Runtime(_) => 1,
        })
    }
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (Self::Usage(error) | Self::Runtime(error)) = self;
        error.fmt(f)
    }
}

trait OrFail<T> {
    /// The failure is in what the user asked for.
    fn or_usage(self) -> Result<T, Failure>;
    /// The failure came while running.
    fn or_runtime(self) -> Result<T, Failure>;
}

impl<T, E: Into<anyhow::Error>> OrFail<T> for Result<T, E> {
    fn or_usage(self) -> Result<T, Failure> {
        self.map_err(|error| Failure::Usage(error.into()))
    }

    fn or_runtime(self) -> Result<T, Failure> {
        self.map_err(|error| Failure::Runtime(error.into()))
    }
}

/// Runs the program.
///
/// # Errors
/// [`Failure`], with the whole chain of causes.
pub fn main(cli: Cli) -> Result<(), Failure> {
    let terminal = Terminal::new();
    let shutdown = Shutdown::default();
    let command = cli.command.unwrap_or(Command::Run(cli.run));
    let log = match &command {
        Command::Run(args) => Some(&args.log),
        Command::Calibrate(args) => Some(&args.log),
        Command::Watch(args) => Some(&args.log),
        Command::Gestures => None,
    };
    if let Some(log) = log {
        init_log(log, &terminal)?;
    }
    // Zenoh and Rerun bring their own threads; this runtime waits for signals only.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .context("cannot start the signal handler")
        .or_runtime()?;
    watch_signals(&runtime, &shutdown).context("cannot watch for signals").or_runtime()?;
    let result = match command {
        Command::Run(args) => run(&args, &shutdown, &terminal).map(|summary| say(&summary.to_string())),
        Command::Calibrate(_) => Err(Failure::Usage(anyhow!("calibrate is not available yet"))),
        Command::Watch(args) => watch_robot(&args, &shutdown),
        Command::Gestures => {
            gestures();
            Ok(())
        }
    };
    runtime.shutdown_background();
    result
}

fn init_log(args: &LogArgs, terminal: &Terminal) -> Result<(), Failure> {
    use tracing_subscriber::EnvFilter;
    let text = args.log.clone().or_else(|| std::env::var("RUST_LOG").ok()).unwrap_or_else(|| LOG_FILTER.to_owned());
    let filter = EnvFilter::try_new(&text)
        .with_context(|| format!("log filter {text:?} is not one; write for example debug or info,zenoh=debug"))
        .or_usage()?;
    let terminal = terminal.clone();
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_ansi(terminal.interactive())
        .with_writer(move || terminal.log_writer())
        .try_init()
        .map_err(|error| Failure::Runtime(anyhow!("cannot start logging: {error}")))
}

/// The first signal ends the process in order, the second at once.
fn watch_signals(runtime: &tokio::runtime::Runtime, shutdown: &Shutdown) -> std::io::Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let _context = runtime.enter();
    let (mut interrupt, mut terminate) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    let shutdown = shutdown.clone();
    runtime.spawn(async move {
        loop {
            tokio::select! {
                _ = interrupt.recv() => {}
                _ = terminate.recv() => {}
            }
            if shutdown.requested() {
                std::process::exit(1);
            }
            shutdown.request();
        }
    });
    Ok(())
}

fn gestures() {
    for gesture in Gesture::ALL {
        say(&format!("{gesture:<18} {:>6.1} s  {}", gesture.duration(), gesture.description()));
    }
}

/// Opens a session; a bad endpoint is wrong usage, a taken port is not.
pub(crate) fn open_session(connect: &[String], listen: &[String]) -> Result<Session, Failure> {
    let config = SessionConfig { connect: connect.to_vec(), listen: listen.to_vec(), ..SessionConfig::default() };
    Session::open(&config).map_err(|error| match error {
        NetError::Endpoint { .. } | NetError::Setting { .. } | NetError::ConfigFile { .. } => {
            Failure::Usage(error.into())
        }
        error => Failure::Runtime(error.into()),
    })
}

fn watch_robot(args: &WatchArgs, shutdown: &Shutdown) -> Result<(), Failure> {
    let keys = Keys::new(&args.robot.name).or_usage()?;
    let session = open_session(&args.robot.connect, &[])?;
    let feedback = Arc::new(Feedback::new(random_epoch()));
    let _subscribers = subscribe(&session, &keys, &feedback).or_runtime()?;
    let options = WatchOptions {
        json: args.json,
        duration: args.duration.map(Duration::from_secs_f64),
        timeout: Duration::from_secs_f64(args.timeout),
        name: args.robot.name.clone(),
        endpoints: args.robot.connect.join(", "),
    };
    watch(&feedback, &options, shutdown).or_runtime()
}

/// How a run went.
#[derive(Clone, Copy, Debug)]
pub struct Summary {
    /// Poses handed to the network.
    pub sent: u64,
    /// Time from the first to the last of them.
    pub streamed: Duration,
    /// Median and 99th percentile of the round trip, `None` if the robot never answered.
    pub round_trip: Option<(Duration, Duration)>,
    /// Poses that came too late to be sent.
    pub skipped: u64,
    /// Messages of a live source that were no hand.
    pub bad_input: u64,
    /// Frames written to the recording, if there is one, and frames lost.
    pub recorded: Option<(u64, u64)>,
    /// Whether the robot confirmed the last pose.
    pub confirmed: bool,
}

impl std::fmt::Display for Summary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let seconds = self.streamed.as_secs_f64();
        write!(f, "streamed {} poses in {seconds:.1} s", self.sent)?;
        if self.sent > 1 && seconds > 0.0 {
            write!(f, " ({:.1} Hz)", (self.sent - 1) as f64 / seconds)?;
        }
        match self.round_trip {
            Some((p50, p99)) => {
                write!(f, ", round trip {:.1} ms p50, {:.1} ms p99", 1e3 * p50.as_secs_f64(), 1e3 * p99.as_secs_f64())?;
            }
            None => write!(f, ", no answer from the robot")?,
        }
        write!(f, ", {} skipped", self.skipped)?;
        if self.bad_input > 0 {
            write!(f, ", {} bad inputs", self.bad_input)?;
        }
        if let Some((written, lost)) = self.recorded {
            write!(f, ", recorded {written} frames")?;
            if lost > 0 {
                write!(f, " ({lost} LOST)")?;
            }
        }
        Ok(())
    }
}

/// Streams until the source ends, the time is over or the process is asked to end.
///
/// # Errors
/// [`Failure`]
pub fn run(args: &RunArgs, shutdown: &Shutdown, terminal: &Terminal) -> Result<Summary, Failure> {
    let start = Instant::now();
    let end = args.duration.map(|seconds| start + Duration::from_secs_f64(seconds));
    let keys = Keys::new(&args.robot.name).or_usage()?;
    let gesture: Gesture = args.source.parse().map_err(SourceError::Unknown).or_usage()?;
    let source = Source::Gesture(GestureSource::new(gesture, args.rate));

    let epoch = random_epoch();
    let feedback = Arc::new(Feedback::new(epoch));
    let session = open_session(&args.robot.connect, &[])?;
    let subscribers = subscribe(&session, &keys, &feedback).or_runtime()?;
    let publisher = session.publisher(&keys.pose(), Stream::Command).or_runtime()?;
    let token = session.live_token(&keys.live_operator(epoch)).or_runtime()?;
    let viz = Viz::start(args.viewer.clone(), Scene::operator(keys.name(), HandSide::Right)).or_runtime()?;
    let (stream, sender) = PoseStream::start(publisher, epoch, Arc::clone(&feedback)).or_runtime()?;
    let pipeline = Pipeline::start(Parts {
        source,
        finder: PoseFinder::angles(MasterGeometry::PARADIGMATIC),
        sender,
        logger: viz.logger(),
        feedback: Arc::clone(&feedback),
        wait_for_robot: false,
        shutdown: shutdown.clone(),
    })
    .or_runtime()?;

    let mut display = terminal.display(false);
    let mut meter = RateMeter::default();
    while !pipeline.is_finished() {
        let progress = pipeline.progress();
        display.show(&Status {
            name: keys.name().to_owned(),
            endpoints: args.robot.connect.join(", "),
            robot: feedback.snapshot(now()),
            activity: progress.activity,
            rate: meter.rate(stream.counters().sent.load(Ordering::Relaxed), Instant::now()),
            progress: progress.fraction,
            residual: progress.residual,
            skipped: progress.skipped,
            bad_input: progress.bad,
            lost: 0,
        });
        let wait = end.map_or(REFRESH, |end| end.saturating_duration_since(Instant::now()).min(REFRESH));
        if shutdown.wait(wait) || end.is_some_and(|end| Instant::now() >= end) {
            break;
        }
    }
    shutdown.request();
    drop(display);
    let (progress, result) = pipeline.join();
    let sent = stream.counters().sent.load(Ordering::Relaxed);
    drop(stream);
    drop((token, subscribers));
    let round_trips = feedback.round_trips();
    if !viz.shutdown(VIEWER_TIMEOUT) {
        tracing::warn!("the viewer did not take everything in time");
    }
    session.close().or_runtime()?;
    result.or_runtime()?;
    Ok(Summary {
        sent,
        streamed: progress.span.map_or(Duration::ZERO, |(first, last)| last.since(first)),
        round_trip: (round_trips.count() > 0).then(|| (round_trips.p50(), round_trips.p99())),
        skipped: progress.skipped,
        bad_input: progress.bad,
        recorded: None,
        confirmed: progress.confirmed,
    })
}
