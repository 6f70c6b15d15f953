//! The operator against a peer that plays the robot's side of the network, over real zenoh on localhost.
#![allow(clippy::unwrap_used, reason = "test helpers")]

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use clap::Parser as _;
use teleop_common::key::Keys;
use teleop_common::master::{Gesture, MasterGeometry};
use teleop_common::mode::Mode;
use teleop_common::net::clock::{now, random_epoch, wall_offset_ns};
use teleop_common::net::{Session, SessionConfig, Stream};
use teleop_common::recording::{FrameData, LastLine, RecordingReader};
use teleop_common::testing::shared_data;
use teleop_common::time::MonoTime;
use teleop_common::wire::{
    Checked, Echo, JointStateMessage, MAGIC, Message as _, PROTOCOL, PoseMessage, Stamper, pack_joints,
};
use teleop_operator::cli::{Cli, RunArgs};
use teleop_operator::feedback::Feedback;
use teleop_operator::robot_link::RobotLink;
use teleop_operator::run::{Summary, run};
use teleop_operator::shutdown::Shutdown;
use teleop_operator::terminal::Terminal;
use teleop_operator::watch::{WatchOptions, watch};

const STATE_EVERY: Duration = Duration::from_millis(5);

/// A pose and when it came.
type Heard = (Checked<PoseMessage>, MonoTime);

/// Plays the robot: takes poses, answers with joint states that echo the newest of them.
struct Peer {
    endpoint: String,
    session: Session,
    poses: Arc<Mutex<Vec<Heard>>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
    name: String,
}

impl Peer {
    fn start(name: &str) -> Self {
        Self::start_at(name, "tcp/127.0.0.1:0")
    }

    fn start_at(name: &str, endpoint: &str) -> Self {
        let session = Session::open(&SessionConfig::listening([endpoint])).unwrap();
        let endpoint = session.locators().into_iter().find(|locator| locator.starts_with("tcp/127")).unwrap();
        let keys = Keys::new(name).unwrap();
        let (poses, stop) = (Arc::new(Mutex::new(Vec::<Heard>::new())), Arc::new(AtomicBool::new(false)));
        let (heard, ended, own) = (Arc::clone(&poses), Arc::clone(&stop), session.clone());
        let thread = std::thread::spawn(move || {
            let inbox = Arc::clone(&heard);
            let _subscriber = own
                .subscribe(&keys.pose(), move |arrival| {
                    let pose = arrival.decode::<PoseMessage>().unwrap();
                    inbox.lock().unwrap().push((pose, arrival.at));
                })
                .unwrap();
            let publisher = own.publisher(&keys.joints(), Stream::State).unwrap();
            let mut stamper = Stamper::new(random_epoch());
            let mut tick = 0;
            while !ended.load(Ordering::Relaxed) {
                tick += 1;
                let newest = heard.lock().unwrap().last().copied();
                let joints = JointStateMessage {
                    echo: newest.map_or(Echo::NONE, |(pose, at)| Echo::of(&pose.header, at)),
                    mode: if newest.is_some() { Mode::Engaged } else { Mode::Disarmed }.to_wire(),
                    joints: 16,
                    tick,
                    wall_offset_ns: wall_offset_ns(),
                    pose_epoch: newest.map_or(0, |(pose, _)| pose.header.epoch),
                    pose_seq: newest.map_or(0, |(pose, _)| pose.header.seq),
                    pose_captured: newest.map_or(MonoTime(0), |(pose, _)| pose.captured),
                    q: pack_joints(&[0.1; 16]),
                    dq: pack_joints(&[0.0; 16]),
                    tau: pack_joints(&[0.0; 16]),
                    q_command: pack_joints(&[0.1; 16]),
                    stop: 0,
                    holder: newest.map_or(0, |(pose, _)| pose.header.epoch),
                    header: stamper.header::<JointStateMessage>(now()),
                };
                publisher.send(&joints).unwrap();
                std::thread::sleep(STATE_EVERY);
            }
        });
        Self { endpoint, session, poses, stop, thread: Some(thread), name: name.to_owned() }
    }

    fn poses(&self) -> Vec<Heard> {
        self.poses.lock().unwrap().clone()
    }

    /// Waits until `enough` poses have come.
    fn wait_for(&self, enough: usize) {
        wait_until(|| self.poses.lock().unwrap().len() >= enough);
    }

    /// Liveliness tokens of operators.
    fn operators(&self) -> usize {
        let keys = Keys::new(&self.name).unwrap();
        self.session.live_now(&keys.live_operators(), Duration::from_secs(2)).unwrap().len()
    }

