//! What comes back from the robot: its state, the round trip, and why it does not move.
//!
//! The network's callbacks call [`Feedback::on_joints`] and its siblings with what arrived and when; everybody else
//! asks for a [`Snapshot`].

use std::collections::VecDeque;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use teleop_common::mode::Mode;
use teleop_common::net::Arrival;
use teleop_common::time::{ClockOffset, Histogram, MonoTime};
use teleop_common::wire::{
    Checked, Echo, HealthMessage, JointStateMessage, MappingMessage, Message, REJECTIONS, Rejection, WireError,
};

use crate::delivery::Delivery;

/// A robot that was silent for this long is not connected.
pub const SILENCE: Duration = Duration::from_millis(700);
/// An echo of something older says nothing about now.
const STALE_ECHO: Duration = Duration::from_millis(500);
/// Own send stamps that an echo may refer to: a second at the highest rate.
const SENT_STAMPS: usize = 1024;
/// A robot that has spoken another protocol for this long, and nothing else, will not speak ours.
const FOREIGN: Duration = Duration::from_secs(3);
/// How long a rejection explains why the robot holds.
const REASON_LASTS: Duration = Duration::from_secs(2);

/// The robot as last heard. Shared by the network's threads; locks are held for copies only.
#[derive(Debug)]
pub struct Feedback {
    epoch: u64,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    sent: VecDeque<u64>,
    clock: ClockOffset,
    round_trips: Histogram,
    joints: Option<Heard<JointStateMessage>>,
    mapping: Option<Heard<MappingMessage>>,
    health: Option<Heard<HealthMessage>>,
    // Counters of rejections as last seen, and which of them last rose, when.
    rejected: Option<[u64; REJECTIONS]>,
    rejection: Option<(Rejection, MonoTime)>,
    former_epoch: Option<u64>,
    rivals: Option<MonoTime>,
    delivery: Delivery,
    bad: u64,
    first_bad: Option<WireError>,
    // What another protocol said, from when to when.
    foreign: Option<(WireError, MonoTime, MonoTime)>,
}

#[derive(Clone, Copy, Debug)]
struct Heard<M> {
    message: Checked<M>,
    at: MonoTime,
}

/// The robot at one moment.
#[derive(Clone, Copy, Debug)]
pub struct Snapshot {
    /// Whether the robot was heard lately.
    pub connected: bool,
    /// Its newest joint state.
    pub joints: Option<Checked<JointStateMessage>>,
    /// When that arrived.
    pub joints_at: Option<MonoTime>,
    /// Its newest mapping signals.
    pub mapping: Option<Checked<MappingMessage>>,
    /// Its newest health.
    pub health: Option<Checked<HealthMessage>>,
    /// Newest round trip, without the time the robot held the message.
    pub round_trip: Option<Duration>,
    /// Robot's monotonic clock minus own, ns.
    pub clock_offset_ns: Option<i64>,
    /// UNIX time on the robot's clock minus own monotonic time, ns; kept while the robot is silent.
    pub picture_offset_ns: Option<i64>,
    /// Why the robot does not follow, if it does not.
    pub reason: Option<Reason>,
    /// How many of the own poses arrive.
    pub delivery: Delivery,
    /// Messages that were no valid state.
    pub bad: u64,
    /// What was wrong with the first of them.
    pub first_bad: Option<WireError>,
    /// It is there, but of a release that cannot be understood.
    pub foreign: Option<WireError>,
    /// Two robots of the same name answer.
    pub rivals: bool,
    /// What it does, and whether this operator has it; `None` if it is not connected.
    pub authority: Option<(Mode, bool)>,
}

/// Why a robot does not follow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// It has not obeyed any pose yet, nor refused one.
    NoPoses,
    /// It refuses poses.
    Refused(Rejection),
    /// Its hand or process failed, with this code.
    Fault(u8),
    /// Another operator has it.
    OtherOperator,
    /// The clutch is open.
    Clutch,
    /// The clutch was just closed, and it is on its way.
    OnItsWay,
    /// It held, and the clutch has to be closed anew.
    CloseAnew,
    /// It was stopped.
    Stopped,
}

