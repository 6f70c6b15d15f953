//! The control core in virtual time, with the simulated hand: watchdog, limits, faults, and no allocation.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use teleop_common::authority::{Clutch, Intent, Latch, LeaseParams, Takeover};
use teleop_common::guard::{MAX_PENETRATION, MotionGuard};
use teleop_common::hand::{HandModel, HandSide, JointVector};
use teleop_common::mapping::{MappingMode, MappingParams};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
use teleop_common::mode::Mode;
use teleop_common::net::Arrival;
use teleop_common::time::MonoTime;
use teleop_common::wire::{Echo, MAX_MESSAGE, PoseMessage, Stamper, encode_into};
use teleop_link::Dice;
use teleop_robot::control::{ControlParams, Controller, Fault, PoseSample, Relax, StopAction, TickRecord};
use teleop_robot::driver::{DriverError, HandDriver, JointCommand, JointState, Pace, SimHand};
use teleop_robot::receive::Receiver;
use teleop_robot::runtime::{ControlThread, Realtime, Shared};
use teleop_tests::eventually;

/// Counts the allocations of each thread by itself.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

fn count() {
    // Fails only while a thread is torn down.
    let _gone = ALLOCATIONS.try_with(|allocations| allocations.set(allocations.get() + 1));
}

// SAFETY: passes every call on to the system's allocator as it is.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count();
        // SAFETY: the caller's promises are those that `System` asks for.
        unsafe { System.alloc(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count();
        // SAFETY: as above.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count();
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Allocations and releases of this thread while `work` runs.
fn allocations(work: impl FnOnce()) -> u64 {
    let before = ALLOCATIONS.get();
    work();
    ALLOCATIONS.get() - before
}

const MS: u64 = 1_000_000;
const RATE: f64 = 333.0;
const PERIOD: Duration = Duration::from_nanos(3_003_003);
const HOLD_AFTER: Duration = Duration::from_millis(200);

/// A controller and a simulated hand that tick in virtual time.
struct Bench {
    hand: HandModel,
    controller: Controller,
    driver: SimHand,
    now: MonoTime,
    latch: Latch,
    clutch: Clutch,
    /// Whether the operator closes the clutch whenever the robot is ready.
    eager: bool,
}

impl Bench {
    fn new(side: HandSide, mapping: MappingParams) -> Self {
        let hand = HandModel::allegro_v4(side);
        let params = ControlParams { rate: RATE, hold_after: HOLD_AFTER, ..ControlParams::default() };
        let mut driver = SimHand::new(&hand, 1.0 / RATE);
        driver.start().unwrap();
        let controller = Controller::new(hand.clone(), mapping, params).unwrap();
        Self {
            hand,
            controller,
            driver,
            now: MonoTime(MS),
            latch: Latch::default(),
            clutch: Clutch::default(),
            eager: true,
        }
    }

    fn right() -> Self {
        Self::new(HandSide::Right, MappingParams::default())
    }

    fn tick(&mut self, newest: Option<&PoseSample>) -> TickRecord {
        self.now = self.now + PERIOD;
        let state = self.driver.read(Duration::ZERO).unwrap();
        if let Some(sample) = newest {
            self.controller.admit(sample);
        }
        let record = self.controller.tick(self.now, self.latch, &state);
        self.driver.write(&record.command).unwrap();
        record
    }

    /// A pose that arrives now.
    fn sample(&mut self, pose: MasterPose, sequence: u64) -> PoseSample {
        if self.eager {
            self.clutch = self.clutch.eager(self.controller.mode());
        }
        PoseSample { epoch: 7, ..PoseSample::instant(self.now, sequence, pose, self.clutch) }
    }

    fn intent(&self) -> Intent {
        Intent { clutch: self.clutch, ..Intent::default() }
    }
}

fn pose(gesture: Gesture, t: f64) -> MasterPose {
    MasterPose { q: gesture.sample(t), geometry: MasterGeometry::PARADIGMATIC, tuning: None }
}

/// Speed between two commands (rad/s), of the fastest joint.
fn speed(before: &TickRecord, after: &TickRecord) -> f64 {
    let pairs = before.command.q.iter().zip(after.command.q.iter());
    pairs.fold(0.0, |most: f64, (a, b)| most.max((b - a).abs() * RATE))
}

#[test]
fn a_tick_does_not_allocate() {
    for mode in [MappingMode::Combined, MappingMode::Vector, MappingMode::DexPilot] {
        assert_no_allocation(MappingParams { mode, ..MappingParams::default() });
    }
}

fn assert_no_allocation(mapping: MappingParams) {
    const ROBOT: u64 = 1;
    /// The operator's clock, from this one's.
    const AHEAD: u64 = 3_600_000 * MS;
    let mode = mapping.mode;
    let mut bench = Bench::new(HandSide::Right, mapping);
    let (input, mut poses) = rtrb::RingBuffer::new(16);
    let lease =
        LeaseParams { max_age: Duration::from_millis(250), release_after: HOLD_AFTER, takeover: Takeover::Idle };
    let mut receiver = Receiver::new(ROBOT, lease, input, Arc::<Shared>::default());
    let mut operator = Stamper::new(100);
    let mut modes = [0_u64; Mode::ALL.len()];
    let mut run = |ticks: u64| {
        for tick in 0..ticks {
            // Every so often the operator falls silent for 0.33 s; every other time it comes back as a new process.
            let phase = tick % 4000;
            if phase == 3999 && (tick / 4000) % 2 == 0 {
                operator = Stamper::new(100 + tick);
            }
            if phase < 3890 && tick % 3 == 0 {
                // Poses and their answers take 2 ms each way.
                let (sent, arrives) = (bench.now.0, bench.now.0 + 2 * MS);
                let echo = Echo { epoch: ROBOT, sent: MonoTime(sent - 3 * MS), received: MonoTime(sent - MS + AHEAD) };
                let header = operator.header::<PoseMessage>(MonoTime(sent + AHEAD));
                let pose = pose(Gesture::Tour, tick as f64 / RATE);
                let message = PoseMessage::new(header, echo, MonoTime(sent + AHEAD), &pose, bench.intent());
                let mut bytes = [0; MAX_MESSAGE];
                let len = encode_into(&message, &mut bytes).unwrap();
                receiver.on_pose(Arrival { payload: Ok(&bytes[..len]), at: MonoTime(arrives) });
                // And what is no pose.
                receiver.on_pose(Arrival { payload: Ok(&bytes[..len - 1]), at: MonoTime(arrives) });
            }
            while let Ok(sample) = poses.pop() {
                bench.controller.admit(&sample);
            }
            bench.clutch = bench.clutch.eager(bench.controller.mode());
            let record = bench.tick(None);
            modes[record.mode as usize] += 1;
        }
    };
    run(2000);
    let ticks = 100_000;
    let count = allocations(|| run(ticks));
    println!(
        "{mode:?}: {ticks} ticks with receiving, decoding and the simulated hand: {count} allocations; modes {modes:?}"
    );
    assert_eq!(count, 0);
    // It was the real thing: followed, held, and followed again.
    assert!(
        modes[Mode::Engaged as usize] + modes[Mode::Engaging as usize] > 90_000 && modes[Mode::Holding as usize] > 500,
        "{modes:?}"
    );
    assert_eq!(modes[Mode::Faulted as usize], 0);
    assert!(receiver.counts().accepted > 30_000, "{:?}", receiver.counts().rejected);
    // And the counter counts.
    assert!(allocations(|| drop(std::hint::black_box(Box::new(1)))) >= 2);
}

#[test]
fn the_watchdog_holds_within_a_tick() {
    let mut bench = Bench::right();
    let (mut sample, mut follows) = (None, 0);
    for tick in 0..600 {
        if tick % 3 == 0 {
            sample = Some(bench.sample(pose(Gesture::Wave, f64::from(tick) / RATE), tick as u64));
        }
        follows += u32::from(bench.tick(sample.as_ref()).mode.follows());
    }
    // The first pose arms the hand, the second closes the clutch.
    assert_eq!(follows, 597);
    // Poses come every third tick.
    let patience = HOLD_AFTER + 3 * PERIOD;
    let received = sample.unwrap().received;
    // The same pose again and again is no fresh pose.
    let first = loop {
        let record = bench.tick(sample.as_ref());
        if !record.mode.follows() {
            break record;
        }
        assert!(record.now.since(received) <= patience);
    };
    assert_eq!((first.mode, first.holds), (Mode::Holding, 1));
    let silent = first.now.since(received);
    assert!(silent > patience && silent <= patience + PERIOD, "{silent:?}");

    // It brakes within 7 / 120 s, then the command is exactly still and the hand comes to rest.
    for _ in 0..20 {
        bench.tick(sample.as_ref());
    }
    let still = bench.tick(None).command;
    for _ in 0..2000 {
        let command = bench.tick(sample.as_ref()).command;
        assert_eq!((command.q, command.dq), (still.q, still.dq));
    }
    assert!(still.dq.iter().all(|dq| *dq == 0.0));
    let rest = bench.tick(None).state;
    assert!(rest.dq.iter().all(|dq| dq.abs() < 1e-9), "{:?}", rest.dq);
    // Coulomb friction of 0.01 N m against a gain of 0.6 N m/rad leaves up to 17 mrad.
    assert!(rest.q.iter().zip(still.q.iter()).all(|(q, command)| (q - command).abs() < 0.02), "{rest:?}");
}

#[test]
fn it_resumes_without_a_jump() {
    let mut bench = Bench::right();
    for tick in 0..700_u32 {
        let sample = bench.sample(pose(Gesture::Fist, f64::from(tick) / RATE), tick.into());
        bench.tick(Some(&sample));
    }
    let mut before = bench.tick(None);
    for _ in 0..300 {
        before = bench.tick(None);
    }
    assert_eq!(before.mode, Mode::Holding);
    // The operator comes back with another posture altogether.
    let limits = bench.hand.joints[0].acceleration;
    let mut last = 0.0;
    let mut farthest: f64 = 0.0;
    let start = before;
    for tick in 0..600_u32 {
        let sample = bench.sample(pose(Gesture::Open, 0.0), 1000 + u64::from(tick));
        let record = bench.tick(Some(&sample));
        // One tick to see that the clutch is open again, one until it is closed.
        let expected = match tick {
            0 => Mode::Armed,
            // A second, 333 ticks of 3.003003 ms being a nanosecond less.
            1..=334 => Mode::Engaging,
            _ => Mode::Engaged,
        };
        assert_eq!(record.mode, expected, "at tick {tick}");
        let speed = speed(&before, &record);
        let ramp = 1.0 + 9.0 * f64::from(tick) / RATE;
        assert!(speed <= ramp.min(7.0) + 1e-9, "{speed} rad/s at tick {tick}");
        assert!(speed <= last + limits / RATE + 1e-9, "from {last} to {speed} rad/s at tick {tick}");
        farthest = farthest.max(record.command.q.iter().zip(start.command.q.iter()).map(|(a, b)| (a - b).abs()).sum());
        (before, last) = (record, speed);
    }
    assert!(farthest > 3.0, "it hardly moved: {farthest} rad");
    let target = before.mapping.unwrap().q;
    assert!(before.command.q.iter().zip(target.iter()).all(|(a, b)| (a - b).abs() < 1e-3), "it never arrived");
}

/// A pose as far from a hand's as [`MasterPose::validate`] lets pass.
fn any_pose(dice: &mut Dice) -> MasterPose {
    let mut roll = |low: f64, high: f64| low + (high - low) * dice.roll();
    let wild = roll(0.0, 1.0) < 0.5;
    let reach = if wild { std::f64::consts::TAU } else { 2.0 };
    let mut pose = MasterPose { q: [0.0; 20], geometry: MasterGeometry::PARADIGMATIC, tuning: None };
    for angle in &mut pose.q {
        *angle = roll(-reach, reach);
    }
    if wild {
        for phalanx in pose.geometry.phalanges.iter_mut().flatten() {
            *phalanx = roll(0.003, 0.150);
        }
        let mut x = roll(0.02, 0.10);
        for base in &mut pose.geometry.bases {
            *base = [x, roll(-0.1, 0.15), roll(-0.1, 0.1)];
            x -= roll(0.0011, 0.03);
        }
    }
    pose
}

#[test]
fn no_stream_of_poses_breaks_a_limit() {
    let dexpilot = MappingParams { mode: MappingMode::DexPilot, ..MappingParams::default() };
    for (side, mapping, seed) in [
        (HandSide::Right, MappingParams::default(), 1),
        (HandSide::Left, MappingParams::paper(), 2),
        (HandSide::Right, dexpilot, 3),
    ] {
        let mut bench = Bench::new(side, mapping);
        let mut dice = Dice::new(seed, 0);
        let (guard, mut closest) = (MotionGuard::new(&bench.hand, ControlParams::default().tip_overlap), f64::INFINITY);
        let (mut sample, mut sequence, mut wait) = (None, 0, 0_u64);
        let (mut before, mut velocity) = (bench.tick(None), JointVector::zeros(16));
        let (mut fastest, mut holds, mut valid) = (0.0_f64, 0, 0);
        for _ in 0..100_000_u32 {
            if wait == 0 {
                let pose = any_pose(&mut dice);
                if pose.validate().is_ok() {
                    (valid, sequence) = (valid + 1, sequence + 1);
                    sample = Some(bench.sample(pose, sequence));
                }
                // Mostly a stream; sometimes a gap, of up to a second.
                let gap = dice.roll();
                wait = if gap < 0.005 { (dice.roll() * 333.0) as u64 } else { (dice.roll() * 12.0) as u64 };
            }
            wait = wait.saturating_sub(1);
            if dice.roll() < 0.001 {
                // The machine stalls.
                bench.now = bench.now + Duration::from_millis((dice.roll() * 300.0) as u64);
            }
            let record = bench.tick(sample.as_ref());
            assert!(!matches!(record.mode, Mode::Stopped | Mode::Faulted | Mode::Relaxed), "{record:?}");
            for (slot, joint) in bench.hand.joints.iter().enumerate() {
                let (q, tau) = (record.command.q[slot], record.command.tau[slot]);
                assert!((joint.lower..=joint.upper).contains(&q), "{} at {q}", joint.name);
                assert!(tau.abs() <= joint.torque, "{} with {tau} N m", joint.name);
                let moving = (q - before.command.q[slot]) * RATE;
                assert!(moving.abs() <= joint.velocity * (1.0 + 1e-9), "{} at {moving} rad/s", joint.name);
                let change = (moving - velocity[slot]).abs() * RATE;
                assert!(change <= joint.acceleration * (1.0 + 1e-6), "{} at {change} rad/s²", joint.name);
                let measured = record.state.q[slot];
                assert!((joint.lower..=joint.upper).contains(&measured), "{} measured at {measured}", joint.name);
                velocity[slot] = moving;
                fastest = fastest.max(moving.abs());
            }
            closest = closest.min(guard.least_gap(&bench.hand, &record.command.q));
            assert!(closest >= -MAX_PENETRATION, "the hand is {} m inside itself", -closest);
            (before, holds) = (record, record.holds);
        }
        let closest = closest * 1e3;
        println!("{}: {valid} poses, {holds} holds, fastest {fastest:.2} rad/s, gap {closest:.3} mm", side.name());
        assert!(valid > 10_000 && holds > 20 && fastest > 6.9, "{valid} poses, {holds} holds, {fastest} rad/s");
    }
}

/// A controller that was engaged with a fist, and then what `params` says of a hold or a stop.
fn engaged(params: ControlParams) -> Bench {
    let mut bench = Bench::right();
    bench.controller = Controller::new(bench.hand.clone(), MappingParams::default(), params).unwrap();
    for tick in 0..700_u32 {
        let sample = bench.sample(pose(Gesture::Fist, 2.0), tick.into());
        bench.tick(Some(&sample));
    }
    assert_eq!(bench.controller.mode(), Mode::Engaged);
    bench
}

/// Ticks without a pose for `seconds`.
fn silence(bench: &mut Bench, seconds: f64) -> TickRecord {
    (0..(seconds * RATE) as u32).map(|_| bench.tick(None)).last().unwrap()
}

/// How far the commands of two ticks are apart, rad.
fn apart(a: &TickRecord, b: &TickRecord) -> f64 {
    a.command.q.iter().zip(b.command.q.iter()).fold(0.0, |most: f64, (a, b)| most.max((a - b).abs()))
}

#[test]
fn a_hold_that_lasts_does_what_was_configured() {
    let params = |relax| ControlParams { relax, relax_after: Duration::from_secs(1), ..ControlParams::default() };
    for relax in [Relax::Hold, Relax::Yield, Relax::Open, Relax::Off] {
        let mut bench = engaged(params(relax));
        let holding = silence(&mut bench, 0.8);
        assert_eq!(holding.mode, Mode::Holding, "{relax:?}");
        // Somebody pulls at the index finger.
        let mut pulled = bench.driver.read(Duration::ZERO).unwrap();
        pulled.q[1] -= 0.5;
        let torque = |bench: &mut Bench| {
            bench.now = bench.now + PERIOD;
            bench.controller.tick(bench.now, Latch::default(), &pulled).command.tau[1]
        };
        let firm = torque(&mut bench);
        assert!(firm > 0.1, "{firm} N m");
        let mut last = silence(&mut bench, 1.0);
        assert_eq!(last.mode, if relax == Relax::Hold { Mode::Holding } else { Mode::Relaxed }, "{relax:?}");
        match relax {
            Relax::Hold => assert_eq!(apart(&last, &holding), 0.0),
            Relax::Yield => {
                assert_eq!(apart(&last, &holding), 0.0);
                let most = 0.2 * bench.hand.joints[1].torque;
                assert!((torque(&mut bench) - most.min(firm)).abs() < 1e-9, "{} N m", torque(&mut bench));
            }
            Relax::Off => assert!(last.command.tau.iter().all(|tau| *tau == 0.0)),
            Relax::Open => {
                for _ in 0..2000 {
                    let record = bench.tick(None);
                    assert!(speed(&last, &record) <= 1.0 + 1e-9, "{} rad/s", speed(&last, &record));
                    last = record;
                }
                let home = bench.hand.home();
                assert!(
                    last.command.q.iter().zip(home.iter()).all(|(a, b)| (a - b).abs() < 0.05),
                    "{:?}",
                    last.command.q
                );
            }
        }
        // Whatever it did, it follows again from where it is, when the clutch is closed anew.
        let mut before = silence(&mut bench, 0.1);
        for tick in 0..400_u32 {
            let sample = bench.sample(pose(Gesture::Open, 0.0), 1000 + u64::from(tick));
            let record = bench.tick(Some(&sample));
            // A limp hand is commanded where it is, and may sink.
            if tick > 2 {
                assert!(speed(&before, &record) <= 1.0 + 9.0 * f64::from(tick) / RATE, "{relax:?} at tick {tick}");
            }
            before = record;
        }
        assert_eq!(before.mode, Mode::Engaged, "{relax:?}");
    }
}

#[test]
fn a_stop_brakes_and_then_holds_or_lets_go() {
    for stop in [StopAction::Hold, StopAction::Off] {
        let mut bench = engaged(ControlParams { stop, ..ControlParams::default() });
        for tick in 0..60_u32 {
            let sample = bench.sample(pose(Gesture::Open, 0.0), 700 + u64::from(tick));
            bench.tick(Some(&sample));
        }
        bench.latch = bench.latch.stop();
        let first = bench.tick(None);
        assert_eq!(first.mode, Mode::Stopped);
        assert!(first.command.dq.iter().any(|dq| dq.abs() > 0.5), "it was moving, and brakes within its limits");
        let stopped = silence(&mut bench, 0.3);
        let limp = stopped.command.tau.iter().all(|tau| *tau == 0.0);
        assert_eq!(limp, stop == StopAction::Off);
        let later = silence(&mut bench, 0.3);
        if stop == StopAction::Hold {
            assert_eq!(apart(&stopped, &later), 0.0);
        }
        // Poses and a clutch change nothing until the reset, and then nothing moves either.
        for tick in 0..50_u32 {
            let sample = bench.sample(pose(Gesture::Open, 0.0), 2000 + u64::from(tick));
            assert_eq!(bench.tick(Some(&sample)).mode, Mode::Stopped);
        }
        bench.eager = false;
        bench.latch = bench.latch.reset(bench.latch.asked);
        let mut last = bench.tick(None);
        for tick in 0..50_u32 {
            let sample = bench.sample(pose(Gesture::Open, 0.0), 3000 + u64::from(tick));
            let record = bench.tick(Some(&sample));
            assert!(matches!(record.mode, Mode::Disarmed | Mode::Armed), "{:?}", record.mode);
            assert_eq!(apart(&last, &record), 0.0, "tick {tick}");
            last = record;
        }
    }
}

/// Expects that the hand is off and stays off, whatever comes.
#[track_caller]
fn assert_off(bench: &mut Bench, fault: Fault) {
    for tick in 0..500_u32 {
        let sample = bench.sample(pose(Gesture::Wave, f64::from(tick) / RATE), 5000 + u64::from(tick));
        let record = bench.tick(Some(&sample));
        assert_eq!((record.mode, record.fault), (Mode::Faulted, fault));
        assert!(record.command.tau.iter().all(|tau| *tau == 0.0) && record.command.q.is_finite());
    }
}

#[test]
fn faults_take_the_torque_off_for_good() {
    let broken = |change: fn(&mut JointState)| {
        let mut bench = Bench::right();
        for tick in 0..400_u32 {
            let sample = bench.sample(pose(Gesture::Wave, f64::from(tick) / RATE), tick.into());
            bench.tick(Some(&sample));
        }
        let mut state = bench.driver.read(Duration::ZERO).unwrap();
        change(&mut state);
        let sample = bench.sample(pose(Gesture::Wave, 1.3), 1000);
        bench.controller.admit(&sample);
        let record = bench.controller.tick(bench.now + PERIOD, Latch::default(), &state);
        assert_eq!((record.mode, record.fault), (Mode::Faulted, Fault::StateInvalid));
        assert!(record.command.tau.iter().all(|tau| *tau == 0.0), "{:?}", record.command.tau);
        // A hand with a position controller of its own must not get it either.
        assert!(record.command.q.is_finite() && record.command.dq.is_finite(), "{:?}", record.command);
        assert_off(&mut bench, Fault::StateInvalid);
    };
    broken(|state| state.q[3] = f64::NAN);
    broken(|state| state.dq[15] = f64::INFINITY);
    broken(|state| state.q = JointVector::zeros(15));

    let mut bench = Bench::right();
    bench.tick(None);
    bench.controller.fail(Fault::Driver);
    bench.controller.fail(Fault::CommandNotFinite);
    assert_off(&mut bench, Fault::Driver);
}

/// A hand that is unplugged after some reads.
struct Unplugged {
    hand: SimHand,
    reads: u32,
    stops: Arc<AtomicU64>,
    written: Arc<Mutex<Vec<JointCommand>>>,
}

impl HandDriver for Unplugged {
    fn name(&self) -> &'static str {
        "hand that is unplugged"
    }

    fn pace(&self) -> Pace {
        Pace::Loop
    }

    fn start(&mut self) -> Result<(), DriverError> {
        self.hand.start()
    }

    fn read(&mut self, timeout: Duration) -> Result<JointState, DriverError> {
        self.reads = self.reads.checked_sub(1).ok_or(DriverError::Disconnected)?;
        self.hand.read(timeout)
    }

    fn write(&mut self, command: &JointCommand) -> Result<(), DriverError> {
        self.written.lock().unwrap().push(*command);
        self.hand.write(command)
    }

    fn stop(&mut self) {
        self.stops.fetch_add(1, Ordering::Relaxed);
        self.hand.stop();
    }
}

#[test]
fn a_driver_that_fails_is_stopped_and_told() {
    let hand = HandModel::allegro_v4(HandSide::Right);
    let (stops, written) = (Arc::<AtomicU64>::default(), Arc::<Mutex<Vec<_>>>::default());
    let driver = Unplugged {
        hand: SimHand::new(&hand, 1.0 / RATE),
        reads: 50,
        stops: Arc::clone(&stops),
        written: Arc::clone(&written),
    };
    let controller = Controller::new(hand, MappingParams::default(), ControlParams::default()).unwrap();
    let (control, mut link) = ControlThread::start(controller, Box::new(driver), RATE, Realtime::Off).unwrap();
    let mut records = Vec::new();
    eventually("the loop has gone on for a while", || {
        while let Ok(record) = link.records.pop() {
            records.push(record);
        }
        records.len() > 150
    });
    assert!(control.is_running(), "the loop goes on, to tell of the fault");
    let failed = records.iter().position(|record| record.record.mode == Mode::Faulted).unwrap();
    assert_eq!(failed, 50);
    for record in &records[failed..] {
        assert_eq!((record.record.mode, record.record.fault), (Mode::Faulted, Fault::Driver));
        assert_eq!(record.driver_error, Some(DriverError::Disconnected));
        assert!(record.record.command.tau.iter().all(|tau| *tau == 0.0));
    }
    assert_eq!(written.lock().unwrap().len(), 50, "nothing is written to a hand that failed");
    assert!(stops.load(Ordering::Relaxed) >= 1);
}