    fn run_args(&self, more: &str) -> RunArgs {
        args(&format!("--name {} --connect {} {more}", self.name, self.endpoint))
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.join().unwrap();
        }
        self.session.close().unwrap();
    }
}

fn args(line: &str) -> RunArgs {
    Cli::try_parse_from(format!("operator --viewer off {line}").split_whitespace()).unwrap().run
}

fn wait_until(mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < Duration::from_secs(30), "waited in vain");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A file name of its own in the build's temporary folder.
fn temporary(name: &str) -> PathBuf {
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let unique = format!("{}-{}-{name}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed));
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(unique)
}

fn stream(args: &RunArgs) -> Summary {
    run(args, &Shutdown::default(), &Terminal::new()).unwrap()
}

/// Runs the operator on another thread until `during` returns.
fn stream_during(args: &RunArgs, during: impl FnOnce()) -> (Summary, Duration) {
    let shutdown = Shutdown::default();
    let (own, args) = (shutdown.clone(), args.clone());
    let operator = std::thread::spawn(move || run(&args, &own, &Terminal::new()).unwrap());
    during();
    let asked = Instant::now();
    shutdown.request();
    let summary = operator.join().unwrap();
    (summary, asked.elapsed())
}

#[test]
fn poses_arrive_at_their_rate_and_echoes_come_back() {
    let peer = Peer::start("rates");
    let summary = stream(&peer.run_args("--source tripod --rate 200 --duration 3"));
    let poses = peer.poses();
    let (first, last) = (poses.first().unwrap(), poses.last().unwrap());
    // By the stamps of capture, which say what the operator did, whatever this machine was busy with besides.
    let seconds = last.0.captured.since(first.0.captured).as_secs_f64();
    let sent = last.0.header.seq - first.0.header.seq;
    assert!((sent as f64 / seconds - 200.0).abs() < 10.0, "{sent} poses in {seconds} s");
    assert!(poses.len() as f64 > 0.95 * sent as f64, "{} of {sent} arrived", poses.len());
    for pair in poses.windows(2) {
        let [before, after] = [&pair[0].0, &pair[1].0];
        assert!(after.header.seq > before.header.seq && after.captured > before.captured);
        assert_eq!(after.header.epoch, before.header.epoch);
    }
    for (pose, at) in &poses {
        assert!(pose.captured <= pose.header.sent && pose.header.sent <= *at, "one clock, one order");
    }
    // The poses are those of the gesture.
    let start = first.0.captured;
    let (q, t) = (last.0.pose().q, last.0.captured.since(start).as_secs_f64());
    let nearest = (-40..40)
        .map(|i| Gesture::Tripod.sample(t + f64::from(i) * 0.01))
        .map(|expected| q.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max))
        .fold(f64::MAX, f64::min);
    assert!(nearest < 0.05, "{nearest} rad from the gesture");
    // Echoes both ways.
    let echoed = poses.iter().filter(|(pose, _)| pose.echo != Echo::NONE).count();
    assert!(echoed * 10 > poses.len() * 8, "{echoed} of {} carry an echo", poses.len());
    let (p50, p99) = summary.round_trip.unwrap();
    assert!(p50 <= p99 && p50 < Duration::from_millis(50), "round trip {p50:?} {p99:?}");
}

#[test]
fn the_end_is_quick_and_takes_the_token_along() {
    let peer = Peer::start("ending");
    let (summary, took) = stream_during(&peer.run_args(""), || {
        peer.wait_for(20);
        assert_eq!(peer.operators(), 1);
    });
    assert!(took < Duration::from_secs(1), "took {took:?}");
    assert!(summary.sent >= 20);
    wait_until(|| peer.operators() == 0);
}

#[test]
fn a_robot_that_comes_later_is_found() {
    // A port that was free a moment ago.
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let args = args(&format!("--name late --connect {endpoint}"));
    let (summary, _) = stream_during(&args, || {
        std::thread::sleep(Duration::from_millis(800));
        let peer = Peer::start_at("late", &endpoint);
        peer.wait_for(50);
    });
    assert!(summary.round_trip.is_some());
}

