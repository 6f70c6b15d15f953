//! `operator watch`: the robot's state for people and programs, without driving it.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use serde::{Serialize, Serializer};
use teleop_common::hand::Finger;
use teleop_common::mode::Mode;
use teleop_common::net::clock::now;
use teleop_common::wire::{FingerMessage, HealthMessage, JointStateMessage, MappingMessage, Rejection, Stage};

use crate::feedback::Feedback;
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
        if let Some(joints) = snapshot.joints.filter(|_| snapshot.connected) {
            heard = Some(Instant::now());
            let (mapping, health) = (snapshot.mapping.as_deref(), snapshot.health.as_deref());
            let line = if options.json {
                json_line(&joints, mapping, health, start.elapsed())
            } else {
                text_line(&options.name, &joints, mapping, health)
            };
            // Nobody reads any more: that is the end of the watch.
            if say(&line).is_err() {
                return Ok(());
            }
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

/// One line of JSON. Angles in rad, rad/s and N m in the robot's wire order, distances in m.
#[derive(Serialize)]
struct Line<'a> {
    /// Seconds since the watch began.
    t: f64,
    mode: Option<&'static str>,
    tick: u64,
    stop: u32,
    holder: String,
    q: &'a [f32],
    q_command: &'a [f32],
    dq: &'a [f32],
    tau: &'a [f32],
    #[serde(flatten)]
    mapping: Option<MappingPart>,
    #[serde(flatten)]
    health: Option<HealthPart>,
}

#[derive(Serialize)]
struct MappingPart {
    delta: ByFinger,
    k: ByFinger,
    e_q: ByFinger,
    e_c: ByFinger,
}

#[derive(Serialize)]
struct HealthPart {
    rate_hz: f32,
    tick_us_p99: f32,
    overruns: u64,
    fault: u8,
    holds: u64,
    accepted: u64,
    age_ms_p50: f32,
    age_ms_p99: f32,
    rejected: BTreeMap<String, u64>,
    telemetry_dropped: u64,
    operator: String,
    /// p50, p95, p99 and maximum of every stage and of the whole way, ms.
    latency_ms: BTreeMap<&'static str, [f32; 4]>,
}

/// Values of fingers, an object keyed by their names.
struct ByFinger(Vec<(&'static str, f32)>);

impl Serialize for ByFinger {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().copied())
    }
}

impl MappingPart {
    fn new(mapping: &MappingMessage) -> Self {
        let by_finger = |value: fn(&FingerMessage) -> f32| {
            ByFinger(mapping.fingers().iter().filter_map(|finger| Some((name(finger)?, value(finger)))).collect())
        };
        Self {
            delta: by_finger(|finger| finger.delta),
            k: by_finger(|finger| finger.k),
            e_q: by_finger(|finger| finger.e_q),
            e_c: by_finger(|finger| finger.e_c),
        }
    }
}

impl HealthPart {
    fn new(health: &HealthMessage) -> Self {
        let rejected = Rejection::ALL.map(|why| (why.name().replace(' ', "_"), health.rejected[why.index()]));
        Self {
            rate_hz: health.rate_hz,
            tick_us_p99: health.tick_us.p99,
            overruns: health.overruns,
            fault: health.fault,
            holds: health.holds,
            accepted: health.poses_accepted,
            age_ms_p50: health.age_ms.p50,
            age_ms_p99: health.age_ms.p99,
            rejected: rejected.into_iter().collect(),
            telemetry_dropped: health.telemetry_dropped,
            operator: health.operator.to_string(),
            latency_ms: Stage::ALL
                .iter()
                .map(|stage| (stage.name(), &health.stages[*stage as usize]))
                .chain([("total", &health.total_ms)])
                .map(|(name, of)| (name, [of.p50, of.p95, of.p99, of.max]))
                .collect(),
        }
    }
}

/// The state as one line of JSON, `elapsed` after the watch began.
fn json_line(
    joints: &JointStateMessage,
    mapping: Option<&MappingMessage>,
    health: Option<&HealthMessage>,
    elapsed: Duration,
) -> String {
    let count = joints.joint_count();
    let line = Line {
        t: (elapsed.as_secs_f64() * 1e6).round() / 1e6,
        mode: joints.mode().map(Mode::name),
        tick: joints.tick,
        stop: joints.stop,
        holder: format!("{:016x}", joints.holder),
        q: &joints.q[..count],
        q_command: &joints.q_command[..count],
        dq: &joints.dq[..count],
        tau: &joints.tau[..count],
        mapping: mapping.map(MappingPart::new),
        health: health.map(HealthPart::new),
    };
    // Numbers, strings and maps keyed by strings: JSON can hold them all.
    serde_json::to_string(&line).unwrap_or_default()
}

fn name(finger: &FingerMessage) -> Option<&'static str> {
    Some(Finger::ALL.get(usize::from(finger.finger))?.name())
}

