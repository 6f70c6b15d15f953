//! A million hostile messages through the robot's receive path, in virtual time: bytes, receiver, lease, control tick,
//! simulated hand. Bit flips, numbers that are none, jumps through the joint box, reordering, duplicates, replays,
//! backlogs, foreign epochs, forged stamps and clutches, clocks that drift, run away and step, restarts, rivals, stops
//! and resets, a hand whose state lags, ticks that come late. Every promise of SAFETY.md that a tick can break is
//! checked in every tick, the penetration too. `TELEOP_SEED=1` (2, 3, ..) makes it another million.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::cmp::Reverse;
use std::collections::{BinaryHeap, HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use teleop_common::authority::{Clutch, Intent, Latch, LeaseParams, OperatorName, Takeover};
use teleop_common::guard::{MAX_PENETRATION, MotionGuard};
use teleop_common::hand::{HandModel, HandSide, JointVector};
use teleop_common::mapping::{MappingMode, MappingParams};
use teleop_common::master::{MasterGeometry, MasterPose};
use teleop_common::mode::Mode;
use teleop_common::net::Arrival;
use teleop_common::playout::{PlayoutMode, PlayoutParams};
use teleop_common::time::MonoTime;
use teleop_common::wire::{
    ControlMessage, Echo, Header, MAX_MESSAGE, Message, PoseMessage, Rejection, Request, Stamper, decode, encode_into,
};
use teleop_link::Dice;
use teleop_robot::control::{ControlParams, Controller, Fault, PoseSample, Relax, StopAction, TickRecord};
use teleop_robot::driver::{HandDriver, JointState, SimHand};
use teleop_robot::receive::Receiver;
use teleop_robot::runtime::Shared;

const MS: u64 = 1_000_000;
const RATE: f64 = 333.0;
const PERIOD: u64 = 3_003_003;
const ROBOT: u64 = 1;
const MAX_AGE: Duration = Duration::from_millis(250);
/// A period of up to this is learnt from the source.
const MAX_PERIOD: Duration = Duration::from_millis(100);
/// The oldest that a pose can truly be: the limit holds for its age by the estimated clock, whose uncertainty (half of a
/// round trip, of which a stalled pose may have taken all) is at most as much; and what clocks do in 8 s.
const OLDEST: Duration = Duration::from_millis(508);
/// Where a pose message has its times (echo, capture; and when it was sent), and its angles and sizes.
const STAMPS: std::ops::Range<usize> = 24..64;
const NUMBERS: std::ops::Range<usize> = 64..312;
const EPOCH: std::ops::Range<usize> = 8..16;

/// A message under way: when it arrives, its number, whether it is a pose, its bytes.
type Letter = (u64, u64, bool, Vec<u8>);

/// What differs between the runs.
#[derive(Clone, Copy)]
struct Setting {
    side: HandSide,
    mode: MappingMode,
    takeover: Takeover,
    relax: Relax,
    stop: StopAction,
    engage_ramp: f64,
    playout: PlayoutMode,
}

/// An operator process.
struct Operator {
    stamper: Stamper,
    epoch: u64,
    /// Its clock: what it shows at the beginning, and how fast it runs.
    zero: u64,
    pace: f64,
    /// It runs away or was set: what it says of times is not true.
    broken: bool,
    clutch: Clutch,
    /// When a pose of it last passed.
    passed: u64,
}

impl Operator {
    fn new(dice: &mut Dice, now: u64) -> Self {
        let epoch = 1000 + (dice.roll() * 1e12) as u64;
        let broken = dice.roll() < 0.2;
        let drift = if broken { 0.2 } else { 0.0005 };
        let pace = 1.0 + drift * (2.0 * dice.roll() - 1.0);
        let zero = (dice.roll() * 1e15) as u64;
        let clutch = Clutch(if dice.roll() < 0.3 { u32::MAX - 3 } else { 0 });
        Self { stamper: Stamper::new(epoch), epoch, zero, pace, broken, clutch, passed: now }
    }

    fn clock(&self, now: u64) -> MonoTime {
        MonoTime(self.zero + (now as f64 * self.pace) as u64)
    }
}

/// What became of it all.
#[derive(Default)]
struct Tally {
    messages: u64,
    requests: u64,
    ticks: u64,
    accepted: u64,
    rejected: [u64; Rejection::ALL.len()],
    modes: [u64; Mode::ALL.len()],
    engaged: u64,
    holds: u64,
    /// Ticks that followed a pose whose true age is known.
    judged: u64,
    oldest: Duration,
    fastest: f64,
    deepest: f64,
}

struct World {
    setting: Setting,
    params: ControlParams,
    dice: Dice,
    hand: HandModel,
    guard: MotionGuard,
    driver: SimHand,
    controller: Controller,
    receiver: Receiver,
    admitted: rtrb::Consumer<PoseSample>,
    shared: Arc<Shared>,
    now: u64,
    operators: [Operator; 2],
    /// Messages under way.
    under_way: BinaryHeap<Reverse<Letter>>,
    number: u64,
    /// Messages seen, to be sent again.
    history: VecDeque<Vec<u8>>,
    /// When honest poses were captured, by epoch and number: truly, and as they say.
    truth: HashMap<(u64, u64), (u64, MonoTime)>,
    /// Epochs in whose name stamps were forged: what is known of their clocks may be a lie.
    forged: HashSet<u64>,
    /// Whether stamps and clutches are forged in this phase, and how many messages come per tick.
    forges: bool,
    rate: f64,
    /// Until then nothing of the operator's passes; then all of it at once.
    stalled: u64,
    before: Option<TickRecord>,
    velocity: JointVector,
    /// The hand was limp, and starts from where it was moved to: maybe inside itself.
    limp: bool,
    state: JointState,
    lags: u32,
}

impl World {
    fn new(setting: Setting, seed: u64) -> Self {
        let hand = HandModel::allegro_v4(setting.side);
        let mapping = MappingParams { mode: setting.mode, ..MappingParams::default() };
        let params = ControlParams {
            rate: RATE,
            relax: setting.relax,
            relax_after: Duration::from_millis(700),
            stop: setting.stop,
            engage_ramp: setting.engage_ramp,
            playout: PlayoutParams { mode: setting.playout, ..PlayoutParams::default() },
            ..ControlParams::default()
        };
        let lease = LeaseParams { max_age: MAX_AGE, release_after: Duration::from_secs(2), takeover: setting.takeover };
        let shared = Arc::<Shared>::default();
        let (input, admitted) = rtrb::RingBuffer::new(64);
        let mut driver = SimHand::new(&hand, 1.0 / RATE);
        driver.start().unwrap();
        let state = driver.read(Duration::ZERO).unwrap();
        let mut dice = Dice::new(seed, 0);
        let now = 100_000 * MS;
        let operators = [Operator::new(&mut dice, now), Operator::new(&mut dice, now)];
        Self {
            setting,
            params,
            guard: MotionGuard::new(&hand, params.tip_overlap),
            controller: Controller::new(hand.clone(), mapping, params).unwrap(),
            receiver: Receiver::new(ROBOT, lease, input, Arc::clone(&shared)),
            velocity: JointVector::zeros(hand.joints.len()),
            hand,
            dice,
            driver,
            admitted,
            shared,
            now,
            operators,
            under_way: BinaryHeap::new(),
            number: 0,
            history: VecDeque::new(),
            truth: HashMap::new(),
            forged: HashSet::new(),
            forges: false,
            rate: 2.0,
            stalled: 0,
            before: None,
            limp: false,
            state,
            lags: 0,
        }
    }

    fn roll(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.dice.roll()
    }

    fn chance(&mut self, share: f64) -> bool {
        self.dice.roll() < share
    }

    fn below(&mut self, count: usize) -> usize {
        (self.dice.roll() * count as f64) as usize
    }

    fn post(&mut self, after_ms: f64, pose: bool, bytes: Vec<u8>) {
        self.number += 1;
        self.under_way.push(Reverse((self.now + (after_ms * 1e6) as u64, self.number, pose, bytes)));
    }

    /// Any pose that passes for one of a hand, somewhere in the joint box: each is a jump.
    fn pose(&mut self) -> MasterPose {
        loop {
            let wild = self.chance(0.3);
            // Not quite a turn, which single precision may round up.
            let reach = if wild { 0.9999 * std::f64::consts::TAU } else { 2.0 };
            let mut pose = MasterPose { q: [0.0; 20], geometry: MasterGeometry::PARADIGMATIC, tuning: None };
            for angle in &mut pose.q {
                *angle = -reach + 2.0 * reach * self.dice.roll();
            }
            if wild {
                for phalanx in pose.geometry.phalanges.iter_mut().flatten() {
                    *phalanx = 0.003 + 0.147 * self.dice.roll();
                }
            }
            if pose.validate().is_ok() {
                return pose;
            }
        }
    }

    /// An operator sends a pose, as `operator` does: with the echo of a state that left the robot a while ago.
    fn send_pose(&mut self, which: usize) {
        let (back, held) = (self.roll(1.0, 15.0), self.roll(0.0, 10.0));
        let (pose, now) = (self.pose(), self.now);
        let sender = &mut self.operators[which];
        let at = sender.clock(now);
        let received = now - (held * 1e6) as u64;
        let echo =
            Echo { epoch: ROBOT, sent: MonoTime(received - (back * 1e6) as u64), received: sender.clock(received) };
        let header = sender.stamper.header::<PoseMessage>(at);
        let intent = Intent {
            clutch: sender.clutch,
            takeover: which == 1 && self.dice.roll() < 0.1,
            leaving: self.dice.roll() < 0.0005,
            operator: OperatorName::default(),
        };
        if !sender.broken {
            self.truth.insert((sender.epoch, header.seq), (now, at));
        }
        let message = PoseMessage::new(header, echo, at, &pose, intent);
        let bytes = encoded(&message);
        self.history.push_back(bytes.clone());
        if self.history.len() > 2000 {
            self.history.pop_front();
        }
        let fate = self.dice.roll();
        let delay = if fate < 0.02 {
            return; // lost
        } else if fate < 0.05 {
            self.roll(100.0, 3000.0) // out of some buffer
        } else {
            self.roll(1.0, 25.0) // overtaking each other
        };
        if fate > 0.95 {
            let later = self.roll(1.0, 500.0);
            self.post(later, true, bytes.clone());
        }
        let stall = self.stalled.saturating_sub(self.now) as f64 * 1e-6;
        self.post(delay.max(stall), true, bytes);
    }

    /// One hostile message.
    fn attack(&mut self) {
        if self.history.is_empty() {
            return;
        }
        let recent = self.history.len() - 1 - self.below(self.history.len().min(8));
        let mut bytes = self.history[recent].clone();
        let any = |dice: &mut Dice| (dice.roll() * u64::MAX as f64) as u64;
        let mut delay = 0.0;
        match self.below(if self.forges { 12 } else { 8 }) {
            // A replay of whatever was said.
            0 => {
                let old = self.below(self.history.len());
                bytes = self.history[old].clone();
                delay = self.roll(0.0, 2000.0);
            }
            // Doubled.
            1 => {}
            // No numbers, or such that no hand has.
            2 => {
                let at = NUMBERS.start + 4 * self.below(NUMBERS.len() / 4);
                let all = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, -1e30, f32::MIN_POSITIVE, -0.0];
                let value = all[self.below(all.len())];
                bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
            }
            // Bit flips in all but the stamps; or in the head of the header.
            3 | 4 => {
                for _ in 0..1 + self.below(8) {
                    let at = self.below(bytes.len() - STAMPS.end);
                    bytes[STAMPS.end + at] ^= 1 << self.below(8);
                }
            }
            5 => {
                let at = self.below(8);
                bytes[at] ^= 1 << self.below(8);
            }
            // Too short, too long, or nothing at all.
            6 => {
                let length = self.below(400);
                bytes.resize(length, 0xff);
                if self.chance(0.3) {
                    bytes = (0..length).map(|_| self.below(256) as u8).collect();
                }
            }
            // A stranger, who wants to take over or not.
            7 => {
                let epoch = if self.chance(0.5) { any(&mut self.dice) } else { self.below(8) as u64 };
                bytes[EPOCH].copy_from_slice(&epoch.to_le_bytes());
                bytes[316] = self.below(4) as u8;
            }
            // Forged: a stamp or the number, a little or altogether; the clutch; bits anywhere.
            8 | 9 => {
                let at = [16, 24, 40, 48, 56][self.below(5)];
                let said = u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
                let shift = (self.roll(-1.0, 1.0) * if at == 16 { 100.0 } else { 300e6 }) as i64;
                let value = if self.chance(0.1) { any(&mut self.dice) } else { said.wrapping_add_signed(shift) };
                bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
            }
            10 => {
                let seq = u64::from_le_bytes(bytes[16..24].try_into().unwrap()) + 1;
                bytes[16..24].copy_from_slice(&seq.to_le_bytes());
                bytes[312] = self.below(256) as u8;
                bytes[316] = self.below(4) as u8;
            }
            _ => {
                for _ in 0..1 + self.below(4) {
                    let at = self.below(bytes.len());
                    bytes[at] ^= 1 << self.below(8);
                }
            }
        }
        self.post(delay, true, bytes);
    }

    /// Somebody asks for a stop or a reset, rightly or not.
    fn request(&mut self) {
        let holder = self.receiver.holder(MonoTime(self.now)).map_or(0, |(epoch, _)| epoch);
        let number = self.shared.latch.get().asked;
        let [right, mine, meant] = [0.7, 0.7, 0.8].map(|share| self.chance(share));
        let request = if self.chance(0.2) {
            Request::Stop
        } else {
            Request::Reset { stop: if right { number } else { number.wrapping_sub(self.below(3) as u32) } }
        };
        let header = Header::new::<ControlMessage>(if mine { holder } else { 99 }, 1, MonoTime(self.now));
        let mut bytes = encoded(&ControlMessage::new(header, if meant { ROBOT } else { 2 }, request));
        if self.chance(0.2) {
            let at = self.below(bytes.len());
            bytes[at] ^= 1 << self.below(8);
        }
        self.post(0.0, false, bytes);
    }

    fn deliver(&mut self, at: MonoTime, pose: bool, bytes: &[u8], tally: &mut Tally) {
        let arrival = Arrival { payload: Ok(bytes), at };
        if pose {
            tally.messages += 1;
            if bytes.len() == PoseMessage::LEN {
                let number = |range: std::ops::Range<usize>| u64::from_le_bytes(bytes[range].try_into().unwrap());
                let (epoch, seq) = (number(EPOCH), number(16..24));
                let real = self.truth.get(&(epoch, seq)).is_some_and(|(_, said)| said.0 == number(56..64));
                if !real || self.forges {
                    self.forged.insert(epoch);
                }
            }
            return self.receiver.on_pose(arrival);
        }
        tally.requests += 1;
        let before = self.shared.latch.get();
        let holder = self.receiver.holder(at).map(|(epoch, _)| epoch);
        // On both keys: on each of them the other's request is none.
        self.receiver.on_stop(arrival);
        self.receiver.on_reset(arrival);
        let after = self.shared.latch.get();
        let expected =
            match decode::<ControlMessage>(bytes).ok().and_then(|message| Some((message.request()?, message))) {
                Some((Request::Stop, _)) => before.stop(),
                Some((Request::Reset { stop }, message))
                    if message.robot == ROBOT && Some(message.header.epoch) == holder =>
                {
                    before.reset(stop)
                }
                _ => before,
            };
        assert_eq!(after, expected, "{bytes:02x?}");
    }

    /// All that happens until the next tick, and the tick.
    fn step(&mut self, tally: &mut Tally) {
        if self.chance(0.0005) {
            self.forges = self.chance(0.4);
            self.rate = self.roll(0.0, 12.0);
        }
        for which in 0..2 {
            let own = &self.operators[which];
            // One that is not listened to for long starts again; and it may fail at any time.
            let deaf = self.now - own.passed > 3000 * MS && which == 0;
            if deaf || self.chance(0.00005) {
                self.operators[which] = Operator::new(&mut self.dice, self.now);
            }
            if self.chance(0.00005) {
                // Its clock is set.
                let own = &mut self.operators[which];
                own.broken = true;
                own.zero = own.zero.wrapping_add_signed((2e10 * (self.dice.roll() - 0.5)) as i64).min(1 << 60);
            }
            // The clutch: as an eager operator moves it, sometimes by itself.
            let mode = self.controller.mode();
            let own = &mut self.operators[which];
            own.clutch = if self.dice.roll() < 0.001 {
                Clutch(own.clutch.0.wrapping_add(1 + (3.0 * self.dice.roll()) as u32))
            } else {
                own.clutch.eager(mode)
            };
        }
        if self.chance(0.001) {
            self.stalled = self.now + (self.roll(50.0, 500.0) * 1e6) as u64;
        }
        let silent = (self.now / (700 * MS)).is_multiple_of(9);
        if !silent && self.chance(0.35) {
            self.send_pose(0);
        }
        if self.chance(0.03) {
            self.send_pose(1);
        }
        for _ in 0..self.roll(0.0, self.rate) as usize {
            self.attack();
        }
        if self.chance(if self.shared.latch.get().is_stopped() { 0.03 } else { 0.004 }) {
            self.request();
        }
        self.now += PERIOD;
        if self.chance(0.0003) {
            self.now += (self.roll(0.0, 500.0) * 1e6) as u64;
        }
        while self.under_way.peek().is_some_and(|Reverse((at, ..))| *at <= self.now) {
            let Reverse((at, _, pose, bytes)) = self.under_way.pop().unwrap();
            self.deliver(MonoTime(at), pose, &bytes, tally);
            while let Ok(sample) = self.admitted.pop() {
                assert!(sample.received.since(sample.captured) <= MAX_AGE + Duration::from_micros(1), "{sample:?}");
                if let Some(captured) = self.captured(&sample) {
                    let age = Duration::from_nanos(sample.received.0 - captured);
                    assert!(age <= OLDEST, "a pose of {age:?} passed");
                    tally.oldest = tally.oldest.max(age);
                }
                for own in self.operators.iter_mut().filter(|own| own.epoch == sample.epoch) {
                    own.passed = self.now;
                }
                self.controller.admit(&sample);
            }
        }
        // The hand's own frames: now and then they do not change for a while.
        let fresh = self.driver.read(Duration::ZERO).unwrap();
        if self.lags == 0 {
            self.state = fresh;
            self.lags = if self.chance(0.002) { self.below(40) as u32 } else { 0 };
        } else {
            self.lags -= 1;
        }
        let latch = self.shared.latch.get();
        let before = self.controller.mode();
        let record = self.controller.tick(MonoTime(self.now), latch, &self.state);
        self.driver.write(&record.command).unwrap();
        tally.ticks += 1;
        tally.modes[record.mode as usize] += 1;
        tally.engaged += u64::from(record.mode.follows() && !before.follows());
        self.judge_mode(before, latch, &record, tally);
        self.judge_command(&record, tally);
        self.before = Some(record);
    }

    fn judge_mode(&mut self, before: Mode, latch: Latch, record: &TickRecord, tally: &mut Tally) {
        let mode = record.mode;
        assert_eq!(mode == Mode::Stopped, latch.is_stopped());
        assert_ne!(mode, Mode::Faulted, "{:?}", record.fault);
        assert!(mode != Mode::Relaxed || self.setting.relax != Relax::Hold);
        let silent = record.sample.map(|sample| record.now.since(sample.received));
        if before.follows() && !mode.follows() && mode != Mode::Stopped {
            assert!(matches!(mode, Mode::Holding | Mode::Armed), "from {before} to {mode}");
        }
        if !mode.follows() {
            return;
        }
        assert!(mode == Mode::Engaging || matches!(before, Mode::Engaging | Mode::Engaged), "no ramp: from {before}");
        let (sample, silent) = (record.sample.unwrap(), silent.unwrap());
        assert!(silent <= self.params.hold_after + MAX_PERIOD, "follows after {silent:?} of silence");
        assert!(sample.intent.clutch.is_closed(), "follows with the clutch open");
        if let Some(captured) = self.captured(&sample) {
            let age = Duration::from_nanos(self.now - captured);
            assert!(age <= OLDEST + self.params.hold_after + MAX_PERIOD, "follows a pose of {age:?}");
            tally.judged += 1;
        }
    }

    /// When a pose was captured, if that is truly known, and no lie about its operator's clock was told.
    fn captured(&self, sample: &PoseSample) -> Option<u64> {
        let (captured, said) = self.truth.get(&(sample.epoch, sample.sequence))?;
        (*said == sample.captured_remote && !self.forged.contains(&sample.epoch)).then_some(*captured)
    }

    fn judge_command(&mut self, record: &TickRecord, tally: &mut Tally) {
        let command = &record.command;
        assert!(command.q.is_finite() && command.dq.is_finite() && command.tau.is_finite());
        // A hand without torque is commanded where it is, whatever moved it there.
        let limp = record.mode == Mode::Relaxed && self.setting.relax == Relax::Off
            || record.mode == Mode::Stopped && self.setting.stop == StopAction::Off;
        if limp && command.tau.iter().all(|tau| *tau == 0.0) {
            self.limp = true;
            self.velocity = JointVector::zeros(self.hand.joints.len());
            assert_eq!(command.q, record.state.q);
            return;
        }
        let opens = record.mode == Mode::Relaxed && self.setting.relax == Relax::Open;
        let still = !record.mode.follows() && !opens;
        for (slot, joint) in self.hand.joints.iter().enumerate() {
            let (q, tau) = (command.q[slot], command.tau[slot]);
            assert!((joint.lower..=joint.upper).contains(&q), "{} at {q}", joint.name);
            assert!(tau.abs() <= joint.torque, "{} with {tau} N m", joint.name);
            let Some(last) = &self.before else { continue };
            let moving = (q - last.command.q[slot]) * RATE;
            assert!(moving.abs() <= joint.velocity * (1.0 + 1e-9), "{} at {moving} rad/s", joint.name);
            let change = (moving - self.velocity[slot]).abs() * RATE;
            assert!(change <= joint.acceleration * (1.0 + 1e-6), "{} at {change} rad/s2", joint.name);
            if still {
                let speed = (moving.abs(), self.velocity[slot].abs());
                assert!(
                    speed.0 <= speed.1 + 1e-9,
                    "{} from {} to {} rad/s in {}",
                    joint.name,
                    speed.1,
                    speed.0,
                    record.mode
                );
            }
            self.velocity[slot] = moving;
            tally.fastest = tally.fastest.max(moving.abs());
        }
        let gap = self.guard.least_gap(&self.hand, &command.q);
        if self.limp {
            // From here on it is judged again, once it is out of itself.
            self.limp = gap < -MAX_PENETRATION;
            return;
        }
        assert!(gap >= -MAX_PENETRATION, "the hand is {} m inside itself", -gap);
        tally.deepest = tally.deepest.max(-gap);
    }

    /// The end: a fault of some kind, and then nothing moves whatever comes.
    fn fail(&mut self, kind: usize) {
        let fault = match kind % 3 {
            0 => {
                self.controller.fail(Fault::Driver);
                Fault::Driver
            }
            1 => {
                self.state.q[3] = f64::NAN;
                Fault::StateInvalid
            }
            _ => {
                self.state.dq = JointVector::zeros(5);
                Fault::StateInvalid
            }
        };
        for _ in 0..300 {
            self.send_pose(0);
            self.now += PERIOD;
            let record = self.controller.tick(MonoTime(self.now), self.shared.latch.get(), &self.state);
            assert_eq!((record.mode, record.fault), (Mode::Faulted, fault));
            assert!(record.command.tau.iter().all(|tau| *tau == 0.0) && record.command.q.is_finite());
            self.state = self.driver.read(Duration::ZERO).unwrap();
            while let Ok(sample) = self.admitted.pop() {
                self.controller.admit(&sample);
            }
        }
    }
}