#[test]
fn what_is_streamed_is_recorded_and_can_be_streamed_again() {
    let file = temporary("stream.jsonl");
    let peer = Peer::start("records");
    let summary = stream(&peer.run_args(&format!("--source fist --duration 1.5 --record {}", file.display())));
    let (written, lost) = summary.recorded.unwrap();
    assert_eq!((written, lost), (summary.progress.poses, 0));
    let bytes = std::fs::read(&file).unwrap();
    let mut reader = RecordingReader::new(bytes.as_slice(), LastLine::Whole).unwrap();
    assert_eq!(reader.header().geometry, Some(MasterGeometry::PARADIGMATIC));
    assert_eq!(reader.header().source.as_deref(), Some("fist"));
    let frames: Vec<_> = reader.by_ref().map(Result::unwrap).collect();
    assert_eq!(frames.len() as u64, written);
    let gesture = |t: f64| FrameData::Joints(Gesture::Fist.sample((t * 100.0).round() / 100.0));
    assert_eq!(frames[0].data, gesture(0.0));
    // Nothing is overwritten.
    let again = run(
        &peer.run_args(&format!("--duration 1 --record {}", file.display())),
        &Shutdown::default(),
        &Terminal::new(),
    );
    let message = again.unwrap_err().to_string();
    assert!(message.contains("never overwritten"), "{message}");

    // Streamed again: it ends by itself, and the robot has the last pose.
    let peer = Peer::start("replays");
    let summary = stream(&peer.run_args(&format!("--source {} --speed 2", file.display())));
    assert!(summary.progress.ended && summary.progress.confirmed);
    assert_eq!(summary.progress.poses + summary.progress.skipped, written);
    let FrameData::Joints(expected) = frames.last().unwrap().data else { panic!() };
    let last = peer.poses().last().unwrap().0.pose();
    let error = last.q.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(error < 1e-6, "last pose {error} rad off");
    std::fs::remove_file(&file).unwrap();
}

#[test]
fn any_program_can_feed_a_hand_in_json_and_bad_messages_do_no_harm() {
    let peer = Peer::start("feeds");
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let listen = format!("tcp/127.0.0.1:{port}");
    let args = peer.run_args(&format!("--source zenoh --listen {listen}"));
    let q = Gesture::TapIndex.sample(2.0);
    let (summary, _) = stream_during(&args, || {
        let glove = Session::open(&SessionConfig::connecting([listen.as_str()])).unwrap();
        let publisher = glove.publisher(&Keys::new("feeds").unwrap().hand_input(), Stream::Slow).unwrap();
        wait_until(|| publisher.has_subscribers());
        for bad in ["hello", "{\"q\": [1, 2, 3]}", "{\"t\": 0, \"q\": null}"] {
            publisher.put(bad.as_bytes()).unwrap();
            std::thread::sleep(Duration::from_millis(20));
        }
        let mut t = 0.0;
        wait_until(|| {
            t += 0.01;
            publisher.put(format!("{{\"t\": {t}, \"q\": {q:?}}}").as_bytes()).unwrap();
            peer.poses.lock().unwrap().len() >= 50
        });
        glove.close().unwrap();
    });
    assert_eq!(summary.progress.bad, 3);
    for (pose, _) in peer.poses() {
        let error = pose.pose().q.iter().zip(q).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(error < 1e-6, "{error} rad off");
    }
}

#[test]
fn the_real_recording_is_measured_fitted_and_streamed() {
    let Some(csv) = shared_data("human_hand_right.csv") else { return };
    let peer = Peer::start("human");
    let summary = stream(&peer.run_args(&format!("--source {} --speed 4", csv.display())));
    assert!(summary.progress.ended && summary.progress.confirmed);
    assert_eq!(summary.progress.poses + summary.progress.skipped, 400);
    assert!(summary.progress.skipped < 40, "{} skipped", summary.progress.skipped);
    let residual = summary.progress.residual.unwrap();
    assert!(residual < 0.02, "residual {residual} m");
    let geometry = peer.poses()[0].0.pose().geometry;
    assert_ne!(geometry, MasterGeometry::PARADIGMATIC);
    geometry.validate().unwrap();
}

