//! Both binaries as processes: start, late join, stop, kill, restart, strangers, exit codes.
//!
//! Times are judged by the robot's ticks and stamps, not by when this test got to look.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::time::Duration;

use teleop_common::authority::{Clutch, Intent};
use teleop_common::hand::{HandModel, HandSide};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
use teleop_common::mode::Mode;
use teleop_common::net::{Session, SessionConfig, Stream, clock};
use teleop_common::time::MonoTime;
use teleop_common::wire::{Echo, MAX_MESSAGE, PoseMessage, Rejection, Stamper, encode_into};
use teleop_tests::judge::{Extremes, assert_limits, commands, spread};
use teleop_tests::probe::{Probe, State};
use teleop_tests::process::{Process, Robot, Signal, config, free_endpoint, run};
use teleop_tests::{PATIENCE, eventually};

const RATE: f64 = 333.0;
/// The robot's defaults, s.
const HOLD_AFTER: f64 = 0.1;
/// The operator's period, s.
const PERIOD: f64 = 0.01;
const MAX_AGE: f64 = 0.25;
/// States carry angles as f32.
const RESOLUTION: f64 = 2.5e-7;

fn judge(states: &[State]) -> Extremes {
    assert_limits(&commands(states), &HandModel::allegro_v4(HandSide::Right), RATE, RESOLUTION)
}

fn is(mode: Mode) -> impl Fn(&State) -> bool {
    move |state| state.mode() == Some(mode)
}

/// Waits until the robot follows an operator other than `former`, and gives its epoch.
#[track_caller]
fn follows_another(probe: &Probe, former: u64) -> u64 {
    let mut epoch = 0;
    eventually("the robot follows another operator", || {
        epoch = probe.last().filter(State::follows).map_or(0, |state| state.pose_epoch);
        epoch != 0 && epoch != former
    });
    epoch
}

/// Expects that the hand, which began to hold at the first of `states`, stands exactly still once it has braked.
#[track_caller]
fn assert_still(states: &[State]) {
    let start = states[0].tick;
    // At most 7 rad/s, braked with 300 rad/s²: 24 ms, 8 ticks. The hand itself takes longer to settle.
    let after = |ticks: u64| states.iter().filter(move |state| state.tick >= start + ticks);
    let commands: Vec<_> = after(30).map(|state| state.q_command()).collect();
    assert!(commands.len() >= 20, "only {} states to judge by", commands.len());
    assert_eq!(spread(commands.iter()), 0.0, "the command creeps while the robot holds");
    let measured: Vec<_> = after(200).map(|state| state.q()).collect();
    assert!(measured.len() >= 20, "only {} states to judge by", measured.len());
    assert!(spread(measured.iter()) < 1e-4, "the hand moves while it holds: {} rad", spread(measured.iter()));
}

#[test]
fn the_hand_moves_whoever_starts_first() {
    // The robot first.
    let mut robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    probe.wait_for(Mode::Disarmed);
    let describe = probe.session.get(&probe.keys.describe(), PATIENCE).unwrap();
    let describe: serde_json::Value = serde_json::from_slice(&describe).unwrap();
    assert_eq!((describe["joints"].as_array().unwrap().len(), &describe["hand"]), (16, &"right".into()));
    let idle = probe.mark();
    let mut operator = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for_motion(0.3);
    assert_eq!(spread(probe.states()[..idle].iter().map(|state| state.q_command()).collect::<Vec<_>>().iter()), 0.0);
    eventually("health tells of it", || probe.health().is_some_and(|health| health.poses_accepted > 100));
    let health = probe.health().unwrap();
    assert!(health.rate_hz > 200.0 && health.rate_hz < 400.0, "{}", health.rate_hz);
    assert!(probe.mapping().unwrap().fingers().len() == 4);
    operator.stop(Signal::Term);
    assert!(operator.stdout().contains("streamed "), "{}", operator.stdout());
    robot.process.stop(Signal::Term);
    let extremes = judge(&probe.states());
    println!("robot first: {extremes:?}");
    probe.assert_all_valid();

    // The operator first, by a second or more.
    let endpoint = free_endpoint();
    let mut operator = Process::operator(&endpoint, "wave", &[]);
    std::thread::sleep(Duration::from_millis(1200));
    assert!(operator.is_running(), "{}", operator.stderr());
    let robot = Robot::listening(&[&endpoint], &[]);
    let probe = Probe::connect(robot.endpoint());
    probe.wait_for_motion(0.3);
    judge(&probe.states());
    operator.assert_no_panic();
    robot.process.assert_no_panic();
}

