//! Faults of the machine: a wall clock that steps, a disk that is full.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::fs::File;
use std::io::BufReader;
use std::process::Command;
use std::time::Duration;

use teleop_common::hand::{HandModel, HandSide};
use teleop_common::mode::Mode;
use teleop_common::recording::{LastLine, RecordingReader};
use teleop_tests::eventually;
use teleop_tests::judge::{assert_limits, commands};
use teleop_tests::probe::Probe;
use teleop_tests::process::{Process, Robot, Signal, binary, with_clock, with_full_disk};

const RATE: f64 = 333.0;
const RESOLUTION: f64 = 2.5e-7;

#[test]
fn a_wall_clock_that_steps_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    // Each has a clock of its own.
    let [at_robot, at_operator] = ["robot", "operator"].map(|name| folder.path().join(name));
    let set = |seconds: &str, file: &std::path::Path| std::fs::write(file, format!("{seconds}\n")).unwrap();
    set("+0", &at_robot);
    set("+0", &at_operator);
    let robot = Robot::listening_by(with_clock("robot", &at_robot), &["tcp/127.0.0.1:0"], &[]);
    let probe = Probe::connect(robot.endpoint());
    let operator = Process::operator_by(with_clock("operator", &at_operator), robot.endpoint(), "wave", &[]);
    probe.wait_for(Mode::Engaged);
    probe.wait_for_motion(0.3);
    let (mark, before) = (probe.mark(), probe.last().unwrap());
    let holds = probe.health().unwrap().holds;
    // An hour ahead, a day back, ten years ahead; first one, then the other.
    for seconds in ["+3600", "-86400", "+315360000"] {
        for clock in [&at_robot, &at_operator] {
            set(seconds, clock);
            std::thread::sleep(Duration::from_millis(500));
        }
    }
    let states = probe.since(mark);
    assert!(states.iter().all(|state| state.follows()), "it stopped following");
    assert!(states.iter().all(|state| state.pose_epoch == before.pose_epoch));
    let oldest =
        states.iter().map(|state| state.header.sent.since(state.pose_captured).as_secs_f64()).fold(0.0, f64::max);
    println!("oldest pose {:.0} ms", 1e3 * oldest);
    assert!(oldest < 0.15, "{oldest} s");
    eventually("its health is heard", || probe.health().unwrap().ticks > states.last().unwrap().tick);
    assert_eq!(probe.health().unwrap().holds, holds);
    // The robot's wall clock did step: it says so itself in what labels pictures.
    let stepped = probe.last().unwrap().wall_offset_ns - before.wall_offset_ns;
    assert!(stepped > 300_000_000 * 1_000_000_000, "the clock did not step: {stepped} ns");
    assert_limits(&commands(&probe.states()), &HandModel::allegro_v4(HandSide::Right), RATE, RESOLUTION);
    for process in [&robot.process, &operator] {
        process.assert_no_panic();
    }
}

#[test]
fn a_full_disk_costs_the_recording_and_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    // An undisturbed pair, and one whose disk takes 64 KiB.
    let drive = |robot_by: Command, operator_by: Command, name: &str| {
        let (picture, record) = (file(&format!("{name}.rrd")), file(&format!("{name}.jsonl")));
        let viewer = format!("save={picture}");
        let robot = Robot::listening_by(robot_by, &["tcp/127.0.0.1:0"], &["--viewer", &viewer]);
        let probe = Probe::connect(robot.endpoint());
        let mut operator = Process::operator_by(operator_by, robot.endpoint(), "wave", &["--record", &record]);
        probe.wait_for(Mode::Engaged);
        let mark = probe.mark();
        std::thread::sleep(Duration::from_secs(4));
        let states = probe.since(mark);
        assert!(states.iter().all(|state| state.follows()), "{name}: it stopped following");
        let health = probe.health().unwrap();
        assert_limits(&commands(&probe.states()), &HandModel::allegro_v4(HandSide::Right), RATE, RESOLUTION);
        operator.stop(Signal::Term);
        probe.wait_for(Mode::Disarmed);
        robot.process.assert_no_panic();
        let sizes = [&picture, &record].map(|path| std::fs::metadata(path).unwrap().len());
        println!("{name}: {} overruns of {} ticks, files of {sizes:?} bytes", health.overruns, health.ticks);
        (health, sizes, robot, operator, record)
    };
    let (quiet, whole, _robot, _operator, _) =
        drive(Command::new(binary("robot")), Command::new(binary("operator")), "free");
    let (full, cut, mut robot, operator, record) =
        drive(with_full_disk("robot", 64), with_full_disk("operator", 64), "full");
    assert!(full.overruns <= quiet.overruns + full.ticks / 100, "ticks were missed");
    assert_eq!(cut, [65_536; 2]);
    assert!(whole.iter().all(|size| *size > 65_536), "the free disk would have sufficed too: {whole:?}");
    // It is told, and what was written can be read.
    assert!(operator.stderr().contains("the recording loses frames"), "{}", operator.stderr());
    let reader = RecordingReader::new(BufReader::new(File::open(&record).unwrap()), LastLine::MayBeCut).unwrap();
    let frames = reader.map(Result::unwrap).count();
    assert!(frames > 50, "{frames} frames");
    robot.process.stop(Signal::Term);
    println!("robot: {}", robot.process.stderr());
}
