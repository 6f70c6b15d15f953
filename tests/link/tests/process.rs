//! The program as its users meet it.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::io::{BufRead as _, BufReader, Read as _};
use std::net::UdpSocket;
use std::process::{Child, ChildStdout, Command, Output, Stdio};
use std::time::Duration;

fn program() -> Command {
    Command::new(env!("CARGO_BIN_EXE_teleop-link"))
}

fn run(arguments: &str) -> Output {
    program().args(arguments.split_whitespace()).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn json(line: &str) -> serde_json::Value {
    serde_json::from_str(line).unwrap()
}

/// A running relay, and the first line it printed.
struct Running {
    child: Child,
    stdout: BufReader<ChildStdout>,
    first: String,
}

impl Running {
    fn start(arguments: &str) -> Self {
        let mut child = program().args(arguments.split_whitespace()).stdout(Stdio::piped()).spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut first = String::new();
        stdout.read_line(&mut first).unwrap();
        Self { child, stdout, first }
    }

    /// Ends it as Ctrl-C does, and gives the rest of what it printed.
    fn stop(mut self) -> String {
        let kill = format!("kill -INT {}", self.child.id());
        assert!(Command::new("sh").args(["-c", &kill]).status().unwrap().success());
        let mut rest = String::new();
        self.stdout.read_to_string(&mut rest).unwrap();
        assert_eq!(self.child.wait().unwrap().code(), Some(0));
        rest
    }
}

#[test]
fn relays_until_ctrl_c_and_says_what_it_did() {
    let server = UdpSocket::bind("127.0.0.1:0").unwrap();
    let client = UdpSocket::bind("127.0.0.1:0").unwrap();
    let target = server.local_addr().unwrap();
    let relay = Running::start(&format!("--wan good --loss 0 --stats 0 --json udp/127.0.0.1:0 udp/{target}"));
    let greeting = json(&relay.first);
    assert_eq!((greeting["profile"].as_str(), greeting["up"]["loss"].as_f64()), (Some("good"), Some(0.0)));
    let listen = greeting["listen"].as_str().unwrap().trim_start_matches("udp/").to_owned();
    server.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    for _ in 0..10 {
        client.send_to(b"hello", &listen).unwrap();
        assert_eq!(server.recv(&mut [0; 8]).unwrap(), 5);
    }
    let last = json(relay.stop().lines().last().unwrap());
    let up = &last["stats"]["up"];
    assert_eq!(
        (up["received"].as_u64(), up["forwarded"].as_u64(), up["bytes"].as_u64()),
        (Some(10), Some(10), Some(50))
    );
}

#[test]
fn tells_people_what_the_link_is() {
    let output = run("--wan fair --blackout 0..9 --duration 0.3 --stats 0.1 tcp/127.0.0.1:0 tcp/nowhere.invalid:7447");
    assert_eq!(output.status.code(), Some(0), "{}", text(&output.stderr));
    let stdout = text(&output.stdout);
    let mut lines = stdout.lines();
    let first = lines.next().unwrap();
    assert!(first.starts_with("tcp/127.0.0.1:") && first.contains("-> tcp/nowhere.invalid:7447"), "{first}");
    assert!(first.contains("fair: each way 25 ms +- 4 ms normal, loss 0.5 % in bursts of 2"), "{first}");
    assert!(lines.clone().count() >= 2, "{stdout}");
    let last = lines.next_back().unwrap();
    assert!(last.contains("dark for 0.") && last.contains("name is not known"), "{last}");
}

#[test]
fn lists_the_profiles() {
    let plain = text(&run("profiles").stdout);
    let lines = text(&run("profiles --json").stdout);
    assert_eq!(lines.lines().count(), 8);
    for line in lines.lines().map(json) {
        assert!(plain.contains(line["name"].as_str().unwrap()) && plain.contains(line["about"].as_str().unwrap()));
        assert!(line["up"]["delay_ms"].is_number() && line["down"]["loss"].is_number());
    }
}

#[test]
fn exit_codes_and_messages() {
    let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
    let taken = format!("udp/{} udp/127.0.0.1:1", taken.local_addr().unwrap());
    for (arguments, code, message) in [
        ("", 2, "<LISTEN>"),
        ("udp/127.0.0.1:0", 2, "<TARGET>"),
        ("udp/127.0.0.1:0 tcp/127.0.0.1:1", 2, "both must be"),
        ("udp/127.0.0.1:0 udp/127.0.0.1:0", 2, "port other than 0"),
        ("--loss 0.9 --burst 2 udp/127.0.0.1:0 udp/127.0.0.1:1", 2, "burst 2"),
        ("--wan awful udp/127.0.0.1:0 udp/127.0.0.1:1", 2, "satellite"),
        (taken.as_str(), 1, "in use"),
        ("udp/nowhere.invalid:0 udp/127.0.0.1:1", 1, "cannot listen on udp/nowhere.invalid:0"),
        ("--help", 0, ""),
    ] {
        let output = run(arguments);
        let stderr = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{arguments}: {stderr}");
        assert!(stderr.contains(message), "{arguments}: {stderr}");
    }
}
