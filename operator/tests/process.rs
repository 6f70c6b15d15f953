//! The binary: exit codes, signals, and what a kill leaves behind.
#![allow(clippy::unwrap_used, reason = "test helpers")]

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use teleop_common::recording::{LastLine, RecordingReader};

/// An endpoint where nobody answers: the discard port.
const NOBODY: &str = "tcp/127.0.0.1:9";

fn operator(arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_operator"));
    command.args(arguments.split_whitespace()).env_remove("RUST_LOG");
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn output(arguments: &str) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } = operator(arguments).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

fn temporary(name: &str) -> PathBuf {
    Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{}-{name}", std::process::id()))
}

fn wait_until(mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < Duration::from_secs(30), "waited in vain");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Starts streaming to nobody into a recording, and waits until it has some lines.
fn start_recording(file: &Path) -> Child {
    let child = operator(&format!("--viewer off --connect {NOBODY} --record {}", file.display())).spawn().unwrap();
    wait_until(|| std::fs::read(file).is_ok_and(|bytes| bytes.iter().filter(|byte| **byte == b'\n').count() > 30));
    child
}

#[test]
fn help_lists_and_exit_codes() {
    let (code, out, _) = output("--help");
    assert_eq!(code, Some(0));
    for part in ["Examples:", "in/hand", "Exit codes:", "tcp/127.0.0.1:7447", "[default: 100]"] {
        assert!(out.contains(part), "{part} is missing in\n{out}");
    }
    let (code, out, _) = output("gestures");
    assert_eq!((code, out.lines().count()), (Some(0), teleop_common::master::Gesture::ALL.len()));

    for (arguments, expected, part) in [
        ("--source jazz", 2, "known are open, tap_index"),
        ("--sourc tour", 2, "--source"),
        ("--log a=b=c", 2, "a=b=c"),
        ("calibrate --source fist --output x.toml", 2, "no keypoints"),
        ("watch --timeout 0.2 --connect tcp/127.0.0.1:9", 1, "was not heard for"),
    ] {
        let (code, _, err) = output(arguments);
        assert_eq!(code, Some(expected), "{arguments}: {err}");
        assert!(err.contains(part), "{arguments}: {err}");
    }
    let (code, out, _) = output(&format!("--viewer off --connect {NOBODY} --duration 1.5"));
    assert_eq!(code, Some(0));
    assert!(out.contains("not connected") && out.contains("no echo from the robot"), "{out}");
}

#[test]
fn a_kill_leaves_a_recording_that_can_be_read() {
    let file = temporary("killed.jsonl");
    let mut child = start_recording(&file);
    child.kill().unwrap();
    child.wait().unwrap();
    let bytes = std::fs::read(&file).unwrap();
    let frames = RecordingReader::new(bytes.as_slice(), LastLine::MayBeCut).unwrap().map(Result::unwrap).count();
    assert!(frames >= 29, "{frames} frames");
    std::fs::remove_file(&file).unwrap();
}

#[test]
fn a_signal_ends_it_in_order_and_soon() {
    for signal in ["TERM", "INT"] {
        let file = temporary(&format!("{signal}.jsonl"));
        let child = start_recording(&file);
        let asked = Instant::now();
        assert!(Command::new("kill").args(["-s", signal, &child.id().to_string()]).status().unwrap().success());
        let Output { status, stdout, .. } = child.wait_with_output().unwrap();
        assert!(asked.elapsed() < Duration::from_secs(2), "{signal}: {:?}", asked.elapsed());
        assert_eq!(status.code(), Some(0), "{signal}");
        let bytes = std::fs::read(&file).unwrap();
        let frames = RecordingReader::new(bytes.as_slice(), LastLine::Whole).unwrap().map(Result::unwrap).count();
        let summary = String::from_utf8(stdout).unwrap();
        assert!(summary.contains(&format!("recorded {frames} frames")), "{frames} frames; {summary}");
        std::fs::remove_file(&file).unwrap();
    }
}
