//! Faults with real processes: a viewer that does not read, a robot that stands still for a while, operators that fight,
//! stops from elsewhere. In each the hand ends in the documented mode.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::net::TcpListener;
use std::time::{Duration, Instant};

use teleop_common::hand::{HandModel, HandSide};
use teleop_common::mode::Mode;
use teleop_common::wire::Rejection;
use teleop_tests::eventually;
use teleop_tests::judge::{Extremes, assert_limits, commands, spread};
use teleop_tests::probe::{Probe, State};
use teleop_tests::process::{Process, Robot, Signal, run};

const RATE: f64 = 333.0;
const RESOLUTION: f64 = 2.5e-7;
const MAX_AGE: f64 = 0.25;
/// A pose shows in the next state only, which a busy machine may delay.
const SHOWN_AFTER: f64 = 0.1;
/// At most 7 rad/s, braked with 300 rad/s²: 24 ms.
const BRAKED_AFTER: u64 = 30;

fn judge(states: &[State]) -> Extremes {
    assert_limits(&commands(states), &HandModel::allegro_v4(HandSide::Right), RATE, RESOLUTION)
}

fn age(state: &State) -> f64 {
    state.header.sent.since(state.pose_captured).as_secs_f64()
}

/// Expects all of `states` in one mode, with a command that stands still once the hand has braked.
#[track_caller]
fn assert_still_in(mode: Mode, states: &[State]) {
    assert!(states.len() >= 50, "only {} states to judge by", states.len());
    if let Some(other) = states.iter().find(|state| state.mode() != Some(mode)) {
        panic!("{:?} at tick {}, {} ticks after {mode}", other.mode(), other.tick, other.tick - states[0].tick);
    }
    let start = states[0].tick + BRAKED_AFTER;
    let commands: Vec<_> = states.iter().filter(|state| state.tick >= start).map(|state| state.q_command()).collect();
    assert_eq!(spread(commands.iter()), 0.0, "the command creeps");
}

/// A configuration file with this `[authority]`.
fn authority(text: &str) -> (tempfile::TempDir, String) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("robot.toml");
    std::fs::write(&path, format!("[authority]\n{text}\n")).unwrap();
    (folder, path.to_str().unwrap().to_owned())
}

/// A viewer that accepts and never reads, until it is dropped.
struct DeafViewer {
    endpoint: String,
    listener: TcpListener,
    connections: Vec<std::net::TcpStream>,
}

impl DeafViewer {
    fn new() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.set_nonblocking(true).unwrap();
        let endpoint = format!("connect=rerun+http://{}/proxy", listener.local_addr().unwrap());
        Self { endpoint, listener, connections: Vec::new() }
    }

    fn accept(&mut self) {
        self.connections.extend(self.listener.accept().map(|(stream, _)| stream));
    }
}

/// Drives a robot with this viewer for a while, which may die on the way: ticks, overruns, 99 % of tick times (us), holds.
fn driven(viewer: Option<DeafViewer>) -> (u64, u64, f32, u64) {
    let robot = match &viewer {
        Some(viewer) => Robot::start(&["--viewer", &viewer.endpoint]),
        None => Robot::start(&[]),
    };
    let probe = Probe::connect(robot.endpoint());
    let operator = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for(Mode::Engaged);
    let mut viewer = viewer;
    let start = Instant::now();
    while start.elapsed() < Duration::from_secs(4) {
        std::thread::sleep(Duration::from_millis(20));
        if let Some(viewer) = &mut viewer {
            viewer.accept();
        }
    }
    let connected = viewer.as_ref().map(|viewer| viewer.connections.len());
    drop(viewer);
    std::thread::sleep(Duration::from_secs(2));
    let health = probe.health().unwrap();
    judge(&probe.states());
    assert_ne!(connected, Some(0), "the robot never connected to its viewer");
    robot.process.assert_no_panic();
    operator.assert_no_panic();
    (health.ticks, health.overruns, health.tick_us.p99, health.holds)
}

