//! From the network to the control loop: decodes poses, judges them, and hands the good ones on; stops
//! and resets go to the latch.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use teleop_common::authority::{Claim, Lease, LeaseParams, OperatorName};
use teleop_common::key::Keys;
use teleop_common::net::{Arrival, NetError, Session, Subscriber, clock};
use teleop_common::time::{ClockOffset, Histogram, MonoTime};
use teleop_common::wire::{Checked, ControlMessage, Echo, PoseMessage, REJECTIONS, Rejection, Request};

use crate::control::PoseSample;
use crate::runtime::Shared;

/// Operators whose clocks are known at the same time: the one that drives and others that try to.
const CLOCKS: usize = 4;

/// What is older than the newest pose by no more than this was doubled or overtaken on the way.
const OVERTAKEN: Duration = Duration::from_secs(1);

/// Judges arriving poses. Lives behind a mutex on the network's side; the control thread never touches it.
pub struct Receiver {
    epoch: u64,
    lease: Lease,
    shared: Arc<Shared>,
    clocks: [ClockOffset; CLOCKS],
    next_clock: usize,
    poses: rtrb::Producer<PoseSample>,
    echo: Echo,
    operator: OperatorName,
    counts: Counts,
    heard: Option<MonoTime>,
}

/// What became of the poses so far.
#[derive(Clone, Debug, Default)]
pub struct Counts {
    /// Poses passed on to the control loop.
    pub accepted: u64,
    /// Poses refused, by reason.
    pub rejected: [u64; REJECTIONS],
    /// Age of the accepted ones on arrival, since capture.
    pub age: Histogram,
}

impl Receiver {
    /// A receiver of the process `epoch` that hands good poses on to `poses`.
    #[must_use]
    pub fn new(epoch: u64, params: LeaseParams, poses: rtrb::Producer<PoseSample>, shared: Arc<Shared>) -> Self {
        Self {
            epoch,
            lease: Lease::new(params),
            shared,
            clocks: std::array::from_fn(|_| ClockOffset::default()),
            next_clock: 0,
            poses,
            echo: Echo::NONE,
            operator: OperatorName::default(),
            counts: Counts::default(),
            heard: None,
        }
    }

    /// When something last came on the pose key.
    #[must_use]
    pub fn heard(&self) -> Option<MonoTime> {
        self.heard
    }

    /// What became of the poses so far.
    #[must_use]
    pub fn counts(&self) -> &Counts {
        &self.counts
    }

    /// The echo of the newest pose of the operator that drives, or may.
    #[must_use]
    pub fn echo(&self) -> Echo {
        self.echo
    }

    /// The operator that has the robot at `now`: its epoch and its name.
    #[must_use]
    pub fn holder(&self, now: MonoTime) -> Option<(u64, OperatorName)> {
        self.lease.holder(now).map(|epoch| (epoch, self.operator))
    }

    /// Takes what arrived on the key of stops: from anybody and however old, to hold still is never wrong.
    pub fn on_stop(&mut self, arrival: Arrival<'_>) {
        let Ok(message) = arrival.decode::<ControlMessage>() else { return };
        if message.request() == Some(Request::Stop) && self.shared.latch.stop() {
            tracing::warn!("stop: asked for over the network");
        }
    }

    /// Takes what arrived on the key of resets, where only who may drive can write.
    pub fn on_reset(&mut self, arrival: Arrival<'_>) {
        let Ok(message) = arrival.decode::<ControlMessage>() else { return };
        let meant = message.robot == self.epoch && self.lease.holder(arrival.at) == Some(message.header.epoch);
        if let Some(Request::Reset { stop }) = message.request()
            && meant
            && self.shared.latch.reset(stop)
        {
            tracing::warn!("stop {stop}: reset by the operator {:?}", self.operator.as_str());
        }
    }

    /// Takes what arrived on the pose key.
    pub fn on_pose(&mut self, arrival: Arrival<'_>) {
        self.heard = Some(arrival.at);
        let result = match arrival.decode::<PoseMessage>() {
            Ok(message) => self.judge(&message, arrival.at),
            Err(error) => Err(Rejection::from(&error)),
        };
        match result {
            Ok(sample) => {
                self.counts.accepted += 1;
                self.counts.age.record(sample.received.since(sample.captured));
                // Full: the control thread stands still, and will have newer ones when it runs again.
                self.poses.push(sample).ok();
            }
            Err(rejection) => self.counts.rejected[rejection.index()] += 1,
        }
    }

