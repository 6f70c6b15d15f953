//! From the control loop to the world: publishes state, mapping and health, and feeds the viewer.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use teleop_common::hand::HandModel;
use teleop_common::key::Keys;
use teleop_common::mapping::MappingParams;
use teleop_common::mode::Mode;
use teleop_common::net::{NetError, Publisher, Session, Stream, clock};
use teleop_common::time::{Histogram, MonoTime};
use teleop_common::viz::{Level, Logger, RobotFrame};
use teleop_common::wire::{
    HealthMessage, JointStateMessage, MappingMessage, PROTOCOL, Quantiles, REJECTIONS, Rejection, STAGES, Stage,
    Stamper, latency_report, pack_joints,
};

use crate::control::Fault;
use crate::receive::Receiver;
use crate::runtime::LoopRecord;

/// How often joint states and mapping signals go out, at most.
const STATE_PERIOD: Duration = Duration::from_millis(10);
const HEALTH_PERIOD: Duration = Duration::from_millis(200);
/// How often the viewer gets a frame.
const VIEW_PERIOD: Duration = Duration::from_millis(10);

/// Turns the control loop's records into messages and frames. Owned by one thread.
pub struct Telemetry {
    receiver: Arc<Mutex<Receiver>>,
    joints: (Publisher, Stamper),
    mapping: (Publisher, Stamper),
    health: (Publisher, Stamper),
    logger: Logger,
    params: MappingParams,
    joint_count: u8,
    next_state: MonoTime,
    next_health: MonoTime,
    next_view: MonoTime,
    mode: Option<Mode>,
    // Told that an operator speaks another version.
    told_version: bool,
    // Counters at the last change of mode.
    rejected: [u64; REJECTIONS],
    tick_times: Histogram,
    stages: [Histogram; STAGES],
    total: Histogram,
    // Epoch and sequence of the newest pose in them.
    staged: Option<(u64, u64)>,
    slowest: Duration,
    // Tick number and time of the last health message, for the measured rate.
    rate_mark: Option<(u64, MonoTime)>,
}

impl Telemetry {
    /// Declares the publishers.
    ///
    /// # Errors
    /// The session is closed.
    pub fn new(
        session: &Session,
        keys: &Keys,
        epoch: u64,
        receiver: Arc<Mutex<Receiver>>,
        logger: Logger,
        hand: &HandModel,
        params: MappingParams,
    ) -> Result<Self, NetError> {
        let publisher =
            |key: &str, stream| session.publisher(key, stream).map(|publisher| (publisher, Stamper::new(epoch)));
        Ok(Self {
            receiver,
            joints: publisher(&keys.joints(), Stream::State)?,
            mapping: publisher(&keys.mapping(), Stream::State)?,
            health: publisher(&keys.health(), Stream::Slow)?,
            logger,
            params,
            joint_count: u8::try_from(hand.joints.len()).unwrap_or(u8::MAX),
            next_state: MonoTime(0),
            next_health: MonoTime(0),
            next_view: MonoTime(0),
            mode: None,
            told_version: false,
            rejected: [0; REJECTIONS],
            tick_times: Histogram::default(),
            stages: [Histogram::default(); STAGES],
            total: Histogram::default(),
            staged: None,
            slowest: Duration::ZERO,
            rate_mark: None,
        })
    }

    /// Takes one record; `dropped` records were lost so far.
    pub fn on_record(&mut self, record: &LoopRecord, dropped: u64) {
        self.tick_times.record(record.busy);
        self.slowest = self.slowest.max(record.busy);
        self.measure_stages(record);
        let now = record.record.now;
        if self.mode != Some(record.record.mode) {
            self.tell_mode(record);
            // Whoever watches learns of a new mode at once.
            self.next_state = now;
            self.next_health = now;
        }
        if now >= self.next_state {
            self.next_state = now + STATE_PERIOD;
            self.publish_state(record);
        }
        if now >= self.next_health {
            self.next_health = now + HEALTH_PERIOD;
            self.publish_health(record, dropped);
        }
        if self.logger.enabled() && now >= self.next_view {
            self.next_view = now + VIEW_PERIOD;
            self.view(record);
        }
    }