#[test]
fn a_viewer_that_never_reads_and_dies_disturbs_nothing() {
    let (ticks, overruns, p99, holds) = driven(None);
    println!("no viewer:   {overruns} overruns of {ticks} ticks, p99 {p99:.0} us, {holds} holds");
    let (ticks, deaf, p99, holds) = driven(Some(DeafViewer::new()));
    println!("deaf viewer: {deaf} overruns of {ticks} ticks, p99 {p99:.0} us, {holds} holds");
    // Nothing that waits for a viewer: such a loop would miss hundreds. A few come with the load of the machine.
    assert!(deaf <= overruns + ticks / 50, "{deaf} overruns instead of {overruns}");
    assert_eq!(holds, 0);
}

#[test]
fn a_robot_that_stood_still_holds_and_obeys_nothing_old() {
    let robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    let mut operator = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for_motion(0.3);
    for time in [0.3, 1.0, 3.0] {
        probe.wait_for(Mode::Engaged);
        let mark = probe.mark();
        robot.process.signal(Signal::Stop);
        std::thread::sleep(Duration::from_secs_f64(time));
        let before = probe.last().unwrap();
        robot.process.signal(Signal::Cont);
        eventually("it goes on", || probe.last().is_some_and(|state| state.tick > before.tick + 200));
        probe.wait_for(Mode::Engaged);
        let states = probe.since(mark);
        // What was admitted before it stood still is as old as that when it wakes. The first few ticks may be from before:
        // those between two states, and what waited to be sent.
        let woken: Vec<State> = states.iter().copied().filter(|state| state.tick > before.tick + 8).collect();
        let oldest = woken.iter().filter(|state| state.follows()).map(age).fold(0.0, f64::max);
        // Poses that waited in the system's buffers may be fresh enough to go on with; mostly the watchdog is first.
        let held = states.iter().any(|state| state.mode() == Some(Mode::Holding));
        println!("stood still for {time} s: held {held}, oldest obeyed later {:.0} ms", 1e3 * oldest);
        assert!(oldest <= MAX_AGE + SHOWN_AFTER, "a pose of {oldest} s ago was followed");
        judge(&states);
    }
    assert!(operator.is_running());
    robot.process.assert_no_panic();
    operator.assert_no_panic();
}

#[test]
fn an_operator_that_was_killed_is_replaced_when_its_lease_is_over() {
    let robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    let mut operator = Process::operator(robot.endpoint(), "wave", &[]);
    for _ in 0..3 {
        probe.wait_for(Mode::Engaged);
        let (epoch, mark) = (probe.last().unwrap().pose_epoch, probe.mark());
        operator.kill();
        operator = Process::operator(robot.endpoint(), "wave", &[]);
        eventually("another one is followed", || {
            probe.last().is_some_and(|state| state.follows() && state.pose_epoch != epoch)
        });
        let states = probe.since(mark);
        let killed = states.iter().rfind(|state| state.pose_epoch == epoch).unwrap();
        let obeyed = states.iter().find(|state| state.pose_seq == killed.pose_seq).unwrap();
        let armed = states.iter().find(|state| state.pose_epoch != epoch).unwrap();
        let after = (armed.tick - obeyed.tick) as f64 / RATE;
        println!("the next operator has the robot {after:.2} s after the last pose of the one before");
        // It may not come before the lease of 2 s is over, and nothing else keeps it.
        assert!((1.9..4.0).contains(&after), "{after} s");
    }
    judge(&probe.states());
}