    fn judge(&mut self, message: &Checked<PoseMessage>, now: MonoTime) -> Result<PoseSample, Rejection> {
        let header = &message.header;
        let intent = message.intent();
        // A copy, or what was overtaken, would make the round trip look longer than it is.
        // Only just so: a false stamp of the far future must not silence the true ones.
        let same = self.echo.epoch == header.epoch && header.sent <= self.echo.sent;
        let newer = !same || self.echo.sent.since(header.sent) > OVERTAKEN;
        if self.lease.is_open_to(now, header.epoch) {
            if newer {
                self.echo = Echo::of(header, now);
            }
        } else if !intent.takeover {
            return Err(Rejection::Operator);
        }
        let own_epoch = self.epoch;
        let holder = self.lease.holder(now);
        let clock = self.clock(header.epoch, holder);
        if let Some(exchange) = message.echo.exchange(own_epoch, header, now).filter(|_| newer) {
            // An exchange that makes no sense leaves the estimate as it was.
            clock.update(header.epoch, exchange).ok();
        }
        let known = clock.peer_epoch() == Some(header.epoch);
        let estimate = if known { clock.estimate(now) } else { None };
        let captured = if known { clock.to_own(now, message.captured) } else { None };
        let sent = if known { clock.to_own(now, header.sent) } else { None };
        let age = if known { clock.age(now, message.captured) } else { None };
        let age = age.zip(estimate).map(|(age, known)| (age as f64 * 1e-9, known.uncertainty.as_secs_f64()));
        let claim = Claim {
            epoch: header.epoch,
            sequence: header.seq,
            age,
            takeover: intent.takeover,
            leaving: intent.leaving,
        };
        self.lease.admit(now, &claim, self.shared.mode().follows())?;
        self.operator = intent.operator;
        Ok(PoseSample {
            pose: message.pose(),
            intent,
            epoch: header.epoch,
            sequence: header.seq,
            captured_remote: message.captured,
            captured: captured.unwrap_or(now),
            sent: sent.unwrap_or(now),
            received: now,
        })
    }

    /// The clock of an operator; an unknown one gets the place of the one that came longest ago, but never that of the
    /// operator that has the robot.
    fn clock(&mut self, epoch: u64, holder: Option<u64>) -> &mut ClockOffset {
        let known = self.clocks.iter().position(|clock| clock.peer_epoch() == Some(epoch));
        let place = known.unwrap_or_else(|| {
            let mut place = self.next_clock;
            if holder.is_some() && self.clocks[place].peer_epoch() == holder {
                place = (place + 1) % CLOCKS;
            }
            self.next_clock = (place + 1) % CLOCKS;
            self.clocks[place].reset();
            place
        });
        &mut self.clocks[place]
    }
}

/// How long nothing may come before the subscription is declared anew.
const RENEW_EVERY: Duration = Duration::from_millis(500);

/// The subscriptions that feed a [`Receiver`].
///
/// On a link that does not resend (plain UDP) the message that says "I subscribe to this" can get lost, and then no pose
/// ever comes. So while none comes, the subscription is declared anew.
pub struct PoseSubscription {
    session: Session,
    keys: Keys,
    receiver: Arc<Mutex<Receiver>>,
    subscribers: Option<[Subscriber; 3]>,
    declared: MonoTime,
}

impl PoseSubscription {
    /// Subscribes.
    ///
    /// # Errors
    /// The session is closed.
    pub fn new(session: &Session, keys: &Keys, receiver: Arc<Mutex<Receiver>>) -> Result<Self, NetError> {
        let mut this =
            Self { session: session.clone(), keys: keys.clone(), receiver, subscribers: None, declared: clock::now() };
        this.declare()?;
        Ok(this)
    }

    /// Declares the subscription anew if nothing has come for a while; to be called often.
    ///
    /// # Errors
    /// The session is closed.
    pub fn refresh(&mut self, now: MonoTime) -> Result<(), NetError> {
        if now.since(self.declared) < RENEW_EVERY {
            return Ok(());
        }
        self.declared = now;
        let heard = self.receiver.lock().unwrap_or_else(PoisonError::into_inner).heard();
        if heard.is_some_and(|at| now.since(at) < RENEW_EVERY) { Ok(()) } else { self.declare() }
    }

