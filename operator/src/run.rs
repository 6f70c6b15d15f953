//! `operator run`: streams a hand to the robot.

use std::io::IsTerminal as _;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::Context as _;
use teleop_common::authority::OperatorName;
use teleop_common::hand::HandSide;
use teleop_common::key::Keys;
use teleop_common::master::{Calibration, MasterGeometry};
use teleop_common::net::clock::{now, random_epoch};
use teleop_common::net::keyboard::Keyboard;
use teleop_common::net::{NetError, Session, Subscriber};
use teleop_common::recording::RecordingHeader;
use teleop_common::viz::{Level, Scene, Viz};
use teleop_common::wire::latency_report;

use crate::calibrate;
use crate::cli::{RunArgs, Switch};
use crate::failure::{Failure, OrFail as _, listening_session, not_open};
use crate::feedback::Feedback;
use crate::hand::PoseFinder;
use crate::pilot::{ClutchBy, Pilot};
use crate::pipeline::{Parts, Pipeline, Progress, picture_time};
use crate::record::Recorder;
use crate::request::{Requester, Requests, Wish};
use crate::robot_hand::RobotHand;
use crate::robot_link::RobotLink;
use crate::shutdown::Shutdown;
use crate::source::{GestureSource, RecordingFile, Source, SourceSpec, ZenohSource};
use crate::stream::PoseStream;
use crate::terminal::{RateMeter, Status, Terminal, status_line};

/// Refresh of the status line.
const REFRESH: Duration = Duration::from_millis(200);
/// Time the viewer gets to take what is queued.
const VIEWER_TIMEOUT: Duration = Duration::from_millis(500);

/// Time the robot gets to describe itself.
const DESCRIBE_TIMEOUT: Duration = Duration::from_millis(300);

/// How a run went.
#[derive(Clone, Debug)]
pub struct Summary {
    /// Poses handed to the network.
    pub sent: u64,
    /// The source thread's own account.
    pub progress: Progress,
    /// Median and 99th percentile of the round trip, `None` if the robot never answered.
    pub round_trip: Option<(Duration, Duration)>,
    /// Frames written to the recording and frames lost, if there is a recording.
    pub recorded: Option<(u64, u64)>,
    /// Where the time went from the human hand to the robot hand, as the robot tells it.
    pub latency: Option<String>,
}

impl std::fmt::Display for Summary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { sent, progress, round_trip, recorded, latency } = self;
        let seconds = progress.span.map_or(0.0, |(first, last)| last.since(first).as_secs_f64());
        write!(f, "streamed {sent} poses in {seconds:.1} s")?;
        if progress.poses > 1 && seconds > 0.0 {
            write!(f, " ({:.1} Hz)", (progress.poses - 1) as f64 / seconds)?;
        }
        match round_trip {
            Some((p50, p99)) => {
                write!(f, ", round trip {:.1} ms p50, {:.1} ms p99", 1e3 * p50.as_secs_f64(), 1e3 * p99.as_secs_f64())?;
            }
            None => write!(f, ", no echo from the robot")?,
        }
        write!(f, ", {} skipped", progress.skipped)?;
        if progress.bad > 0 {
            write!(f, ", {} bad inputs", progress.bad)?;
        }
        if let Some((written, lost)) = recorded {
            write!(f, ", recorded {written} frames")?;
            if *lost > 0 {
                write!(f, " ({lost} LOST)")?;
            }
        }
        if let Some(latency) = latency {
            write!(f, "\n{latency}")?;
        }
        Ok(())
    }
}

/// What is to be streamed, checked before anything is opened.
struct Plan {
    input: Input,
    finder: PoseFinder,
    side: Option<HandSide>,
}

enum Input {
    Ready(Source),
    Zenoh,
}

impl Plan {
    fn new(args: &RunArgs) -> Result<Self, Failure> {
        let spec = args.source.parse::<SourceSpec>().or_usage()?;
        let hand = args.robot_hand;
        let calibration = args.calibration.as_deref().map(calibrate::load).transpose().or_usage()?;
        match spec {
            SourceSpec::Gesture(gesture) => {
                let source = Source::Gesture(GestureSource::new(gesture, args.rate));
                Ok(Self::with(Input::Ready(source), calibration, None, hand))
            }
            SourceSpec::Zenoh => Ok(Self::with(Input::Zenoh, calibration, None, hand)),
            SourceSpec::File(path) => {
                let recording = RecordingFile::scan(&path).or_usage()?;
                let calibration = recording_hand(&recording, calibration)?;
                let header = recording.header.clone();
                let source = recording.play(args.speed, args.repeat).or_runtime()?;
                let input = Input::Ready(Source::File(Box::new(source)));
                let mut plan = Self::with(input, calibration, Some(&header), hand);
                plan.side = plan.side.or(header.side);
                Ok(plan)
            }
        }
    }