#[test]
fn live_keypoints_are_measured_first_and_then_followed() {
    let Some(csv) = shared_data("human_hand_right.csv") else { return };
    let text = std::fs::read(csv).unwrap();
    let frames: Vec<_> = RecordingReader::new(text.as_slice(), LastLine::Whole).unwrap().map(Result::unwrap).collect();
    let peer = Peer::start("tracker");
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let listen = format!("tcp/127.0.0.1:{port}");
    let args = peer.run_args(&format!("--source zenoh --listen {listen}"));
    let (summary, _) = stream_during(&args, || {
        let tracker = Session::open(&SessionConfig::connecting([listen.as_str()])).unwrap();
        let publisher = tracker.publisher(&Keys::new("tracker").unwrap().hand_input(), Stream::Slow).unwrap();
        wait_until(|| publisher.has_subscribers());
        let (start, mut index) = (Instant::now(), 0);
        wait_until(|| {
            let frame = &frames[index % frames.len()];
            index += 1;
            let FrameData::Keypoints(keypoints) = &frame.data else { panic!() };
            publisher.put(format!("{{\"keypoints\": {:?}}}", keypoints.points()).as_bytes()).unwrap();
            if start.elapsed() < Duration::from_secs(2) {
                assert!(peer.poses.lock().unwrap().is_empty(), "streamed before it was measured");
            }
            peer.poses.lock().unwrap().len() >= 30
        });
        assert!(start.elapsed() >= Duration::from_secs(3));
        tracker.close().unwrap();
    });
    assert_eq!((summary.progress.bad, summary.progress.problem), (0, None));
    assert!(summary.progress.residual.unwrap() < 0.02);
}

#[test]
fn failures_before_anything_runs_are_told_apart() {
    let fail = |line: &str| {
        let failure = run(&args(line), &Shutdown::default(), &Terminal::new()).unwrap_err();
        (format!("{failure:#}"), matches!(failure, teleop_operator::failure::Failure::Usage(_)))
    };
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let taken = format!("--source zenoh --listen tcp/127.0.0.1:{}", taken.local_addr().unwrap().port());
    for (line, usage, expected) in [
        ("--source jazz", true, "unknown gesture `jazz`; known are open, tap_index"),
        ("--source nothing.csv", true, "nothing.csv: "),
        ("--name No/Name", true, "\"No/Name\""),
        ("--connect 127.0.0.1:7447", true, "\"127.0.0.1:7447\""),
        ("--calibration nowhere.toml", true, "cannot read the calibration nowhere.toml"),
        ("--record no/such/folder/x.jsonl", true, "make its folder first"),
        (taken.as_str(), false, "port taken"),
    ] {
        let (message, is_usage) = fail(line);
        assert!(message.contains(expected), "{line}: {message}");
        assert_eq!(is_usage, usage, "{line}: {message}");
    }
}

#[test]
fn a_robot_of_another_release_ends_it_with_an_error() {
    let session = Session::open(&SessionConfig::listening(["tcp/127.0.0.1:0"])).unwrap();
    let endpoint = session.locators().remove(0);
    let publisher = session.publisher(&Keys::new("newer").unwrap().joints(), Stream::State).unwrap();
    let stop = Arc::new(AtomicBool::new(false));
    let ended = Arc::clone(&stop);
    let thread = std::thread::spawn(move || {
        let mut bytes = [0; JointStateMessage::LEN];
        bytes[..4].copy_from_slice(&MAGIC);
        (bytes[4], bytes[6]) = (PROTOCOL as u8 + 1, JointStateMessage::KIND as u8);
        while !ended.load(Ordering::Relaxed) {
            publisher.put(&bytes).unwrap();
            std::thread::sleep(STATE_EVERY);
        }
    });
    let args = args(&format!("--name newer --connect {endpoint} --duration 30"));
    let failure = run(&args, &Shutdown::default(), &Terminal::new()).unwrap_err();
    let text = format!("{failure:#}");
    assert!(text.contains("newer") && text.contains(&endpoint) && text.contains("same release on both ends"), "{text}");
    assert!(matches!(failure, teleop_operator::failure::Failure::Runtime(_)));
    stop.store(true, Ordering::Relaxed);
    thread.join().unwrap();
}

#[test]
fn watching_needs_a_robot() {
    let peer = Peer::start("watched");
    let watch_name = |name: &str, seconds: f64| {
        let config = SessionConfig::connecting([peer.endpoint.as_str()]);
        let feedback = Arc::new(Feedback::new(random_epoch()));
        let _link = RobotLink::open(config, &Keys::new(name).unwrap(), None, &feedback).unwrap();
        let options = WatchOptions {
            json: true,
            duration: Some(Duration::from_secs_f64(seconds)),
            timeout: Duration::from_millis(1500),
            name: name.to_owned(),
            endpoints: peer.endpoint.clone(),
        };
        watch(&feedback, &options, &Shutdown::default())
    };
    watch_name("watched", 1.0).unwrap();
    let error = watch_name("nobody", 30.0).unwrap_err().to_string();
    assert!(error.contains("robot nobody was not heard"), "{error}");
}
