//! The recording of a real hand through both processes, over a network with delay, jitter and loss.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::time::Duration;

use teleop_common::hand::{HandModel, HandSide};
use teleop_common::mode::Mode;
use teleop_common::testing::shared_data;
use teleop_common::wire::Rejection;
use teleop_link::{Impairment, Relay};
use teleop_tests::eventually;
use teleop_tests::judge::{assert_limits, commands};
use teleop_tests::probe::{Probe, moved};
use teleop_tests::process::{Process, Robot, Signal, run};

const MS: Duration = Duration::from_millis(1);
const RATE: f64 = 333.0;
const RESOLUTION: f64 = 2.5e-7;
/// Frames of the recording.
const FRAMES: u64 = 400;

#[test]
fn a_recorded_hand_drives_the_robot_over_a_bad_network() {
    let Some(recording) = shared_data("human_hand_right.csv") else { return };
    let folder = tempfile::tempdir().unwrap();
    let recorded = folder.path().join("streamed.jsonl");
    let recorded = recorded.to_str().unwrap();
    let hand = HandModel::allegro_v4(HandSide::Right);

    // Over the bad link go poses and their answers; this test watches over a good one.
    let mut robot = Robot::listening(&["udp/127.0.0.1:0", "tcp/127.0.0.1:0"], &[]);
    let relay = Relay::udp(robot.endpoints[0].trim_start_matches("udp/").parse().unwrap(), 20_260).unwrap();
    let probe = Probe::connect(&robot.endpoints[1]);
    probe.wait_for(Mode::Disarmed);
    let far = format!("udp/{}", relay.address());
    let mut operator = Process::operator(&far, recording.to_str().unwrap(), &["--record", recorded]);
    let engaged = probe.wait_for(Mode::Engaging);
    // From the first frames on. Not before: zenoh repeats nothing over UDP, so what is lost while the session opens is
    // not always made up for.
    relay.set(Impairment { delay: 20 * MS, jitter: 5 * MS, loss: 0.01, ..Impairment::default() });
    let status = operator.wait(Duration::from_secs(60));
    assert_eq!(status.code(), Some(0), "{}", operator.stderr());
    // Those of the recording: afterwards nobody has the robot, and it holds still.
    let states = probe.since(engaged);
    let count = |mode: Mode| states.iter().filter(|state| state.mode() == Some(mode)).count();
    eventually("it is free at the end", || probe.last().is_some_and(|state| state.mode() == Some(Mode::Disarmed)));
    probe.wait_for_more(50);
    let health = probe.health().unwrap();
    robot.process.stop(Signal::Term);
    operator.assert_no_panic();
    probe.assert_all_valid();

    let extremes = assert_limits(&commands(&probe.states()), &hand, RATE, RESOLUTION);
    let share = (count(Mode::Engaging) + count(Mode::Engaged)) as f64 / states.len() as f64;
    let refused: Vec<_> = Rejection::ALL
        .into_iter()
        .filter(|reason| health.rejected[reason.index()] > 0)
        .map(|reason| format!("{} {}", health.rejected[reason.index()], reason.name()))
        .collect();
    let summary = operator.stdout().trim_end().to_owned();
    println!("human_hand_right.csv through robot and operator, 20 +- 5 ms one way, 1 % loss");
    println!("operator: {summary}");
    println!("relay: {:?}", relay.stats());
    println!("poses obeyed: {}, refused: {refused:?}, holds: {}", health.poses_accepted, health.holds);
    let age = health.age_ms;
    println!("age of a pose at the robot: p50 {:.1} ms, p99 {:.1} ms, max {:.1} ms", age.p50, age.p99, age.max);
    println!("added by both processes and the host: {:.1} ms (p50)", age.p50 - 20.0);
    println!("engaged {:.1} % of {} states, {extremes:?}", 100.0 * share, states.len());

    assert!(share >= 0.9, "engaged {:.0} % of the time", 100.0 * share);
    // Of 400, lost are 1 %, and those before the clocks have met, which takes one round trip.
    assert!(health.poses_accepted >= FRAMES * 85 / 100, "{} poses obeyed", health.poses_accepted);
    // The relay delays by 15 ms or more; the clock's error is at most half of the jitter of both ways.
    assert!(age.p50 >= 10.0 && age.p50 < 150.0, "{age:?}");
    assert!(relay.stats().total().lost > 0, "the relay lost nothing");
    assert!(moved(&states, 0.3) >= 10, "{} joints moved", moved(&states, 0.3));

    replay(recorded, &folder);
}

/// What `--record` wrote is a recording like any other.
fn replay(recorded: &str, folder: &tempfile::TempDir) {
    let lines = std::fs::read_to_string(recorded).unwrap().lines().count() as u64;
    assert!(lines > FRAMES * 9 / 10 && lines <= FRAMES + 1, "{lines} lines");
    let output = folder.path().join("allegro.jsonl");
    let output = output.to_str().unwrap();
    let retarget = run("robot", &["retarget", "--input", recorded, "--output", output]);
    assert_eq!(retarget.status.code(), Some(0), "{}", String::from_utf8_lossy(&retarget.stderr));
    // The header line is no frame.
    assert_eq!(std::fs::read_to_string(output).unwrap().lines().count() as u64, lines - 1);

    let robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    probe.wait_for(Mode::Disarmed);
    let mut operator = Process::operator(robot.endpoint(), recorded, &["--speed", "6"]);
    assert_eq!(operator.wait(Duration::from_secs(60)).code(), Some(0), "{}", operator.stderr());
    let states = probe.states();
    assert!(moved(&states, 0.3) >= 10, "{} joints moved", moved(&states, 0.3));
    assert_limits(&commands(&states), &HandModel::allegro_v4(HandSide::Right), RATE, RESOLUTION);

    // It is never overwritten.
    let again = run("operator", &["--source", "fist", "--record", recorded, "--connect", robot.endpoint()]);
    let text = String::from_utf8_lossy(&again.stderr).into_owned();
    assert_eq!(again.status.code(), Some(2), "{text}");
    assert!(text.contains(recorded) && text.contains("never overwritten"), "{text}");
}