impl std::fmt::Display for Reason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NoPoses => f.write_str("no poses arrive"),
            Self::Refused(Rejection::Operator) | Self::OtherOperator => {
                f.write_str("another operator has it (--takeover, if the robot permits it)")
            }
            Self::Clutch => f.write_str("close the clutch (SPACE)"),
            Self::OnItsWay => f.write_str("on its way"),
            Self::CloseAnew => f.write_str("close the clutch anew (SPACE)"),
            Self::Stopped => f.write_str("reset the stop (here: r)"),
            Self::Refused(rejection) => write!(f, "poses refused: {}", rejection.name()),
            Self::Fault(code) => write!(f, "fault {code}, restart the robot"),
        }
    }
}

impl Feedback {
    /// Nothing heard yet, by the operator process `epoch`.
    #[must_use]
    pub fn new(epoch: u64) -> Self {
        Self { epoch, state: Mutex::default() }
    }

    /// Remembers the stamp of a pose that goes out, so that its echo can be believed.
    pub fn on_sent(&self, sent: MonoTime) {
        let mut state = self.lock();
        if state.sent.len() == SENT_STAMPS {
            state.sent.pop_front();
        }
        state.sent.push_back(sent.0);
    }

    /// The echo that the next pose carries.
    #[must_use]
    pub fn echo(&self, now: MonoTime) -> Echo {
        self.lock()
            .joints
            .as_ref()
            .filter(|heard| now.since(heard.at) < STALE_ECHO)
            .map_or(Echo::NONE, |heard| Echo::of(&heard.message.header, heard.at))
    }

    /// Takes in a joint state.
    pub fn on_joints(&self, arrival: Arrival<'_>) {
        let now = arrival.at;
        let mut state = self.lock();
        let Some(message) = state.admit::<JointStateMessage>(arrival) else { return };
        let header = &message.header;
        if let Some(last) = state.joints.as_ref().map(|heard| heard.message.header) {
            if last.epoch == header.epoch {
                if header.seq <= last.seq {
                    return;
                }
            } else {
                // A robot that restarts does not come back with its old number; two robots alternate.
                if state.former_epoch == Some(header.epoch) {
                    state.rivals = Some(now);
                }
                state.former_epoch = Some(last.epoch);
                state.rejected = None;
                state.rejection = None;
                state.mapping = None;
                state.health = None;
            }
        }
        if let Some(exchange) = message.echo.exchange(self.epoch, header, now)
            && state.sent.binary_search(&exchange.sent.0).is_ok()
            && state.clock.update(header.epoch, exchange).is_ok()
            && let Some(estimate) = state.clock.estimate(now)
        {
            state.round_trips.record(estimate.rtt_latest);
        }
        state.joints = Some(Heard { message, at: now });
    }

    /// Takes in mapping signals.
    pub fn on_mapping(&self, arrival: Arrival<'_>) {
        let mut state = self.lock();
        if let Some(message) = state.admit::<MappingMessage>(arrival)
            && state.mapping.as_ref().is_none_or(|last| newer(&*last.message, &*message))
        {
            state.mapping = Some(Heard { message, at: arrival.at });
        }
    }

    /// Takes in a health report.
    pub fn on_health(&self, arrival: Arrival<'_>) {
        let now = arrival.at;
        let mut state = self.lock();
        let Some(message) = state.admit::<HealthMessage>(arrival) else { return };
        if state.health.as_ref().is_some_and(|last| !newer(&*last.message, &*message)) {
            return;
        }
        let rejected = message.rejected;
        if let Some(before) = state.rejected {
            // The reason that rose most.
            let rise = |rejection: &Rejection| rejected[rejection.index()].saturating_sub(before[rejection.index()]);
            if let Some(most) = Rejection::ALL.iter().max_by_key(|rejection| rise(rejection)).filter(|r| rise(r) > 0) {
                state.rejection = Some((*most, now));
            }
        }
        state.rejected = Some(rejected);
        let newest = state.joints.as_ref().map(|heard| heard.message);
        if let Some(joints) = newest.filter(|joints| [joints.pose_epoch, joints.holder] == [self.epoch; 2]) {
            let arrived = message.poses_accepted.saturating_add(rejected[Rejection::Sequence.index()]);
            state.delivery.on_counters(joints.pose_seq, arrived);
        }
        state.health = Some(Heard { message, at: now });
    }

