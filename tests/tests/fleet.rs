//! Many pairs of operator and robot on one machine: what each of them costs, and how late the hands are.
//!
//! The whole table: `cargo test --release -p teleop-tests --test fleet -- --ignored --nocapture`.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::time::Duration;

use teleop_common::mode::Mode;
use teleop_common::net::clock::now;
use teleop_tests::eventually;
use teleop_tests::process::{Process, Robot, run};

/// Clock ticks per second of /proc, the same on all Linux machines that we build for.
const USER_HZ: f64 = 100.0;

/// Links of one session at most: more robots are listed by turns, or over a router.
const MOST_LINKS: usize = 16;

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

/// `count` pairs for `time`: prints a row of the table, and gives what `operator list` tells of each robot.
fn fleet(count: usize, time: Duration) -> Vec<serde_json::Value> {
    let robots: Vec<Robot> = (0..count).map(|index| Robot::start(&["--name", &name(index)])).collect();
    let operators: Vec<Process> = robots
        .iter()
        .enumerate()
        .map(|(index, robot)| Process::operator(robot.endpoint(), "wave", &["--name", &name(index), "--rate", "100"]))
        .collect();
    let list = || {
        let ask = |robots: &[Robot]| {
            let endpoints: Vec<&str> = robots.iter().flat_map(|robot| ["--connect", robot.endpoint()]).collect();
            let output = run("operator", &[&["list", "--json", "--time", "1"], endpoints.as_slice()].concat());
            assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
            let lines = String::from_utf8(output.stdout).unwrap();
            lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect::<Vec<serde_json::Value>>()
        };
        robots.chunks(MOST_LINKS).flat_map(ask).collect::<Vec<_>>()
    };
    let mut rows = Vec::new();
    eventually("all robots are listed and follow", || {
        rows = list();
        rows.len() == count && rows.iter().all(|row| row["mode"] == Mode::Engaged.name())
    });
    let all = || {
        let sum = |processes: &mut dyn Iterator<Item = &Process>| processes.map(cpu).sum::<f64>();
        (sum(&mut robots.iter().map(|robot| &robot.process)), sum(&mut operators.iter()))
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
        "| {count} | {:.1} | {:.1} | {:.2} | {:.2} | {:.1} | {:.1} | {:.0} | {:.0} |",
        share(after.0 - before.0),
        share(after.1 - before.1),
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
        "| pairs | robot, % of a core | operator, % of a core | latency p50 ms, median | worst | p99 ms, median | worst \
         | slowest control Hz | most holds |\n|---|---|---|---|---|---|---|---|---|"
    );
}

#[test]
fn three_pairs_do_not_mix() {
    head();
    let rows = fleet(3, Duration::from_secs(3));
    let names: Vec<_> = rows.iter().map(|row| row["robot"].as_str().unwrap().to_owned()).collect();
    assert_eq!(names, [name(0), name(1), name(2)]);
    assert!(rows.iter().all(|row| row["mode"] == Mode::Engaged.name()), "{rows:?}");
}

#[test]
#[ignore = "takes minutes and a quiet machine: a measurement"]
fn table() {
    head();
    for count in [1, 5, 10, 20] {
        fleet(count, Duration::from_secs(15));
    }
}