    fn with(input: Input, calibration: Option<Calibration>, header: Option<&RecordingHeader>, hand: RobotHand) -> Self {
        let Some(mut calibration) = calibration else {
            let geometry = header.and_then(|header| header.geometry).unwrap_or(MasterGeometry::PARADIGMATIC);
            let tuning = header.and_then(|header| header.tuning);
            return Self { input, finder: PoseFinder::new(geometry).with_tuning(tuning, hand), side: None };
        };
        hand.tune_and_log(&mut calibration);
        Self { input, finder: PoseFinder::calibrated(&calibration), side: Some(calibration.side) }
    }

    const fn is_live(&self) -> bool {
        matches!(self.input, Input::Zenoh)
    }

    const fn is_recording(&self) -> bool {
        matches!(self.input, Input::Ready(Source::File(_)))
    }
}

/// Checks a recording, and measures its hand if that was not done before.
fn recording_hand(recording: &RecordingFile, known: Option<Calibration>) -> Result<Option<Calibration>, Failure> {
    if recording.cut {
        tracing::warn!("the last line of {} is cut off and left out", recording.name());
    }
    if !recording.keypoints {
        return Ok(known);
    }
    let calibration = match known {
        Some(calibration) => calibration,
        None => {
            let found = recording
                .calibrator
                .finish()
                .with_context(|| format!("cannot measure the hand in {}; give --calibration FILE", recording.name()))
                .or_runtime()?;
            let report: Vec<String> = found.report().into_iter().take(2).collect();
            tracing::info!("measured in {}: {}", recording.name(), report.join(", "));
            found
        }
    };
    let expected = recording.header.side.unwrap_or(calibration.side);
    let inspector = recording.calibrator.inspector();
    if let Some(diagnosis) = inspector.diagnose(expected, false) {
        return Err(diagnosis).with_context(|| format!("cannot follow the hand in {}", recording.name())).or_runtime();
    }
    if let Some(diagnosis) = inspector.diagnose(expected, recording.claims_palm_frame()) {
        // The fit finds the palm by itself, so this does no harm here; elsewhere it would.
        tracing::error!("{}: {diagnosis}", recording.name());
    }
    Ok(Some(calibration))
}

/// Streams until the source ends, the time is over or the process is asked to end.
///
/// # Errors
/// [`Failure`]
pub fn run(args: &RunArgs, shutdown: &Shutdown, terminal: &Terminal) -> Result<Summary, Failure> {
    let start = Instant::now();
    let end = args.duration.map(|seconds| start + Duration::from_secs_f64(seconds));
    let keys = Keys::new(&args.robot.name).or_usage()?;
    let plan = Plan::new(args)?;
    let (is_recording, side) = (plan.is_recording(), plan.side);
    let pilot = Pilot::new(args.clutch.unwrap_or_else(default_clutch), operator_name(args)?, args.takeover);
    let inputs = plan.is_live() || args.clutch == Some(ClutchBy::Input);
    // Of its own, because that with the robot may be opened anew.
    let local = inputs.then(|| listening_session(&args.listen)).transpose()?;
    let (recorder, record) = match &args.record {
        Some(path) => Recorder::create(path, &args.source, side).map(|(a, b)| (Some(a), Some(b))).or_usage()?,
        None => (None, None),
    };

    let epoch = random_epoch();
    let feedback = Arc::new(Feedback::new(epoch));
    let link = RobotLink::open(args.robot.session(), &keys, Some(epoch), &feedback).map_err(not_open)?;
    let side = side.or_else(|| robot_side(&link, &keys)).unwrap_or(HandSide::Right);
    let scene = Scene::operator(keys.name(), side);
    let viz = Viz::start(args.viewer.clone(), scene).or_runtime()?;
    let logger = viz.logger();
    let requests = Requests::start(Requester::new(link.sender(), epoch, &feedback)).or_runtime()?;
    let keyboard = listen_to_keys(&pilot, &requests, shutdown);
    let clutch_input = local.as_ref().map(|local| listen_to_clutch(local, &keys, &pilot)).transpose().or_runtime()?;
    let (stream, sender) =
        PoseStream::start(link.sender(), epoch, Arc::clone(&feedback), pilot.clone()).or_runtime()?;
    let pipeline = Pipeline::start(Parts {
        source: open(plan.input, local.as_ref(), &keys)?,
        finder: plan.finder.filtered(args.filter == Switch::On),
        sender,
        recorder: record,
        logger: logger.clone(),
        feedback: Arc::clone(&feedback),
        // The beginning of a recording should not be lost.
        wait_for_robot: is_recording,
        shutdown: shutdown.clone(),
    })
    .or_runtime()?;

    let mut display = terminal.display(is_recording);
    let mut meter = RateMeter::default();
    let mut foreign = None;
    while !pipeline.is_finished() {
        let status = Status {
            name: keys.name().to_owned(),
            endpoints: args.robot.connect.join(", "),
            robot: feedback.snapshot(now()),
            rate: meter.rate(stream.counters().sent.load(Ordering::Relaxed), Instant::now()),
            progress: pipeline.progress(),
            lost: recorder.as_ref().map_or(0, Recorder::lost),
        };
        if display.show(&status) {
            let level = if status.robot.reason.is_some() { Level::Warn } else { Level::Info };
            let time = picture_time(now(), status.robot.picture_offset_ns);
            logger.log_text(time, level, &status_line(&status));
        }
        foreign = status.robot.foreign;
        if foreign.is_some() {
            break;
        }
        let wait = end.map_or(REFRESH, |end| end.saturating_duration_since(Instant::now()).min(REFRESH));
        if shutdown.wait(wait) || end.is_some_and(|end| Instant::now() >= end) {
            break;
        }
    }
    shutdown.request();
    drop((display, keyboard, clutch_input, requests));

    // In the order of the data: source, network and recording, picture.
    let (progress, result) = pipeline.join();
    let sent = stream.counters().sent.load(Ordering::Relaxed);
    drop((stream, link));
    let recorded = recorder.map(Recorder::finish);
    if !viz.shutdown(VIEWER_TIMEOUT) {
        tracing::warn!("the viewer did not take everything in time");
    }
    if let Some(local) = local {
        local.close().or_runtime()?;
    }
    result.or_runtime()?;
    if let Some(error) = foreign {
        let at = args.robot.connect.join(", ");
        return Err(anyhow::anyhow!("robot {} at {at} cannot be understood: {error}", keys.name())).or_runtime();
    }
    if progress.ended && !progress.confirmed {
        tracing::warn!("the robot did not confirm the last pose");
    }
    let trips = feedback.round_trips();
    let round_trip = (trips.count() > 0).then(|| (trips.p50(), trips.p99()));
    let health = feedback.snapshot(now()).health.filter(|health| health.total_ms.max > 0.0);
    let latency = health.map(|health| latency_report(&health.stages, &health.total_ms));
    Ok(Summary { sent, progress, round_trip, recorded, latency })
}