    fn publish_state(&mut self, record: &LoopRecord) {
        let tick = &record.record;
        let sample = tick.sample.as_ref();
        let (echo, holder) = {
            let receiver = self.receiver.lock().unwrap_or_else(PoisonError::into_inner);
            (receiver.echo(), receiver.holder(clock::now()))
        };
        let message = JointStateMessage {
            header: self.joints.1.header::<JointStateMessage>(clock::now()),
            echo,
            mode: tick.mode.to_wire(),
            joints: self.joint_count,
            tick: tick.tick,
            wall_offset_ns: clock::wall_offset_ns(),
            pose_epoch: sample.map_or(0, |sample| sample.epoch),
            pose_seq: sample.map_or(0, |sample| sample.sequence),
            pose_captured: sample.map_or(MonoTime(0), |sample| sample.captured_remote),
            q: pack_joints(&tick.state.q),
            dq: pack_joints(&tick.state.dq),
            tau: pack_joints(&tick.state.tau),
            q_command: pack_joints(&tick.command.q),
            stop: tick.latch.asked,
            holder: holder.map_or(0, |(epoch, _)| epoch),
        };
        told_once(self.joints.0.send(&message));
        if let Some(mapping) = &tick.mapping {
            let header = self.mapping.1.header::<MappingMessage>(clock::now());
            let tuning = self.params.tuned(sample.and_then(|sample| sample.pose.tuning.as_ref()));
            let message = MappingMessage::new(header, tick.tick, tuning.r1, tuning.r2, mapping);
            told_once(self.mapping.0.send(&message));
        }
    }

    fn publish_health(&mut self, record: &LoopRecord, dropped: u64) {
        let tick = &record.record;
        let rate = self.rate_mark.map_or(0.0, |(ticks, at)| {
            let seconds = tick.now.since(at).as_secs_f64();
            if seconds > 0.0 { (tick.tick - ticks) as f64 / seconds } else { 0.0 }
        });
        self.rate_mark = Some((tick.tick, tick.now));
        let (counts, holder) = {
            let receiver = self.receiver.lock().unwrap_or_else(PoisonError::into_inner);
            (receiver.counts().clone(), receiver.holder(clock::now()))
        };
        if counts.rejected[Rejection::Protocol.index()] > 0 && !std::mem::replace(&mut self.told_version, true) {
            let text = format!("poses of another wire protocol than {PROTOCOL}: run the same release on both ends");
            tracing::error!("{text}");
            self.logger.log_text(wall(tick.now), Level::Error, &text);
        }
        let message = HealthMessage {
            header: self.health.1.header::<HealthMessage>(clock::now()),
            mode: tick.mode.to_wire(),
            fault: tick.fault as u8,
            ticks: tick.tick,
            overruns: record.overruns,
            tick_us: Quantiles::of(&self.tick_times, 1e-6),
            poses_accepted: counts.accepted,
            rejected: counts.rejected,
            holds: tick.holds,
            age_ms: Quantiles::of(&counts.age, 1e-3),
            telemetry_dropped: dropped,
            rate_hz: rate as f32,
            operator: holder.map(|(_, name)| name).unwrap_or_default(),
            stages: self.stages.each_ref().map(|stage| Quantiles::of(stage, 1e-3)),
            total_ms: Quantiles::of(&self.total, 1e-3),
        };
        told_once(self.health.0.send(&message));
    }

    /// Counts how long the pose that this tick was the first to use was on its way.
    fn measure_stages(&mut self, record: &LoopRecord) {
        let Some(sample) = record.record.sample.as_ref() else { return };
        let key = Some((sample.epoch, sample.sequence));
        if self.staged == key {
            return;
        }
        self.staged = key;
        let stamps = [sample.captured, sample.sent, sample.received, record.record.now, record.written];
        for (stage, pair) in Stage::ALL.into_iter().zip(stamps.windows(2)) {
            self.stages[stage as usize].record(pair[1].since(pair[0]));
        }
        self.total.record(record.written.since(sample.captured));
    }

