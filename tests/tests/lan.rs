//! Robots that are looked for on the local network, which is this machine's loopback interface here.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use teleop_common::mode::Mode;
use teleop_tests::probe::Probe;
use teleop_tests::process::{Process, Robot, Signal, run};
use zenoh::Wait as _;

const LAN: &str = "--lan=127.0.0.1";

#[test]
fn robots_that_may_be_found_are_listed_and_driven_by_name() {
    let shown = Robot::listening(&["udp/127.0.0.1:0"], &[LAN, "--name", "shown"]);
    let other = Robot::listening(&["tcp/127.0.0.1:0"], &[LAN, "--name", "other"]);
    let hidden = Robot::listening(&["tcp/127.0.0.1:0"], &["--name", "hidden"]);

    let output = run("operator", &["list", LAN, "--json"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(0), "{text}{}", String::from_utf8_lossy(&output.stderr));
    let rows: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let told: Vec<_> = rows.iter().map(|row| (row["robot"].as_str().unwrap(), row["endpoint"].as_str())).collect();
    assert_eq!(told, [("other", Some(other.endpoint())), ("shown", Some(shown.endpoint()))]);
    let table = String::from_utf8(run("operator", &["list", LAN]).stdout).unwrap();
    assert!(table.contains("endpoint") && table.contains(shown.endpoint()), "{table}");

    // By name alone.
    let arguments = ["run", "--viewer", "off", "--clutch", "auto", "--source", "wave", "--name", "shown", LAN];
    let mut operator = Process::start("operator", &arguments);
    teleop_tests::eventually("it is driven", || {
        let rows = run("operator", &["list", "--json", "--connect", shown.endpoint()]).stdout;
        String::from_utf8(rows).unwrap().contains("\"engaged\"")
    });
    let stop = run("operator", &["stop", "--name", "shown", LAN]);
    assert_eq!(stop.status.code(), Some(0), "{}", String::from_utf8_lossy(&stop.stderr));
    operator.stop(Signal::Term);

    // Neither one that hides, nor one that is not there, nor an interface that is none.
    for name in ["hidden", "none"] {
        let output = run("operator", &["stop", "--name", name, LAN]);
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{text}");
        assert!(text.contains(name) && text.contains("found: other, shown") && text.contains("--lan"), "{text}");
    }
    for program in [["operator", "list"], ["robot", "run"]] {
        let output = run(program[0], &[program[1], "--lan=none0"]);
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{text}");
        assert!(text.contains("\"none0\"") && text.contains("lo"), "{text}");
    }

    // Two of one name: which one is the user's business.
    let twin = Robot::listening(&["tcp/127.0.0.1:0"], &[LAN, "--name", "other"]);
    let output = run("operator", &["stop", "--name", "other", LAN]);
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("two robots are called other") && text.contains(twin.endpoint()), "{text}");
    for robot in [shown, other, hidden, twin] {
        robot.process.assert_no_panic();
    }
}

#[test]
fn what_strangers_answer_is_no_error() {
    // A process of somebody else, which has no robot.
    let settings = serde_json::json!({
        "mode": "peer",
        "listen": { "endpoints": ["tcp/127.0.0.1:0"] },
        "scouting": { "multicast": { "enabled": true, "interface": "127.0.0.1", "autoconnect": [] } },
    });
    let stranger = zenoh::open(zenoh::Config::from_json5(&settings.to_string()).unwrap()).wait().unwrap();
    let robot = Robot::listening(&["tcp/127.0.0.1:0"], &[LAN]);
    let output = run("operator", &["list", LAN, "--json"]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!((output.status.code(), text.lines().count()), (Some(0), 1), "{text}");
    assert!(text.contains(robot.endpoint()), "{text}");
    stranger.close().wait().unwrap();
}

#[test]
fn a_robot_connects_to_nobody_because_it_was_heard() {
    let first = Robot::listening(&["tcp/127.0.0.1:0"], &[LAN]);
    let probe = Probe::connect(first.endpoint());
    probe.wait_for(Mode::Disarmed);
    let _second = Robot::listening(&["tcp/127.0.0.1:0"], &[LAN, "--name", "second"]);
    let _found = run("operator", &["list", LAN]);
    // A connection between the robots would show the second through the first.
    let robots = probe.session.live_now("allegro/v1/*/live/robot/*", std::time::Duration::from_secs(2)).unwrap();
    assert_eq!(robots.len(), 1, "{robots:?}");
}