/// Two operators that both want the robot at any time, for a while: how often it changed hands, how often the second was
/// refused, and the states.
fn fight(takeover: &str) -> (usize, u64, Vec<State>) {
    let (folder, config) = authority(&format!("takeover = {takeover:?}"));
    let robot = Robot::start(&["--config", &config]);
    let probe = Probe::connect(robot.endpoint());
    let first = Process::operator(robot.endpoint(), "wave", &["--takeover"]);
    probe.wait_for_motion(0.2);
    let mark = probe.mark();
    let second = Process::operator(robot.endpoint(), "fist", &["--takeover"]);
    std::thread::sleep(Duration::from_secs(6));
    let states = probe.since(mark);
    let changes = states.windows(2).filter(|pair| pair[0].holder != pair[1].holder).count();
    let refused = probe.rejected(Rejection::Takeover);
    let share = states.iter().filter(|state| state.follows()).count() as f64 / states.len() as f64;
    println!("takeover {takeover}: {changes} changes, {refused} refused, followed {:.0} % of the time", 100.0 * share);
    judge(&probe.states());
    for process in [&first, &second, &robot.process] {
        process.assert_no_panic();
    }
    drop(folder);
    (changes, refused, states)
}

#[test]
fn two_operators_that_fight_do_no_harm() {
    for takeover in ["never", "idle"] {
        let (changes, refused, states) = fight(takeover);
        assert_eq!(changes, 0);
        assert!(refused > 100, "{refused}");
        assert!(states.iter().all(|state| state.follows() && state.holder == states[0].holder));
    }
    let (changes, _refused, states) = fight("always");
    assert!(changes > 0);
    // Whoever takes it, the hand does not go on with another's poses: it stops first.
    for pair in states.windows(2) {
        let changed = pair[0].pose_epoch != pair[1].pose_epoch && pair[1].tick <= pair[0].tick + 4;
        let goes_on = changed && pair[0].follows() && pair[1].mode() == Some(Mode::Engaged);
        assert!(!goes_on, "tick {}", pair[1].tick);
    }
}

#[test]
fn anybody_may_stop_the_hand_and_it_stays_stopped() {
    let robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    let _operator = Process::operator(robot.endpoint(), "wave", &[]);
    probe.wait_for_motion(0.3);
    let begun = teleop_common::net::clock::now();
    let output = run("operator", &["stop", "--connect", robot.endpoint()]);
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let states = probe.states();
    let stopped = states.iter().position(|state| state.mode() == Some(Mode::Stopped)).unwrap();
    let after = states[stopped].header.sent.since(begun).as_secs_f64();
    println!("stopped {:.0} ms after `operator stop` was started", 1e3 * after);
    // Its clutch is closed all the time, and it would follow whenever the robot is ready.
    probe.wait_for_more(300);
    assert_still_in(Mode::Stopped, &probe.since(stopped));
    robot.process.signal(Signal::Usr2);
    probe.wait_for(Mode::Engaged);

    // At the robot.
    let mark = probe.mark();
    robot.process.signal(Signal::Usr1);
    eventually("it stops", || probe.since(mark).iter().any(|state| state.mode() == Some(Mode::Stopped)));
    let stopped = mark + probe.since(mark).iter().position(|state| state.mode() == Some(Mode::Stopped)).unwrap();
    probe.wait_for_more(100);
    assert_still_in(Mode::Stopped, &probe.since(stopped));
    judge(&probe.states());
}

#[test]
fn a_signal_moves_the_clutch() {
    let robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    let arguments = ["run", "--viewer", "off", "--clutch", "key", "--connect", robot.endpoint(), "--source", "wave"];
    let operator = Process::start("operator", &arguments);
    let armed = probe.wait_for(Mode::Armed);
    probe.wait_for_more(150);
    assert_still_in(Mode::Armed, &probe.since(armed));
    operator.signal(Signal::Usr1);
    probe.wait_for_motion(0.3);
    probe.wait_for(Mode::Engaged);
    let mark = probe.mark();
    operator.signal(Signal::Usr1);
    eventually("it lets go", || probe.since(mark).iter().any(|state| state.mode() == Some(Mode::Armed)));
    let open = mark + probe.since(mark).iter().position(|state| state.mode() == Some(Mode::Armed)).unwrap();
    probe.wait_for_more(150);
    assert_still_in(Mode::Armed, &probe.since(open));
    judge(&probe.states());
}
