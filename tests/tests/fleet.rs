//! Many pairs of operator and robot on one machine: what each of them costs, and how late the hands are.
//!
//! The whole tables: `cargo test --release -p teleop-tests --test fleet -- --ignored --nocapture --test-threads 1`.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::sync::{Arc, Mutex};
use std::time::Duration;

use teleop_common::mode::Mode;
use teleop_common::net::clock::now;
use teleop_common::net::{Session, SessionConfig, Stream};
use teleop_common::time::{Histogram, MonoTime};
use teleop_common::wire::{Message as _, PoseMessage, Quantiles};
use teleop_tests::eventually;
use teleop_tests::probe::Probe;
use teleop_tests::process::{Process, Robot, Router, run};

/// Clock ticks per second of /proc, the same on all Linux machines that we build for.
const USER_HZ: f64 = 100.0;

/// Links of one session at most: more robots are listed by turns, or over a router.
const MOST_LINKS: usize = 16;
/// Of each operator, Hz.
const RATE: &str = "100";

/// CPU time of a process so far, s.
fn cpu(process: &Process) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", process.id())).unwrap();
    // The name, in parentheses, may contain anything; user and system time are the 12th and 13th field after it.
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    fields[11..13].iter().map(|field| field.parse::<f64>().unwrap()).sum::<f64>() / USER_HZ
}

fn name(index: usize) -> String {
    format!("hand{index:02}")
}

/// `count` pairs for `time`, each over a link of its own or all over one router: prints a row of the table, and gives
/// what `operator list` tells of each robot.
fn fleet(count: usize, time: Duration, routed: bool) -> Vec<serde_json::Value> {
    let router = routed.then(|| Router::listening("tcp/127.0.0.1:0", &[]));
    let at = router.as_ref().map(|router| router.endpoint.as_str());
    let connect: Vec<&str> = at.iter().flat_map(|endpoint| ["--connect", *endpoint]).collect();
    let robots: Vec<Robot> =
        (0..count).map(|index| Robot::start(&[&["--name", &*name(index)], connect.as_slice()].concat())).collect();
    let through: &[&str] = if routed { &["--router"] } else { &[] };
    let operators: Vec<Process> = robots
        .iter()
        .enumerate()
        .map(|(index, robot)| {
            let name = name(index);
            let more = [&["--name", &*name, "--rate", RATE], through].concat();
            Process::operator(at.unwrap_or_else(|| robot.endpoint()), "wave", &more)
        })
        .collect();
    let list = || {
        let ask = |endpoints: &[&str]| {
            let output = run("operator", &[&["list", "--json", "--time", "1"], through, endpoints].concat());
            assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
            let lines = String::from_utf8(output.stdout).unwrap();
            lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect::<Vec<serde_json::Value>>()
        };
        if routed {
            return ask(&connect);
        }
        let links = |robots: &[Robot]| {
            ask(&robots.iter().flat_map(|robot| ["--connect", robot.endpoint()]).collect::<Vec<_>>())
        };
        robots.chunks(MOST_LINKS).flat_map(links).collect::<Vec<_>>()
    };
    let mut rows = Vec::new();
    eventually("all robots are listed and follow", || {
        rows = list();
        rows.len() == count && rows.iter().all(|row| row["mode"] == Mode::Engaged.name())
    });
    let all = || {
        let sum = |processes: &mut dyn Iterator<Item = &Process>| processes.map(cpu).sum::<f64>();
        let router = router.as_ref().map_or(0.0, |router| cpu(&router.process));
        (sum(&mut robots.iter().map(|robot| &robot.process)), sum(&mut operators.iter()), router)
    };
    let (begun, before) = (now(), all());
    std::thread::sleep(time);
    let (span, after) = (now().since(begun).as_secs_f64(), all());
    rows = list();
    let share = |time: f64| 100.0 * time / span / count as f64;
    let of = |key: &str| {
        let mut values: Vec<f64> = rows.iter().map(|row| row[key].as_f64().unwrap_or(f64::NAN)).collect();
        values.sort_by(f64::total_cmp);
        (values[values.len() / 2], values[values.len() - 1], values[0])
    };
    let (p50, p99, rate, holds) = (of("latency_ms_p50"), of("latency_ms_p99"), of("rate_hz"), of("holds"));
    println!(
        "| {count} | {:.1} | {:.1} | {:.1} | {:.2} | {:.2} | {:.1} | {:.1} | {:.0} | {:.0} |",
        share(after.0 - before.0),
        share(after.1 - before.1),
        share(after.2 - before.2),
        p50.0,
        p50.1,
        p99.0,
        p99.1,
        rate.2,
        holds.1
    );
    robots.iter().for_each(|robot| robot.process.assert_no_panic());
    operators.iter().for_each(Process::assert_no_panic);
    rows
}

