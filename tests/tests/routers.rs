//! Robot and operator meet at routers, which may die.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::time::Duration;

use teleop_common::hand::{HandModel, HandSide};
use teleop_common::mode::Mode;
use teleop_common::net::clock::now;
use teleop_common::net::{Role, SessionConfig};
use teleop_tests::certificates::Certificates;
use teleop_tests::eventually;
use teleop_tests::judge::{assert_limits, commands};
use teleop_tests::probe::{Probe, State};
use teleop_tests::process::{Process, Robot, Router, Signal, free_endpoint, run, strs};

const RATE: f64 = 333.0;
const RESOLUTION: f64 = 2.5e-7;
/// From the last pose to holding: 0.1 s, a period of the source, and up to four ticks between two states.
const HELD_AFTER: u64 = 37 + 5;

const ANY_PORT: &str = "quic/127.0.0.1:0";

/// A router that lets ada drive the robot `robot`.
fn router_at(certificates: &Certificates, listen: &str, more: &[&str]) -> Router {
    let flags = certificates.flags("router");
    Router::listening(listen, &[&["--allow-robot", "robot", "--allow-operator", "ada"], &*strs(&flags), more].concat())
}

fn robot_at(certificates: &Certificates, router: &str) -> Robot {
    // The robot sees the router's name on what comes from there.
    let mut options = certificates.flags("robot");
    options.extend(["--connect", router, "--allow-operator", "router"].map(str::to_owned));
    Robot::listening(&["quic/127.0.0.1:0"], &strs(&options))
}

fn operator_at(certificates: &Certificates, router: &str) -> Process {
    let mut options = certificates.flags("ada");
    options.push("--router".to_owned());
    Process::operator(router, "wave", &strs(&options))
}

#[test]
fn robot_and_operator_meet_at_routers() {
    let certificates = Certificates::of(&["robot", "router", "ada"]);
    let mut first = router_at(&certificates, ANY_PORT, &["--allow-router", "router"]);
    let mut second = router_at(&certificates, ANY_PORT, &["--connect", &first.endpoint, "--allow-router", "router"]);
    for (at, name) in [(&first, "one router"), (&second, "two routers")] {
        let mut robot = robot_at(&certificates, &first.endpoint);
        let probe = Probe::open(&SessionConfig { role: Role::Client, ..certificates.session("ada", &at.endpoint) });
        let mut operator = operator_at(&certificates, &at.endpoint);
        probe.wait_for(Mode::Engaged);
        probe.wait_for_motion(0.3);
        operator.stop(Signal::Term);
        println!("{name}: {}", operator.stdout());
        probe.wait_for(Mode::Disarmed);
        robot.process.stop(Signal::Term);
    }
    for router in [&mut first, &mut second] {
        router.process.stop(Signal::Term);
    }
    // Nobody is there: no program that looks as if it worked.
    let output = run("operator", &["run", "--viewer", "off", "--router", "--connect", &free_endpoint()]);
    let text = String::from_utf8(output.stderr).unwrap();
    assert_eq!((output.status.code(), text.contains("no router answers")), (Some(1), true), "{text}");
}

#[test]
fn a_router_that_dies_or_stands_still_lets_the_hand_hold_and_it_goes_on_by_itself() {
    let certificates = Certificates::of(&["robot", "router", "ada"]);
    let mut router = router_at(&certificates, ANY_PORT, &[]);
    let robot = robot_at(&certificates, &router.endpoint);
    // It watches beside the router: over the robot's own port.
    let probe = Probe::open(&certificates.session("router", robot.endpoint()));
    let mut operator = operator_at(&certificates, &router.endpoint);
    for fault in ["killed", "stopped for 2 s"] {
        probe.wait_for(Mode::Engaged);
        probe.wait_for_motion(0.3);
        let mark = probe.mark();
        let back = match fault {
            "killed" => {
                router.process.kill();
                probe.wait_for(Mode::Holding);
                std::thread::sleep(Duration::from_millis(500));
                let endpoint = router.endpoint.clone();
                router = router_at(&certificates, &endpoint, &[]);
                now()
            }
            _ => {
                router.process.signal(Signal::Stop);
                probe.wait_for(Mode::Holding);
                std::thread::sleep(Duration::from_secs(2));
                router.process.signal(Signal::Cont);
                now()
            }
        };
        probe.wait_for(Mode::Engaged);
        let states = probe.since(mark);
        let pose = |state: &State| (state.pose_epoch, state.pose_seq);
        let holding = states.iter().position(|state| state.mode() == Some(Mode::Holding)).unwrap();
        let last = states.iter().find(|state| pose(state) == pose(&states[holding])).unwrap();
        let ticks = states[holding].tick - last.tick;
        let fresh = states.iter().find(|state| state.header.sent > back && state.follows()).unwrap();
        println!(
            "router {fault}: holding {ticks} ticks after the last pose; follows again {:.2} s after the router is back",
            fresh.header.sent.since(back).as_secs_f64()
        );
        assert!(ticks <= HELD_AFTER, "{ticks} ticks");
        let oldest = states
            .windows(2)
            .filter(|pair| pose(&pair[0]) != pose(&pair[1]) && pair[1].follows())
            .map(|pair| pair[1].header.sent.since(pair[1].pose_captured).as_secs_f64())
            .fold(0.0, f64::max);
        assert!(oldest < 0.35, "a pose {oldest} s old was obeyed");
    }
    assert_limits(&commands(&probe.states()), &HandModel::allegro_v4(HandSide::Right), RATE, RESOLUTION);
    assert!(operator.is_running());
    operator.assert_no_panic();
    robot.process.assert_no_panic();
}

