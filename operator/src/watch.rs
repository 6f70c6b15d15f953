//! `operator watch`: the robot's state for people and programs, without driving it.

use std::time::{Duration, Instant};

use serde_json::{Map, Value, json};
use teleop_common::hand::Finger;
use teleop_common::mode::Mode;
use teleop_common::net::clock::now;
use teleop_common::wire::{FingerMessage, Rejection};

use crate::feedback::{Feedback, Snapshot};
use crate::shutdown::Shutdown;
use crate::terminal::say;

/// Time between lines of JSON.
const JSON_EVERY: Duration = Duration::from_millis(100);
/// Time between lines for people.
const TEXT_EVERY: Duration = Duration::from_secs(1);
/// How often a robot that was not heard yet is looked for.
const LOOK_EVERY: Duration = Duration::from_millis(10);

/// The robot was not heard.
#[derive(Debug, thiserror::Error)]
#[error(
    "robot {name} was not heard for {seconds} s at {endpoints}: is it running, and are --name and --connect right?"
)]
pub struct Silent {
    /// The robot's name.
    pub name: String,
    /// Where it was expected.
    pub endpoints: String,
    /// For how long it was waited.
    pub seconds: f64,
}

/// How to watch.
#[derive(Clone, Debug)]
pub struct WatchOptions {
    /// JSON lines instead of lines for people.
    pub json: bool,
    /// When to end.
    pub duration: Option<Duration>,
    /// Silence that is an error.
    pub timeout: Duration,
    /// The robot's name, for messages.
    pub name: String,
    /// Where it should be, for messages.
    pub endpoints: String,
}

/// Watches until the time is over or the process ends, printing to standard output.
///
/// # Errors
/// [`Silent`] if the robot is not heard for [`WatchOptions::timeout`], or not at all.
pub fn watch(feedback: &Feedback, options: &WatchOptions, shutdown: &Shutdown) -> Result<(), Silent> {
    let start = Instant::now();
    let silent = |since: Instant| Silent {
        name: options.name.clone(),
        endpoints: options.endpoints.clone(),
        seconds: (since.elapsed().as_secs_f64() * 10.0).round() / 10.0,
    };
    let mut heard = None;
    let mut next = start;
    loop {
        let snapshot = feedback.snapshot(now());
        if snapshot.connected {
            heard = Some(Instant::now());
            say(&if options.json {
                json_line(&snapshot, start.elapsed())
            } else {
                text_line(&options.name, &snapshot)
            });
        } else if heard.unwrap_or(start).elapsed() >= options.timeout {
            return Err(silent(heard.unwrap_or(start)));
        }
        next = (next
            + if heard.is_none() {
                LOOK_EVERY
            } else if options.json {
                JSON_EVERY
            } else {
                TEXT_EVERY
            })
        .max(Instant::now());
        if let Some(end) = options.duration.map(|duration| start + duration) {
            if Instant::now() >= end {
                return if heard.is_some() { Ok(()) } else { Err(silent(start)) };
            }
            next = next.min(end);
        }
        if shutdown.wait(next.saturating_duration_since(Instant::now())) {
            return Ok(());
        }
    }
}

/// The state as one line of JSON, `elapsed` after the watch began.
fn json_line(robot: &Snapshot, elapsed: Duration) -> String {
    let mut line = Map::new();
    line.insert("t".to_owned(), json!((elapsed.as_secs_f64() * 1e6).round() / 1e6));
    if let Some(joints) = &robot.joints {
        let count = joints.joint_count();
        line.insert("mode".to_owned(), json!(joints.mode().map(Mode::name)));
        line.insert("tick".to_owned(), json!(joints.tick));
        for (name, values) in
            [("q", &joints.q), ("q_command", &joints.q_command), ("dq", &joints.dq), ("tau", &joints.tau)]
        {
            line.insert(name.to_owned(), json!(values[..count]));
        }
    }
    if let Some(mapping) = &robot.mapping {
        let by_finger = |value: fn(&FingerMessage) -> f32| -> Value {
            let named = |finger: &FingerMessage| Some((name(finger)?.to_owned(), json!(value(finger))));
            Value::Object(mapping.fingers().iter().filter_map(named).collect())
        };
        line.insert("delta".to_owned(), by_finger(|finger| finger.delta));
        line.insert("k".to_owned(), by_finger(|finger| finger.k));
        line.insert("e_q".to_owned(), by_finger(|finger| finger.e_q));
        line.insert("e_c".to_owned(), by_finger(|finger| finger.e_c));
    }
    if let Some(health) = &robot.health {
        let rejected: Map<String, Value> = Rejection::ALL
            .iter()
            .map(|rejection| (rejection.name().replace(' ', "_"), json!(health.rejected[rejection.index()])))
            .collect();
        line.insert("rate_hz".to_owned(), json!(health.rate_hz));
        line.insert("tick_us_p99".to_owned(), json!(health.tick_us.p99));
        line.insert("overruns".to_owned(), json!(health.overruns));
        line.insert("fault".to_owned(), json!(health.fault));
        line.insert("holds".to_owned(), json!(health.holds));
        line.insert("age_ms_p50".to_owned(), json!(health.age_ms.p50));
        line.insert("age_ms_p99".to_owned(), json!(health.age_ms.p99));
        line.insert("accepted".to_owned(), json!(health.poses_accepted));
        line.insert("rejected".to_owned(), Value::Object(rejected));
        line.insert("telemetry_dropped".to_owned(), json!(health.telemetry_dropped));
    }
    Value::Object(line).to_string()
}

fn name(finger: &FingerMessage) -> Option<&'static str> {
    Some(Finger::ALL.get(usize::from(finger.finger))?.name())
}

/// The state as one line for people.
fn text_line(name: &str, robot: &Snapshot) -> String {
    let mut parts = Vec::new();
    let mode = robot.joints.as_ref().and_then(|joints| joints.mode()).map_or("unknown", Mode::name);
    parts.push(format!("robot {name}  {mode}"));
    if let Some(health) = &robot.health {
        let rejected: u64 = health.rejected.iter().fold(0, |sum, count| sum.saturating_add(*count));
        parts.push(format!("control {:.1} Hz", health.rate_hz));
        parts.push(format!("poses {} obeyed, {rejected} refused", health.poses_accepted));
        parts.push(format!("age {:.1} ms (p99)", health.age_ms.p99));
        parts.push(format!("holds {}", health.holds));
    }
    if let Some(mapping) = &robot.mapping {
        let k: Vec<String> = mapping
            .fingers()
            .iter()
            .filter(|finger| usize::from(finger.finger) != Finger::Thumb.index())
            .filter_map(|finger| Some(format!("{} {:.2}", self::name(finger)?, finger.k)))
            .collect();
        parts.push(format!("k {}", k.join(", ")));
    }
    parts.join("  |  ")
}