/// The state as one line for people.
fn text_line(
    name: &str,
    joints: &JointStateMessage,
    mapping: Option<&MappingMessage>,
    health: Option<&HealthMessage>,
) -> String {
    let mut parts = vec![format!("robot {name}  {}", joints.mode().map_or("unknown", Mode::name))];
    if let Some(health) = health {
        let rejected: u64 = health.rejected.iter().fold(0, |sum, count| sum.saturating_add(*count));
        parts.push(format!("control {:.1} Hz", health.rate_hz));
        parts.push(format!("poses {} obeyed, {rejected} refused", health.poses_accepted));
        parts.push(format!("latency {:.1} ms p50, {:.1} ms p99", health.total_ms.p50, health.total_ms.p99));
        if !health.operator.as_str().is_empty() {
            parts.push(format!("operator {}", health.operator));
        }
        parts.push(format!("holds {}", health.holds));
    }
    if let Some(mapping) = mapping {
        let opposing = mapping.fingers().iter().filter(|finger| usize::from(finger.finger) != Finger::Thumb.index());
        let k: Vec<String> =
            opposing.filter_map(|finger| Some(format!("{} {:.2}", self::name(finger)?, finger.k))).collect();
        parts.push(format!("k {}", k.join(", ")));
    }
    parts.join("  |  ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::Value;
    use teleop_common::authority::OperatorName;
    use teleop_common::hand::{HandModel, HandSide};
    use teleop_common::mapping::{MappingParams, Retargeter};
    use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
    use teleop_common::time::MonoTime;
    use teleop_common::wire::{Echo, Header, Quantiles, REJECTIONS, STAGES, pack_joints};

    fn joints() -> JointStateMessage {
        JointStateMessage {
            header: Header::new::<JointStateMessage>(9, 1, MonoTime(0)),
            echo: Echo::NONE,
            mode: Mode::Engaged.to_wire(),
            joints: 16,
            tick: 77,
            wall_offset_ns: 0,
            pose_epoch: 0,
            pose_seq: 0,
            pose_captured: MonoTime(0),
            q: pack_joints(&[0.1; 16]),
            dq: pack_joints(&[0.0; 16]),
            tau: pack_joints(&[0.0; 16]),
            q_command: pack_joints(&[0.2; 16]),
            stop: 0,
            holder: 7,
        }
    }

    #[test]
    fn a_robot_that_was_only_just_heard_has_joints_alone() {
        let line = json_line(&joints(), None, None, Duration::from_micros(100_000));
        assert!(
            line.starts_with(
                "{\"t\":0.1,\"mode\":\"engaged\",\"tick\":77,\"stop\":0,\"holder\":\"0000000000000007\",\"q\":[0.1,"
            ),
            "{line}"
        );
        let value: Value = serde_json::from_str(&line).unwrap();
        assert_eq!(value["q_command"].as_array().unwrap().len(), 16);
        assert!(value.get("k").is_none() && value.get("rate_hz").is_none());
    }

    #[test]
    fn mapping_and_health_are_by_name() {
        let mut retargeter = Retargeter::new(HandModel::allegro_v4(HandSide::Right), MappingParams::default()).unwrap();
        let pose =
            MasterPose { q: Gesture::TapIndex.sample(2.0), geometry: MasterGeometry::PARADIGMATIC, tuning: None };
        let output = retargeter.map(&pose);
        let mapping = MappingMessage::new(Header::new::<MappingMessage>(9, 1, MonoTime(0)), 77, 0.02, 0.08, &output);
        let mut rejected = [0; REJECTIONS];
        rejected[Rejection::Operator.index()] = 5;
        let health = HealthMessage {
            header: Header::new::<HealthMessage>(9, 1, MonoTime(0)),
            mode: Mode::Engaged.to_wire(),
            fault: 0,
            ticks: 77,
            overruns: 1,
            tick_us: Quantiles::default(),
            poses_accepted: 50,
            rejected,
            holds: 2,
            age_ms: Quantiles { p50: 1.0, p95: 2.0, p99: 3.5, max: 4.0 },
            telemetry_dropped: 0,
            rate_hz: 333.3,
            operator: OperatorName::default(),
            stages: [Quantiles::default(); STAGES],
            total_ms: Quantiles::default(),
        };
        let line = json_line(&joints(), Some(&mapping), Some(&health), Duration::ZERO);
        let value: Value = serde_json::from_str(&line).unwrap();
        assert_eq!(value["k"]["index"], 1.0, "{line}");
        assert_eq!(value["k"]["ring"], 0.0, "{line}");
        assert!(value["e_c"]["index"].as_f64().unwrap() < 5e-4, "{line}");
        assert_eq!(value["rejected"]["other_operator"], 5);
        assert_eq!((value["holds"].as_u64(), value["age_ms_p99"].as_f64()), (Some(2), Some(3.5)));
    }
}