    /// How many of the own poses arrive.
    #[must_use]
    pub fn delivery(&self) -> Delivery {
        self.lock().delivery
    }

    /// Whether the robot has received a pose sent at or after `sent`.
    #[must_use]
    pub fn has_received(&self, sent: MonoTime) -> bool {
        let state = self.lock();
        state.joints.as_ref().is_some_and(|heard| {
            let echo = heard.message.echo;
            echo.epoch == self.epoch && echo.sent >= sent
        })
    }

    /// When the robot's joint states came last, and when all that it publishes did; `None`: never.
    #[must_use]
    pub fn last_heard(&self) -> (Option<MonoTime>, Option<MonoTime>) {
        let state = self.lock();
        let Some(joints) = &state.joints else { return (None, None) };
        let health = state.health.as_ref().map(|heard| heard.at);
        // Signals of the mapping are there once poses have come.
        let mapping =
            if joints.message.pose_seq > 0 { state.mapping.as_ref().map(|heard| heard.at) } else { Some(joints.at) };
        (Some(joints.at), health.zip(mapping).map(|(health, mapping)| health.min(mapping).min(joints.at)))
    }

    /// All round trips so far.
    #[must_use]
    pub fn round_trips(&self) -> Histogram {
        self.lock().round_trips
    }

    /// The robot at `now`.
    #[must_use]
    pub fn snapshot(&self, now: MonoTime) -> Snapshot {
        let state = self.lock();
        let heard = |at: MonoTime| now.since(at) < SILENCE;
        let connected = state.joints.as_ref().is_some_and(|joints| heard(joints.at));
        let known = state.clock.estimate(now);
        let estimate = known.filter(|_| connected);
        let picture_offset_ns = known
            .zip(state.joints.as_ref())
            .map(|(known, joints)| known.offset_ns.saturating_add(joints.message.wall_offset_ns));
        Snapshot {
            connected,
            joints: state.joints.as_ref().map(|heard| heard.message),
            joints_at: state.joints.as_ref().map(|heard| heard.at),
            mapping: state.mapping.as_ref().filter(|mapping| heard(mapping.at)).map(|heard| heard.message),
            health: state.health.as_ref().map(|heard| heard.message),
            round_trip: estimate.map(|estimate| estimate.rtt_latest),
            clock_offset_ns: estimate.map(|estimate| estimate.offset_ns),
            picture_offset_ns,
            reason: state.reason(self.epoch, now),
            delivery: state.delivery,
            bad: state.bad,
            first_bad: state.first_bad,
            foreign: state
                .foreign
                .filter(|(_, from, to)| !connected && to.since(*from) > FOREIGN && heard(*to))
                .map(|(error, ..)| error),
            rivals: state.rivals.is_some_and(|at| now.since(at) < REASON_LASTS),
            authority: state
                .joints
                .as_ref()
                .filter(|_| connected)
                .and_then(|joints| Some((joints.message.mode()?, joints.message.holder == self.epoch))),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn newer<M: Message>(last: &M, new: &M) -> bool {
    let (last, new) = (last.header(), new.header());
    last.epoch != new.epoch || new.seq > last.seq
}

impl State {
    fn admit<M: Message>(&mut self, arrival: Arrival<'_>) -> Option<Checked<M>> {
        match arrival.decode::<M>() {
            Ok(message) => Some(message),
            Err(error) => {
                self.bad += 1;
                self.first_bad.get_or_insert(error);
                if matches!(error, WireError::Protocol { .. }) {
                    let known = self.foreign.filter(|(.., to)| arrival.at.since(*to) < SILENCE);
                    self.foreign = Some((error, known.map_or(arrival.at, |(_, from, _)| from), arrival.at));
                }
                None
            }
        }
    }

    fn reason(&self, epoch: u64, now: MonoTime) -> Option<Reason> {
        let joints = self.joints.as_ref()?.message;
        let rejection = self.rejection.filter(|(_, at)| now.since(*at) < REASON_LASTS).map(|(why, _)| why);
        match joints.mode()? {
            Mode::Faulted => Some(Reason::Fault(self.health.as_ref().map_or(0, |heard| heard.message.fault))),
            Mode::Stopped => Some(Reason::Stopped),
            _ if joints.holder != 0 && joints.holder != epoch => Some(Reason::OtherOperator),
            Mode::Engaged => None,
            Mode::Engaging => Some(Reason::OnItsWay),
            Mode::Armed => Some(Reason::Clutch),
            Mode::Holding | Mode::Relaxed if joints.holder == epoch && rejection.is_none() => Some(Reason::CloseAnew),
            Mode::Disarmed | Mode::Holding | Mode::Relaxed => Some(rejection.map_or(Reason::NoPoses, Reason::Refused)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use teleop_common::authority::OperatorName;
    use teleop_common::wire::{Header, MAX_MESSAGE, Quantiles, STAGES, Stamper, encode_into, pack_joints};

    const MS: u64 = 1_000_000;
    const OWN: u64 = 7;

    fn bytes<M: Message>(message: &M) -> Vec<u8> {
        let mut buffer = [0; MAX_MESSAGE];
        let length = encode_into(message, &mut buffer).unwrap();
        buffer[..length].to_vec()
    }

    fn arrival(bytes: &[u8], at: MonoTime) -> Arrival<'_> {
        Arrival { payload: Ok(bytes), at }
    }

    fn joints(header: Header, echo: Echo, mode: Mode, pose_epoch: u64) -> Vec<u8> {
        bytes(&JointStateMessage {
            header,
            echo,
            mode: mode.to_wire(),
            joints: 16,
            tick: 1,
            wall_offset_ns: 0,
            pose_epoch,
            pose_seq: 1,
            pose_captured: MonoTime(0),
            q: pack_joints(&[0.1; 16]),
            dq: pack_joints(&[0.0; 16]),
            tau: pack_joints(&[0.0; 16]),
            q_command: pack_joints(&[0.1; 16]),
            stop: 0,
            holder: pose_epoch,
        })
    }

    fn health(header: Header, fault: u8, rejected: [u64; REJECTIONS]) -> Vec<u8> {
        bytes(&HealthMessage {
            header,
            mode: Mode::Holding.to_wire(),
            fault,
            ticks: 1,
            overruns: 0,
            tick_us: Quantiles::default(),
            poses_accepted: 0,
            rejected,
            holds: 0,
            age_ms: Quantiles::default(),
            telemetry_dropped: 0,
            rate_hz: 333.0,
            operator: OperatorName::default(),
            stages: [Quantiles::default(); STAGES],
            total_ms: Quantiles::default(),
        })
    }

    #[test]
    fn the_round_trip_excludes_the_time_the_robot_held_the_message() {
        let feedback = Feedback::new(OWN);
        // The robot's clock is 1000 s ahead; 2 ms there, held 5 ms, 2 ms back.
        let ahead = 1_000_000 * MS;
        feedback.on_sent(MonoTime(100 * MS));
        let echo = Echo { epoch: OWN, sent: MonoTime(100 * MS), received: MonoTime(ahead + 102 * MS) };
        let header = Stamper::new(9).header::<JointStateMessage>(MonoTime(ahead + 107 * MS));
        feedback.on_joints(arrival(&joints(header, echo, Mode::Engaged, OWN), MonoTime(109 * MS)));
        let snapshot = feedback.snapshot(MonoTime(110 * MS));
        assert_eq!(snapshot.round_trip, Some(Duration::from_millis(4)));
        assert_eq!(snapshot.clock_offset_ns, Some(ahead as i64));
        assert_eq!((snapshot.connected, snapshot.reason), (true, None));
        assert!(feedback.has_received(MonoTime(100 * MS)) && !feedback.has_received(MonoTime(101 * MS)));
        assert_eq!(feedback.echo(MonoTime(110 * MS)).sent, header.sent);
        // Silence: not connected, and nothing to echo.
        let late = MonoTime(1000 * MS);
        assert!(!feedback.snapshot(late).connected);
        assert_eq!(feedback.echo(late), Echo::NONE);
    }

    #[test]
    fn an_echo_of_a_stamp_never_sent_is_not_believed() {
        let feedback = Feedback::new(OWN);
        feedback.on_sent(MonoTime(100 * MS));
        let echo = Echo { epoch: OWN, sent: MonoTime(99 * MS), received: MonoTime(102 * MS) };
        let header = Stamper::new(9).header::<JointStateMessage>(MonoTime(103 * MS));
        feedback.on_joints(arrival(&joints(header, echo, Mode::Disarmed, 0), MonoTime(104 * MS)));
        assert_eq!(feedback.snapshot(MonoTime(104 * MS)).round_trip, None);
    }

    #[test]
    fn it_says_why_the_robot_does_not_follow() {
        let feedback = Feedback::new(OWN);
        let mut stamper = Stamper::new(9);
        let mut tell = |mode, pose_epoch, at: u64| {
            let header = stamper.header::<JointStateMessage>(MonoTime(at));
            feedback.on_joints(arrival(&joints(header, Echo::NONE, mode, pose_epoch), MonoTime(at)));
            feedback.snapshot(MonoTime(at)).reason
        };
        assert_eq!(tell(Mode::Disarmed, 0, MS), Some(Reason::NoPoses));
        assert_eq!(tell(Mode::Engaged, 8, 2 * MS), Some(Reason::OtherOperator));
        let mut stamps = Stamper::new(9);
        let mut rejected = [3; REJECTIONS];
        feedback
            .on_health(arrival(&health(stamps.header::<HealthMessage>(MonoTime(0)), 0, rejected), MonoTime(2 * MS)));
        assert_eq!(tell(Mode::Holding, OWN, 3 * MS), Some(Reason::CloseAnew), "old refusals explain nothing");
        assert_eq!(tell(Mode::Armed, OWN, 3 * MS + 1), Some(Reason::Clutch));
        assert_eq!(tell(Mode::Stopped, 8, 3 * MS + 2), Some(Reason::Stopped));
        rejected[Rejection::Stale.index()] += 10;
        rejected[Rejection::Clock.index()] += 2;
        feedback
            .on_health(arrival(&health(stamps.header::<HealthMessage>(MonoTime(0)), 4, rejected), MonoTime(4 * MS)));
        assert_eq!(tell(Mode::Holding, OWN, 5 * MS), Some(Reason::Refused(Rejection::Stale)));
        assert_eq!(tell(Mode::Faulted, OWN, 6 * MS), Some(Reason::Fault(4)));
        assert_eq!(tell(Mode::Holding, 0, 3000 * MS), Some(Reason::NoPoses));
    }

    #[test]
    fn garbage_is_counted_and_old_states_are_passed_over() {
        let feedback = Feedback::new(OWN);
        feedback.on_joints(arrival(b"hello", MonoTime(0)));
        feedback.on_mapping(arrival(&[0; 500], MonoTime(0)));
        let snapshot = feedback.snapshot(MonoTime(0));
        assert_eq!((snapshot.bad, snapshot.connected), (2, false));
        assert_eq!(snapshot.first_bad, Some(WireError::TooShort { found: 5 }));

        let state =
            |epoch, seq, mode| joints(Header::new::<JointStateMessage>(epoch, seq, MonoTime(0)), Echo::NONE, mode, 0);
        let mode = || feedback.snapshot(MonoTime(0)).joints.unwrap().mode();
        feedback.on_joints(arrival(&state(1, 5, Mode::Disarmed), MonoTime(0)));
        feedback.on_joints(arrival(&state(1, 4, Mode::Holding), MonoTime(0)));
        assert_eq!(mode(), Some(Mode::Disarmed));
        feedback.on_joints(arrival(&state(2, 1, Mode::Holding), MonoTime(0)));
        assert_eq!(mode(), Some(Mode::Holding), "a robot that restarted");
        assert!(!feedback.snapshot(MonoTime(0)).rivals);
        feedback.on_joints(arrival(&state(1, 6, Mode::Disarmed), MonoTime(0)));
        assert!(feedback.snapshot(MonoTime(0)).rivals, "two robots");
    }
}