fn encoded<M: Message>(message: &M) -> Vec<u8> {
    let mut buffer = [0; MAX_MESSAGE];
    let length = encode_into(message, &mut buffer).unwrap();
    buffer[..length].to_vec()
}

fn settings() -> Vec<Setting> {
    let modes = [MappingMode::Combined, MappingMode::Combined, MappingMode::DexPilot, MappingMode::Cartesian];
    let relaxes = [Relax::Hold, Relax::Open, Relax::Yield, Relax::Off];
    let playouts = [PlayoutMode::Auto, PlayoutMode::Direct, PlayoutMode::Fixed, PlayoutMode::Auto];
    (0..8)
        .map(|n| Setting {
            side: if n % 2 == 0 { HandSide::Right } else { HandSide::Left },
            mode: modes[n % 4],
            takeover: if n < 4 { Takeover::Never } else { Takeover::Always },
            relax: relaxes[n % 4],
            stop: if n % 4 == 2 { StopAction::Off } else { StopAction::Hold },
            engage_ramp: if n % 4 == 1 { 0.0 } else { 1.0 },
            playout: playouts[n / 2],
        })
        .collect()
}

#[test]
fn a_million_hostile_messages_break_no_promise() {
    const MESSAGES: u64 = 1_000_000;
    let (began, mut tally) = (Instant::now(), Tally::default());
    let settings = settings();
    let seed: u64 = std::env::var("TELEOP_SEED").map_or(0, |seed| seed.parse().unwrap());
    for (number, setting) in settings.iter().enumerate() {
        let mut world = World::new(*setting, seed * 1000 + number as u64);
        while tally.messages < MESSAGES * (number as u64 + 1) / settings.len() as u64 {
            world.step(&mut tally);
        }
        let counts = world.receiver.counts();
        tally.accepted += counts.accepted;
        tally.rejected.iter_mut().zip(counts.rejected).for_each(|(all, own)| *all += own);
        tally.holds += world.before.map_or(0, |record| record.holds);
        world.fail(number);
    }
    let Tally { messages, requests, ticks, accepted, rejected, modes, engaged, holds, .. } = tally;
    let seconds = began.elapsed().as_secs_f64();
    println!(
        "{messages} poses and {requests} requests in {ticks} ticks, {seconds:.1} s: {accepted} accepted, rejected {:?}; \
         {engaged} times engaged, {holds} holds, modes {:?}; true age checked in {} ticks, oldest on arrival {:?}; \
         fastest {:.2} rad/s, deepest {:.3} mm",
        Rejection::ALL.map(|why| (why.name(), rejected[why.index()])),
        Mode::ALL.map(|mode| (mode.name(), modes[mode as usize])),
        tally.judged,
        tally.oldest,
        tally.fastest,
        tally.deepest * 1e3,
    );
    // It was an attack, and the hand worked all the same.
    assert!(messages >= MESSAGES && accepted > 50_000 && requests > 500);
    assert!(rejected.iter().all(|count| *count > 100), "{rejected:?}");
    let follows = modes[Mode::Engaging as usize] + modes[Mode::Engaged as usize];
    assert!(follows * 10 > ticks && tally.judged * 10 > follows, "{follows} of {ticks}, {} judged", tally.judged);
    assert!(engaged > 500 && holds > 100 && tally.fastest > 6.9, "{engaged} times engaged, {holds} holds");
    assert!(modes[..7].iter().all(|count| *count > 500), "{modes:?}");
    assert!(tally.oldest > MAX_AGE, "nothing was nearly too old: {:?}", tally.oldest);
}