    /// Where the time goes from the human hand to the robot hand, for people; `None` if no pose was obeyed.
    #[must_use]
    pub fn latency_report(&self) -> Option<String> {
        let ms = |histogram| Quantiles::of(histogram, 1e-3);
        (self.total.count() > 0).then(|| latency_report(&self.stages.each_ref().map(ms), &ms(&self.total)))
    }

    fn view(&mut self, record: &LoopRecord) {
        let tick = &record.record;
        self.logger.log_robot(RobotFrame {
            time: wall(tick.now),
            q: tick.state.q,
            dq: tick.state.dq,
            q_command: tick.command.q,
            mapping: tick.mapping,
            mode: tick.mode,
            pose_age: tick.played.map(|captured| tick.now.since(captured).as_secs_f64()),
            tick: Some(self.slowest.as_secs_f64()),
        });
        self.slowest = Duration::ZERO;
    }

    /// Poses refused since the last change of mode, in words.
    fn refusals(&mut self) -> String {
        let rejected = self.receiver.lock().unwrap_or_else(PoisonError::into_inner).counts().rejected;
        let before = std::mem::replace(&mut self.rejected, rejected);
        let risen = Rejection::ALL.iter().filter_map(|reason| {
            let count = rejected[reason.index()] - before[reason.index()];
            (count > 0).then(|| format!("{count} {}", reason.name()))
        });
        let risen: Vec<_> = risen.collect();
        if risen.is_empty() { String::new() } else { format!(", refused: {}", risen.join(", ")) }
    }

    /// A change of mode, in the log and in the viewer.
    fn tell_mode(&mut self, record: &LoopRecord) {
        let tick = &record.record;
        self.mode = Some(tick.mode);
        let (level, text) = match tick.mode {
            Mode::Disarmed => (Level::Info, "disarmed: no operator has the robot".to_owned()),
            Mode::Armed => {
                let name = tick.sample.map(|sample| sample.intent.operator).unwrap_or_default();
                let operator = tick.sample.map_or(0, |sample| sample.epoch);
                (Level::Info, format!("armed: operator {name} ({operator:016x}) has the robot, its clutch is open"))
            }
            Mode::Engaging => (Level::Info, "engaging: the clutch is closed".to_owned()),
            Mode::Engaged => {
                self.refusals();
                (Level::Info, "engaged: following the operator".to_owned())
            }
            Mode::Holding => (Level::Warn, format!("holding: no fresh pose{}", self.refusals())),
            Mode::Relaxed => (Level::Warn, "relaxed: the hold lasts".to_owned()),
            Mode::Stopped => (Level::Warn, format!("stopped: stop {} is in force until it is reset", tick.latch.asked)),
            Mode::Faulted => {
                let why = match (tick.fault, record.driver_error) {
                    (Fault::Driver, Some(error)) => error.to_string(),
                    (fault, _) => format!("{fault:?}"),
                };
                (Level::Error, format!("faulted: the hand is off until a restart: {why}"))
            }
        };
        match level {
            Level::Info => tracing::info!("{text}"),
            Level::Warn => tracing::warn!("{text}"),
            Level::Error => tracing::error!("{text}"),
        }
        self.logger.log_text(wall(tick.now), level, &text);
    }
}

/// A time of the monotonic clock as ns since the UNIX epoch.
fn wall(time: MonoTime) -> i64 {
    i64::try_from(time.0).unwrap_or(i64::MAX).saturating_add(clock::wall_offset_ns())
}

/// A message that cannot be sent is a fault of this program or the end of the session: worth a line, not a stop.
fn told_once(result: Result<(), NetError>) {
    static TOLD: std::sync::Once = std::sync::Once::new();
    if let Err(error) = result {
        TOLD.call_once(|| tracing::error!("state is not published: {error}"));
    }
}