#[test]
fn a_router_passes_on_only_what_those_may_do_whom_it_names() {
    let certificates = Certificates::of(&["robot", "router", "ada", "olga", "eve"]);
    let router = router_at(&certificates, ANY_PORT, &["--allow-observer", "olga"]);
    let robot = robot_at(&certificates, &router.endpoint);
    let probe = Probe::open(&certificates.session("router", robot.endpoint()));
    probe.wait_for(Mode::Disarmed);
    let connect = ["--router", "--connect", &router.endpoint];
    let ask = |name: &str, command: &str| {
        let flags = certificates.flags(name);
        run("operator", &[&[command], &connect[..], &strs(&flags)].concat())
    };
    let drive = |name: &str, more: &[&str]| {
        let mut options = certificates.flags(name);
        options.extend(more.iter().chain(&["--router"]).map(|option| (*option).to_owned()));
        Process::operator(&router.endpoint, "wave", &strs(&options))
    };
    // Neither who may only watch, nor who may nothing, nor a robot.
    for name in ["olga", "eve", "robot"] {
        let mark = probe.mark();
        let mut operator = drive(name, &[]);
        std::thread::sleep(Duration::from_secs(2));
        let states = probe.since(mark);
        assert!(states.iter().all(|state| state.holder == 0 && state.mode() == Some(Mode::Disarmed)), "{name} drives");
        operator.stop(Signal::Term);
    }
    let _ada = drive("ada", &[]);
    probe.wait_for(Mode::Engaged);
    assert_eq!(ask("eve", "stop").status.code(), Some(1));
    let list = |name| String::from_utf8(ask(name, "list").stdout).unwrap();
    assert!(list("eve").contains("no robots"), "{}", list("eve"));
    assert!(list("olga").contains("engaged"), "{}", list("olga"));
    probe.wait_for_more(20);
    assert!(probe.last().unwrap().follows());
    assert_eq!(ask("olga", "stop").status.code(), Some(0));
    probe.wait_for(Mode::Stopped);
    robot.process.assert_no_panic();
    router.process.assert_no_panic();
}

/// Both ends on `tls/` links, whose peers die again and again in the middle of everything.
fn deaths_on_tls(rounds: u32) {
    let certificates = Certificates::of(&["robot", "ada"]);
    let mut options = certificates.flags("robot");
    options.extend(["--config".to_owned()]);
    let (folder, config) = teleop_tests::process::config("[authority]\nrelease_after_s = 0.3");
    options.push(config);
    let mut robot = Robot::listening(&["tls/127.0.0.1:0", "udp/127.0.0.1:0"], &strs(&options));
    let probe = Probe::connect(&robot.endpoints[1]);
    probe.wait_for(Mode::Disarmed);
    let mut witness = Process::start(
        "operator",
        &[
            &["watch", "--json", "--timeout", "30", "--connect", &robot.endpoints[0]],
            &*strs(&certificates.flags("ada")),
        ]
        .concat(),
    );
    eventually("the watcher is there", || witness.stdout().contains("mode"));
    // In zenoh's usual threads that is a data race, which shows as an abort in one of some forty such deaths at routers.
    for process in [&robot.process, &witness] {
        let threads = process.threads();
        assert!(threads.iter().any(|name| name.starts_with("tx-")), "{threads:?}");
        assert!(!threads.iter().any(|name| name.starts_with("rx-")), "it receives in a thread of its own: {threads:?}");
    }
    for round in 0..rounds {
        let mut operator = Process::operator(&robot.endpoints[0], "wave", &strs(&certificates.flags("ada")));
        eventually("it is followed", || probe.last().is_some_and(|state| state.follows()));
        std::thread::sleep(Duration::from_millis(u64::from(round * 37 % 100)));
        operator.kill();
        assert!(robot.process.is_running(), "round {round}: the robot is gone\n{}", robot.process.stderr());
        assert!(witness.is_running(), "round {round}: the watcher is gone\n{}", witness.stderr());
    }
    robot.process.assert_no_panic();
    robot.process.stop(Signal::Term);
    drop(folder);
}

#[test]
fn peers_that_die_on_tls_links_take_nobody_along() {
    deaths_on_tls(10);
}

#[test]
#[ignore = "takes minutes: a measurement"]
fn many_peers_that_die_on_tls_links_take_nobody_along() {
    deaths_on_tls(200);
}