#[test]
fn signals_end_both_cleanly() {
    for signal in [Signal::Term, Signal::Int] {
        let mut robot = Robot::start(&[]);
        let probe = Probe::connect(robot.endpoint());
        // Tokens show to those that a process is connected with: this test listens for the operator's.
        let listener = Session::open(&SessionConfig::listening(["tcp/127.0.0.1:0"])).unwrap();
        let here = listener.locators().remove(0);
        let mut operator = Process::operator(robot.endpoint(), "fist", &["--connect", &here]);
        let operators = || listener.live_now(&probe.keys.live_operators(), PATIENCE).unwrap();
        probe.wait_for(Mode::Engaged);
        eventually("both are alive", || operators().len() == 1 && probe.robots().len() == 1);
        let epoch = probe.last().map(|state| state.pose_epoch);
        assert_eq!(probe.keys.live_epoch(&operators()[0]), epoch, "the token names the one that is followed");
        operator.stop(signal);
        eventually("the operator's token is gone", || operators().is_empty());
        // It gave the robot back, so nothing was missing.
        let ended = probe.wait_for(Mode::Disarmed);
        probe.wait_for_more(80);
        assert_still(&probe.since(ended));
        assert_eq!(probe.health().unwrap().holds, 0);
        robot.process.stop(signal);
        eventually("the robot's token is gone", || probe.robots().is_empty());
        assert!(robot.process.stderr().contains("stopped"), "{}", robot.process.stderr());
    }
}

#[test]
fn a_killed_operator_leaves_the_hand_still_and_the_next_one_goes_on() {
    let robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    let mut first = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for_motion(0.5);
    let epoch = probe.last().unwrap().pose_epoch;
    first.kill();
    let holding = probe.wait_for(Mode::Holding);
    probe.wait_for_more(120);
    let states = probe.states();

    // From the first state with the last pose, hold_after and the few ticks between two states, to the first hold.
    let last_pose = states[holding].pose_seq;
    let obeyed = states.iter().find(|state| state.pose_epoch == epoch && state.pose_seq == last_pose).unwrap();
    let ticks = states[holding].tick - obeyed.tick;
    println!("holding {ticks} ticks after the last pose, nominal {:.0}", (HOLD_AFTER + PERIOD) * RATE);
    assert!(ticks as f64 <= (HOLD_AFTER + PERIOD) * RATE + 6.0, "holding {ticks} ticks after the last pose");
    let end = states[holding..].iter().position(|state| !is(Mode::Holding)(state));
    assert_eq!(end, None, "it stays so");
    assert_still(&states[holding..]);
    assert_eq!(states[holding..].iter().map(|state| state.pose_seq).max(), Some(last_pose));

    let mut second = Process::operator(robot.endpoint(), "wave", &[]);
    follows_another(&probe, epoch);
    probe.wait_for_motion(0.5);
    second.stop(Signal::Term);
    let states = probe.states();
    let extremes = judge(&states);
    println!("killed and replaced: {extremes:?}");

    // It starts from where it stood, slowly: 1 rad/s at first, ten times that after a second.
    let resumed = holding + states[holding..].iter().position(State::follows).unwrap();
    let start = states[resumed].tick;
    for pair in commands(&states[resumed - 1..]).windows(2).take_while(|pair| pair[1].tick < start + 300) {
        let ticks = (pair[1].tick - pair[0].tick) as f64;
        let allowed = 1.0 + 9.0 * (pair[1].tick - start) as f64 / RATE;
        let fastest = spread([pair[0].q, pair[1].q].iter()) / (ticks / RATE);
        assert!(fastest <= allowed + 0.01, "{fastest} rad/s {} ticks after it resumed", pair[1].tick - start);
    }
    assert!(probe.health().unwrap().holds >= 1);
    robot.process.assert_no_panic();
}