fn head() {
    println!(
        "| pairs | robot, % of a core | operator | router, per pair | latency p50 ms, median | worst | p99 ms, median | worst \
         | slowest control Hz | most holds |\n|---|---|---|---|---|---|---|---|---|---|"
    );
}

#[test]
fn three_pairs_do_not_mix() {
    head();
    for routed in [false, true] {
        let rows = fleet(3, Duration::from_secs(3), routed);
        let names: Vec<_> = rows.iter().map(|row| row["robot"].as_str().unwrap().to_owned()).collect();
        assert_eq!(names, [name(0), name(1), name(2)]);
        assert!(rows.iter().all(|row| row["mode"] == Mode::Engaged.name()), "{rows:?}");
    }
}

#[test]
#[ignore = "takes minutes and a quiet machine: a measurement"]
fn table() {
    for routed in [false, true] {
        println!("{}", if routed { "over one router" } else { "each over a link of its own" });
        head();
        for count in [1, 5, 10, 20] {
            fleet(count, Duration::from_secs(15), routed);
        }
    }
}

/// From capture to the driver of a pair, beside what a bare zenoh put takes to the callback in the same 20 s: messages of
/// the same size at the same rate, sent in the same way between two sessions on this host.
#[test]
#[ignore = "needs a quiet machine: a measurement"]
fn latency_above_bare_zenoh() {
    let robot = Robot::start(&[]);
    let probe = Probe::connect(robot.endpoint());
    let _operator = Process::operator(robot.endpoint(), "wave", &["--rate", RATE]);
    probe.wait_for(Mode::Engaged);

    let there = Session::open(&SessionConfig::listening(["tcp/127.0.0.1:0"])).unwrap();
    let bare = Arc::new(Mutex::new(Histogram::default()));
    let record = Arc::clone(&bare);
    let _ear = there
        .subscribe("bare", move |arrival| {
            let sent = arrival.payload.unwrap()[..8].try_into().map(u64::from_le_bytes).unwrap();
            record.lock().unwrap().record(arrival.at.since(MonoTime(sent)));
        })
        .unwrap();
    let here = Session::open(&SessionConfig::connecting(there.locators())).unwrap();
    let publisher = here.publisher("bare", Stream::Command).unwrap();
    eventually("they are connected", || publisher.has_subscribers());
    let mut payload = [0; PoseMessage::LEN];
    for _ in 0..2000 {
        payload[..8].copy_from_slice(&now().0.to_le_bytes());
        publisher.put(&payload).unwrap();
        std::thread::sleep(Duration::from_millis(10));
    }

    let total = probe.health().unwrap().total_ms;
    let bare = Quantiles::of(&bare.lock().unwrap(), 1e-3);
    println!("| | p50 ms | p95 | p99 | max |\n|---|---|---|---|---|");
    for (what, of) in [("capture to driver", total), ("bare zenoh put to callback", bare)] {
        println!("| {what} | {:.2} | {:.2} | {:.2} | {:.2} |", of.p50, of.p95, of.p99, of.max);
    }
    println!("| above | {:.2} | {:.2} | {:.2} | |", total.p50 - bare.p50, total.p95 - bare.p95, total.p99 - bare.p99);
    println!("a control period is {:.2} ms; a pose waits for the next tick, half of that on average", 1e3 / 333.0);
}