/// Somebody at a terminal moves the clutch; where nobody is, starting the program is the deliberate act.
fn default_clutch() -> ClutchBy {
    if std::io::stdin().is_terminal() { ClutchBy::Key } else { ClutchBy::Start }
}

fn operator_name(args: &RunArgs) -> Result<OperatorName, Failure> {
    if let Some(name) = &args.operator {
        return OperatorName::new(name).or_usage();
    }
    let user = std::env::var("USER").unwrap_or_else(|_| "operator".to_owned());
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    Ok(OperatorName::lossy(&format!("{user}@{}", host.trim())))
}

/// SPACE moves the clutch, s stops, r resets, q quits; without a terminal SIGUSR1 does what SPACE does.
fn listen_to_keys(pilot: &Pilot, requests: &Requests, shutdown: &Shutdown) -> Option<Keyboard> {
    let nudged = pilot.clone();
    shutdown.on_nudge(move || nudged.on_space(now()));
    let (pilot, wish, shutdown) = (pilot.clone(), requests.wisher(), shutdown.clone());
    Keyboard::listen(move |key| match key {
        b' ' => pilot.on_space(now()),
        b's' => wish(Wish::Stop),
        b'r' => wish(Wish::Reset),
        b'q' => shutdown.request(),
        _ => {}
    })
}

fn listen_to_clutch(session: &Session, keys: &Keys, pilot: &Pilot) -> Result<Subscriber, NetError> {
    let (pilot, mut told) = (pilot.clone(), false);
    session.subscribe(&keys.clutch_input(), move |arrival| {
        let bytes = arrival.payload.unwrap_or(b"");
        if let Err(error) = pilot.on_input(bytes, arrival.at)
            && !std::mem::replace(&mut told, true)
        {
            tracing::error!("clutch input refused: {error}; it is {{\"closed\": true}} (more of them are not told)");
        }
    })
}

/// The side of the robot's hand, if it is there to say: a hand that belongs to neither side is drawn as that one.
fn robot_side(link: &RobotLink, keys: &Keys) -> Option<HandSide> {
    let description = link.get(&keys.describe(), DESCRIBE_TIMEOUT).ok()?;
    let description: serde_json::Value = serde_json::from_slice(&description).ok()?;
    let side = description.get("hand")?.as_str()?;
    [HandSide::Right, HandSide::Left].into_iter().find(|known| known.name() == side)
}

fn open(input: Input, local: Option<&Session>, keys: &Keys) -> Result<Source, Failure> {
    match (input, local) {
        (Input::Ready(source), _) => Ok(source),
        (Input::Zenoh, None) => Err(Failure::Usage(anyhow::anyhow!("--source zenoh needs an endpoint to --listen on"))),
        (Input::Zenoh, Some(session)) => {
            tracing::info!("hand data may come on {} at {}", keys.hand_input(), session.locators().join(", "));
            ZenohSource::subscribe(session, keys).map(Source::Zenoh).or_runtime()
        }
    }
}