#[test]
fn a_stopped_operator_delivers_nothing_stale() {
    let robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    let mut operator = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for_motion(0.3);
    let epoch = probe.last().unwrap().pose_epoch;
    operator.signal(Signal::Stop);
    let holding = probe.wait_for(Mode::Holding);
    std::thread::sleep(Duration::from_secs(3));
    let woken = probe.mark();
    assert!(probe.since(holding).iter().all(is(Mode::Holding)));
    assert_still(&probe.since(holding));
    operator.signal(Signal::Cont);
    probe.wait_for(Mode::Engaged);
    probe.wait_for_motion(0.3);
    let states = probe.states();
    assert!(states[woken..].iter().all(|state| state.pose_epoch == epoch), "it is the same process");
    // All clocks are of this machine. What was captured before the stop would be 3 s old; the margin is for a telemetry
    // thread that a busy machine keeps waiting.
    let oldest = states[woken..]
        .iter()
        .filter(|state| state.follows())
        .map(|state| state.header.sent.since(state.pose_captured).as_secs_f64())
        .fold(0.0, f64::max);
    println!("oldest pose obeyed after the stop: {:.0} ms", oldest * 1e3);
    assert!(oldest <= HOLD_AFTER + MAX_AGE + 0.8, "a pose of {oldest} s ago was followed");
    judge(&states);
    assert!(operator.is_running());
    operator.assert_no_panic();
}

#[test]
fn a_killed_robot_is_found_again_when_it_restarts() {
    let mut robot = Robot::start(&[]);
    let endpoint = robot.endpoint().to_owned();
    let probe = Probe::connect(&endpoint);
    let mut operator = Process::operator(&endpoint, "wave", &[]);
    probe.wait_for_motion(0.2);
    let epoch = probe.last().unwrap().header.epoch;
    robot.process.kill();
    std::thread::sleep(Duration::from_millis(500));
    let _robot = Robot::listening(&[&endpoint], &[]);
    eventually("another robot is seen", || probe.last().is_some_and(|state| state.header.epoch != epoch));
    probe.wait_for(Mode::Engaged);
    probe.wait_for_motion(0.2);
    judge(&probe.states());
    operator.stop(Signal::Term);
}

#[test]
fn a_second_operator_waits_for_the_first_to_end() {
    // Long enough that a busy machine does not keep the first one silent for it.
    let (folder, config) = config("[authority]\nhold_after_s = 1.5\nmax_age_s = 1.5");
    let robot = Robot::start(&["--config", &config]);
    let probe = Probe::connect(robot.endpoint());
    let mut first = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for_motion(0.2);
    let epoch = probe.last().unwrap().pose_epoch;
    let before = probe.mark();
    let mut second = Process::operator(robot.endpoint(), "fist", &[]);
    eventually("the second is refused", || probe.rejected(Rejection::Operator) > 100);
    probe.wait_for_more(50);
    for state in probe.since(before) {
        assert_eq!((state.follows(), state.pose_epoch), (true, epoch), "at tick {}", state.tick);
    }
    first.stop(Signal::Term);
    follows_another(&probe, epoch);
    probe.wait_for_motion(0.2);
    judge(&probe.states());
    second.stop(Signal::Term);
    drop(folder);
}