    fn declare(&mut self) -> Result<(), NetError> {
        // The old one goes first, so that operators are told of a new one.
        drop(self.subscribers.take());
        let subscribe = |key: &str, take: fn(&mut Receiver, Arrival<'_>)| {
            let receiver = Arc::clone(&self.receiver);
            self.session.subscribe(key, move |arrival| {
                take(&mut receiver.lock().unwrap_or_else(PoisonError::into_inner), arrival);
            })
        };
        self.subscribers = Some([
            subscribe(&self.keys.pose(), Receiver::on_pose)?,
            subscribe(&self.keys.stop(), Receiver::on_stop)?,
            subscribe(&self.keys.reset(), Receiver::on_reset)?,
        ]);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use teleop_common::authority::{Intent, Takeover};
    use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
    use teleop_common::wire::{Header, MAX_MESSAGE, encode_into};

    use super::*;

    const MS: u64 = 1_000_000;
    const ROBOT: u64 = 1;
    // The operator's clock is an hour ahead.
    const AHEAD: u64 = 3_600_000 * MS;

    fn receiver() -> (Receiver, rtrb::Consumer<PoseSample>) {
        let params = LeaseParams {
            max_age: Duration::from_millis(250),
            release_after: Duration::from_millis(2000),
            takeover: Takeover::Never,
        };
        let (input, output) = rtrb::RingBuffer::new(16);
        (Receiver::new(ROBOT, params, input, Arc::default()), output)
    }

    /// A pose captured and sent at `at` (ms, robot's clock) that arrives 10 ms later, as an answer to a state of the
    /// robot that left 10 ms before.
    fn send(receiver: &mut Receiver, epoch: u64, seq: u64, at: u64, echo: bool) {
        let operator = |ms: u64| MonoTime(AHEAD + ms * MS);
        let echo = if echo {
            Echo { epoch: ROBOT, sent: MonoTime((at - 10) * MS), received: operator(at) }
        } else {
            Echo::NONE
        };
        let pose = MasterPose { q: Gesture::Open.sample(0.0), geometry: MasterGeometry::PARADIGMATIC, tuning: None };
        let header = Header::new::<PoseMessage>(epoch, seq, operator(at));
        let message = PoseMessage::new(header, echo, operator(at), &pose, Intent::default());
        deliver(receiver, &message, at + 10);
    }

    fn deliver(receiver: &mut Receiver, message: &PoseMessage, at: u64) {
        let mut buffer = [0; MAX_MESSAGE];
        let len = encode_into(message, &mut buffer).unwrap();
        receiver.on_pose(Arrival { payload: Ok(&buffer[..len]), at: MonoTime(at * MS) });
    }

    fn rejected(receiver: &Receiver, why: Rejection) -> u64 {
        receiver.counts().rejected[why.index()]
    }

    #[test]
    fn poses_pass_once_the_clock_is_known() {
        let (mut receiver, mut slot) = receiver();
        send(&mut receiver, 7, 1, 1000, false);
        assert_eq!((rejected(&receiver, Rejection::Clock), slot.pop().is_err()), (1, true));
        assert_eq!(receiver.echo().epoch, 7);
        send(&mut receiver, 7, 2, 1010, true);
        let sample = slot.pop().unwrap();
        assert_eq!((sample.epoch, sample.sequence, sample.received), (7, 2, MonoTime(1020 * MS)));
        // Symmetric delays: the capture is known exactly.
        assert!(sample.captured.0.abs_diff(1010 * MS) < 1000, "{:?}", sample.captured);
        assert_eq!(receiver.counts().accepted, 1);
    }

    #[test]
    fn a_copy_changes_nothing_and_a_false_stamp_does_no_harm() {
        let (mut receiver, mut slot) = receiver();
        send(&mut receiver, 7, 1, 1000, true);
        let echo = receiver.echo();
        let pose = MasterPose { q: Gesture::Open.sample(0.0), geometry: MasterGeometry::PARADIGMATIC, tuning: None };
        let message = |seq, at: u64| {
            let at = MonoTime(AHEAD + at * MS);
            PoseMessage::new(Header::new::<PoseMessage>(7, seq, at), Echo::NONE, at, &pose, Intent::default())
        };
        deliver(&mut receiver, &message(1, 1000), 1015);
        assert_eq!((receiver.echo(), rejected(&receiver, Rejection::Sequence)), (echo, 1));
        // Hours ahead: refused, and the next true one is heard all the same.
        deliver(&mut receiver, &message(2, 9_000_000), 1016);
        send(&mut receiver, 7, 3, 1010, true);
        assert_eq!(receiver.echo().sent, MonoTime(AHEAD + 1010 * MS));
        assert_eq!([slot.pop().unwrap().sequence, slot.pop().unwrap().sequence], [1, 3]);
    }

    #[test]
    fn a_backlog_and_a_second_operator_are_refused() {
        let (mut receiver, mut slot) = receiver();
        send(&mut receiver, 7, 1, 1000, true);
        send(&mut receiver, 8, 1, 1005, true);
        assert_eq!(rejected(&receiver, Rejection::Operator), 1);
        assert_eq!(receiver.echo().epoch, 7, "the driving operator keeps its echo");
        // What was sent at 1020 .. 1080 ms comes out of some buffer 3 s later.
        let pose = MasterPose { q: Gesture::Open.sample(0.0), geometry: MasterGeometry::PARADIGMATIC, tuning: None };
        for seq in 2..6 {
            let stamp = MonoTime(AHEAD + (1000 + seq * 20) * MS);
            let message = PoseMessage::new(
                Header::new::<PoseMessage>(7, seq, stamp),
                Echo::NONE,
                stamp,
                &pose,
                Intent::default(),
            );
            deliver(&mut receiver, &message, 4000 + seq);
        }
        assert_eq!(rejected(&receiver, Rejection::Stale), 4);
        assert_eq!(slot.pop().unwrap().sequence, 1);
        // The first has been silent for long: the second may drive.
        send(&mut receiver, 8, 2, 4100, true);
        assert_eq!(slot.pop().unwrap().epoch, 8);
    }

    #[test]
    fn garbage_is_counted_and_changes_nothing() {
        let (mut receiver, mut slot) = receiver();
        send(&mut receiver, 7, 1, 1000, true);
        for garbage in [&[] as &[u8], &[0; 10], &[0xff; 500], b"{\"q\": []}"] {
            receiver.on_pose(Arrival { payload: Ok(garbage), at: MonoTime(1011 * MS) });
        }
        assert_eq!(rejected(&receiver, Rejection::Malformed), 4);
        assert_eq!(slot.pop().unwrap().sequence, 1);
        send(&mut receiver, 7, 2, 1020, true);
        assert_eq!(slot.pop().unwrap().sequence, 2);
    }

    fn ask(receiver: &mut Receiver, epoch: u64, robot: u64, request: Request, at: u64) -> bool {
        let message = ControlMessage::new(Header::new::<ControlMessage>(epoch, 1, MonoTime(at)), robot, request);
        let mut buffer = [0; MAX_MESSAGE];
        let len = encode_into(&message, &mut buffer).unwrap();
        let arrival = Arrival { payload: Ok(&buffer[..len]), at: MonoTime(at * MS) };
        match request {
            Request::Stop => receiver.on_stop(arrival),
            Request::Reset { .. } => receiver.on_reset(arrival),
        }
        receiver.shared.latch.get().is_stopped()
    }

    #[test]
    fn anybody_may_stop_and_only_the_holder_may_reset() {
        let (mut receiver, _slot) = receiver();
        send(&mut receiver, 7, 1, 1000, true);
        assert!(ask(&mut receiver, 99, 0, Request::Stop, 1100));
        assert!(ask(&mut receiver, 99, ROBOT, Request::Reset { stop: 1 }, 1101), "not the holder");
        assert!(ask(&mut receiver, 7, ROBOT + 1, Request::Reset { stop: 1 }, 1102), "meant for another process");
        assert!(ask(&mut receiver, 7, ROBOT, Request::Reset { stop: 0 }, 1103), "meant for another stop");
        assert!(!ask(&mut receiver, 7, ROBOT, Request::Reset { stop: 1 }, 1104));
        assert!(ask(&mut receiver, 99, 0, Request::Stop, 1105));
        assert!(ask(&mut receiver, 7, ROBOT, Request::Reset { stop: 1 }, 1106), "a replay");
        for take in [Receiver::on_stop, Receiver::on_reset] {
            take(&mut receiver, Arrival { payload: Ok(b"nonsense"), at: MonoTime(1107 * MS) });
        }
        assert!(receiver.shared.latch.get().is_stopped());
        // On the key where an observer may write a reset is none, whoever's it claims to be.
        let header = Header::new::<ControlMessage>(7, 1, MonoTime(1108));
        let mut buffer = [0; MAX_MESSAGE];
        let len = encode_into(&ControlMessage::new(header, ROBOT, Request::Reset { stop: 2 }), &mut buffer).unwrap();
        let forged = Arrival { payload: Ok(&buffer[..len]), at: MonoTime(1108 * MS) };
        receiver.on_stop(forged);
        assert!(receiver.shared.latch.get().is_stopped());
        receiver.on_reset(forged);
        assert!(!receiver.shared.latch.get().is_stopped(), "the same from who may");
    }

    #[test]
    fn strangers_do_not_push_out_the_clock_of_the_holder() {
        let (mut receiver, mut slot) = receiver();
        send(&mut receiver, 7, 1, 1000, true);
        let pose = MasterPose { q: Gesture::Open.sample(0.0), geometry: MasterGeometry::PARADIGMATIC, tuning: None };
        for epoch in 100..200 {
            let stamp = MonoTime(AHEAD + 1010 * MS);
            let intent = Intent { takeover: true, ..Intent::default() };
            let header = Header::new::<PoseMessage>(epoch, 1, stamp);
            deliver(&mut receiver, &PoseMessage::new(header, Echo::NONE, stamp, &pose, intent), 1011);
        }
        assert_eq!(receiver.echo().epoch, 7);
        assert_eq!(slot.pop().unwrap().sequence, 1);
        // Without an echo: its clock is still known.
        send(&mut receiver, 7, 2, 1020, false);
        assert_eq!(slot.pop().unwrap().sequence, 2);
    }
}