#[test]
fn garbage_disturbs_nothing() {
    let (folder, config) = config("[authority]\nhold_after_s = 1.5\nmax_age_s = 1.5");
    let robot = Robot::start(&["--config", &config]);
    let probe = Probe::connect(robot.endpoint());
    // Before anybody drives: none of it may move the hand.
    let vandal = probe.session.publisher(&probe.keys.pose(), Stream::Slow).unwrap();
    eventually("the robot listens", || vandal.has_subscribers());
    let pose = MasterPose { q: Gesture::Fist.sample(1.0), geometry: MasterGeometry::PARADIGMATIC, tuning: None };
    let intent = Intent { clutch: Clutch(1), takeover: true, ..Intent::default() };
    let mut stamper = Stamper::new(13);
    let mut throw = || {
        let now = clock::now();
        let header = stamper.header::<PoseMessage>(now);
        // An echo of a robot that is not there, and one out of the future.
        let echo = Echo { epoch: 99, sent: MonoTime(now.0 + 1), received: MonoTime(u64::MAX) };
        let mut bytes = [0; MAX_MESSAGE];
        let len = encode_into(&PoseMessage::new(header, echo, now, &pose, intent), &mut bytes).unwrap();
        let mut version = bytes;
        version[4] ^= 0x40;
        let mut nan = bytes;
        nan[64..68].copy_from_slice(&f32::NAN.to_le_bytes());
        let junk = [0xa5; 9000];
        for payload in [&bytes[..0], &bytes[..len], &bytes[..len / 2], &version[..len], &nan[..len], b"{}", &junk] {
            vandal.put(payload).unwrap();
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    for _ in 0..50 {
        throw();
    }
    eventually("all of it is counted", || {
        probe.rejected(Rejection::Malformed) >= 150
            && probe.rejected(Rejection::Protocol) >= 40
            && probe.rejected(Rejection::Value) >= 40
            && probe.rejected(Rejection::Clock) >= 40
    });
    assert!(probe.states().iter().all(is(Mode::Disarmed)));

    let mut operator = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for(Mode::Engaged);
    let engaged = probe.mark();
    for _ in 0..400 {
        throw();
    }
    probe.wait_for_motion(0.2);
    let driver = probe.last().unwrap().pose_epoch;
    for state in probe.since(engaged) {
        assert_eq!((state.follows(), state.pose_epoch), (true, driver), "at tick {}", state.tick);
    }
    assert_ne!(driver, 13);
    assert!(robot.process.stderr().contains("poses of another wire protocol"), "{}", robot.process.stderr());
    assert!(probe.rejected(Rejection::Malformed) >= 1000, "{:?}", probe.health().unwrap().rejected);
    judge(&probe.states());
    operator.stop(Signal::Term);
    robot.process.assert_no_panic();
    drop(folder);
}

#[test]
fn exit_codes_and_messages() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let broken = file("broken.toml", "[control]\nrate_hz = \"fast\"\n");
    let range = file("range.toml", "[mapping]\nr2 = 0.001\n");
    let takeover = file("takeover.toml", "[authority]\ntakeover = \"please\"\n");
    let urdf = file("hand.urdf", "<robot name=\"none\"></robot>");
    let csv = file("hand.csv", "frame,time\n1,2\n");
    let missing = folder.path().join("none.urdf").to_str().unwrap().to_owned();
    let robot = Robot::start(&[]);
    let busy = robot.endpoint();
    let free = free_endpoint();
    let cases: &[(&str, &[&str], i32, &[&str])] = &[
        ("robot", &["--rate", "fast"], 2, &["'fast'", "--rate"]),
        ("robot", &["--rate", "1"], 2, &["rate_hz = 1 ", "from 20 to 2000 Hz"]),
        ("robot", &["--hand", "middle"], 2, &["'middle'", "right, left"]),
        ("robot", &["--preset", "best"], 2, &["\"best\"", "\"default\" or \"paper\""]),
        ("robot", &["--name", "My Hand"], 2, &["\"My Hand\"", "a-z"]),
        ("robot", &["--config", &broken], 2, &[&broken, "rate_hz"]),
        ("robot", &["--config", &range], 2, &["r2 = 0.001", "at least r1"]),
        ("robot", &["--urdf", &missing], 2, &[&missing, "No such file"]),
        ("robot", &["--urdf", &urdf], 2, &[&urdf]),
        ("robot", &["--listen", "127.0.0.1:7447"], 2, &["\"127.0.0.1:7447\"", "tcp/127.0.0.1:7447"]),
        ("robot", &["--zenoh", &missing], 2, &[&missing]),
        ("robot", &["--viewer", "screen"], 2, &["\"screen\"", "off"]),
        ("robot", &["--duration", "0"], 2, &["'0'", "seconds above 0"]),
        ("robot", &["fly"], 2, &["fly"]),
        ("robot", &["--listen", busy, "--viewer", "off"], 1, &[busy, "another"]),
        ("operator", &["--rate", "0"], 2, &["'0'", "1 to 1000 Hz"]),
        ("operator", &["--source", "juggle"], 2, &["juggle", "tap_index"]),
        ("operator", &["--source", &missing], 2, &["none.urdf"]),
        ("operator", &["--source", &csv], 2, &[&csv, "line 1"]),
        ("operator", &["--connect", "robot"], 2, &["\"robot\"", "tcp/"]),
        ("operator", &["--calibration", &missing], 2, &[&missing, "No such file"]),
        ("operator", &["--record", busy, "--connect", &free, "--viewer", "off"], 2, &[busy, "folder"]),
        ("operator", &["watch", "--connect", &free, "--timeout", "0.5"], 1, &[&free, "is it running"]),
        ("operator", &["stop", "--connect", &free], 1, &[&free, "did not confirm the stop", "emergency stop"]),
        ("operator", &["list", "--connect", &free], 1, &[&free, "nobody answers"]),
        ("operator", &["--operator", "a name that is too long"], 2, &["a name that is too long", "1 to 16"]),
        ("robot", &["--config", &takeover], 2, &["please", "never"]),
    ];
    for (name, arguments, code, words) in cases {
        let output = run(name, arguments);
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(*code), "{name} {arguments:?}:\n{text}");
        for word in *words {
            assert!(text.contains(word), "{name} {arguments:?} does not say {word}:\n{text}");
        }
        assert!(text.starts_with("error: "), "{name} {arguments:?}:\n{text}");
        // A cause told twice.
        assert!(text.matches("os error").count() <= 1, "{text}");
    }
    for name in ["robot", "operator"] {
        for flag in ["--help", "--version"] {
            assert_eq!(run(name, &[flag]).status.code(), Some(0), "{name} {flag}");
        }
    }
}

#[test]
fn duration_ends_both_with_zero() {
    let endpoint = free_endpoint();
    let mut operator = Process::operator(&endpoint, "tour", &["--duration", "0.5"]);
    assert_eq!(operator.wait(PATIENCE).code(), Some(0), "{}", operator.stderr());
    assert!(operator.stdout().contains("no echo from the robot"), "{}", operator.stdout());
    let mut robot = Robot::start(&["--duration", "4"]);
    let watch = run("operator", &["watch", "--connect", robot.endpoint(), "--json", "--duration", "1"]);
    assert_eq!(watch.status.code(), Some(0), "{}", String::from_utf8_lossy(&watch.stderr));
    let lines = String::from_utf8(watch.stdout).unwrap();
    let states: Vec<serde_json::Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(states.len() >= 3, "{lines}");
    assert!(states.iter().all(|state| state["mode"] == "disarmed" && state["q"].as_array().unwrap().len() == 16));
    assert_eq!(robot.process.wait(PATIENCE).code(), Some(0), "{}", robot.process.stderr());
}
