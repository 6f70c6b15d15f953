//! Lease, machine and stop latch in virtual time under any sequence of events, against what SAFETY.md promises. What
//! is expected is worked out here from the events alone, without the machine's own state.
#![no_main]

use std::time::Duration;

use arbitrary::Arbitrary;
use libfuzzer_sys::fuzz_target;
use teleop_common::authority::{Claim, Clutch, Heard, Lease, LeaseParams, Machine, MachineParams, StopLatch, Takeover};
use teleop_common::mode::Mode;
use teleop_common::time::MonoTime;

const MS: u64 = 1_000_000;
const HOLD_AFTER: Duration = Duration::from_millis(100);
const MAX_PERIOD: Duration = Duration::from_millis(100);
const MAX_AGE: Duration = Duration::from_millis(250);
const RELEASE_AFTER: Duration = Duration::from_secs(2);
const RELAX_AFTER: Duration = Duration::from_secs(3);
const RAMP: Duration = Duration::from_millis(300);
/// Events of one input.
const EVENTS: usize = 1500;

#[derive(Arbitrary, Debug)]
struct Input {
    takeover: u8,
    relaxes: bool,
    /// How many stops there were before.
    stops: u32,
    events: Vec<Event>,
}

#[derive(Arbitrary, Clone, Copy, Debug)]
enum Event {
    /// A good pose of an operator, as they come most of the time.
    Next {
        operator: u8,
        moves: bool,
    },
    /// Any pose.
    Pose {
        operator: u8,
        sequence: i16,
        moves: u8,
        age: Age,
        takeover: bool,
        leaving: bool,
    },
    /// Ticks every 3 ms.
    Ticks(u8),
    /// One tick after so many ms: the machine stalled, or nothing comes for long.
    Stall(u16),
    Stop,
    Reset(u32),
    /// The reset of the stop so many stops ago.
    ResetAgo(u8),
    ResetAny,
    /// Seldom, since nothing comes after it.
    Fail {
        really: u8,
    },
}

#[derive(Arbitrary, Clone, Copy, Debug)]
enum Age {
    Ms(i16),
    Any(f64, f64),
    Unknown,
}

impl Age {
    fn seconds(self) -> Option<(f64, f64)> {
        match self {
            Self::Ms(ms) => Some((f64::from(ms) * 1e-3, 0.001)),
            Self::Any(age, uncertainty) => Some((age, uncertainty)),
            Self::Unknown => None,
        }
    }
}

struct World {
    lease: Lease,
    machine: Machine,
    latch: StopLatch,
    takeover: Takeover,
    relaxes: bool,
    now: MonoTime,
    newest: Option<Heard>,
    /// The stop in force, by the events.
    stop: Option<u32>,
    failed: bool,
    /// The operator that a tick met last when it did not follow, or began to, and its clutch then.
    open: Option<(u64, Clutch)>,
    held_since: Option<MonoTime>,
    engaging_since: MonoTime,
}

fuzz_target!(|input: Input| {
    let takeover = [Takeover::Never, Takeover::Idle, Takeover::Always][usize::from(input.takeover) % 3];
    let mut world = World {
        lease: Lease::new(LeaseParams { max_age: MAX_AGE, release_after: RELEASE_AFTER, takeover }),
        machine: Machine::new(MachineParams {
            hold_after: HOLD_AFTER,
            relax_after: input.relaxes.then_some(RELAX_AFTER),
            engage_ramp: RAMP,
        }),
        latch: StopLatch::default(),
        takeover,
        relaxes: input.relaxes,
        now: MonoTime(1000 * MS),
        newest: None,
        stop: None,
        failed: false,
        open: None,
        held_since: None,
        engaging_since: MonoTime(0),
    };
    for _ in 0..input.stops % 3 {
        world.latch.stop();
        assert!(world.latch.reset_any());
    }
    let mut sequences = [100_i64; 4];
    let mut clutches = [0_u32; 4];
    for event in input.events.into_iter().take(EVENTS) {
        match event {
            Event::Next { operator, moves } => {
                let own = usize::from(operator % 4);
                sequences[own] += 1;
                clutches[own] = clutches[own].wrapping_add(moves.into());
                let claim = Claim {
                    epoch: own as u64,
                    sequence: sequences[own] as u64,
                    age: Some((0.02, 0.001)),
                    takeover: false,
                    leaving: false,
                };
                world.pose(&claim, Clutch(clutches[own]));
                world.tick(3 * MS);
            }
            Event::Pose { operator, sequence, moves, age, takeover, leaving } => {
                let own = usize::from(operator % 4);
                let sequence = (sequences[own] + i64::from(sequence)).max(0);
                sequences[own] = sequences[own].max(sequence);
                clutches[own] = clutches[own].wrapping_add(u32::from(moves % 4));
                let claim =
                    Claim { epoch: own as u64, sequence: sequence as u64, age: age.seconds(), takeover, leaving };
                world.pose(&claim, Clutch(clutches[own]));
                world.tick(3 * MS);
            }
            Event::Ticks(count) => (0..count).for_each(|_| world.tick(3 * MS)),
            Event::Stall(ms) => world.tick(u64::from(ms) * MS),
            Event::Stop => {
                assert_eq!(world.latch.stop(), world.stop.is_none());
                let number = world.latch.get().asked;
                assert!(world.stop.is_none_or(|stop| stop == number), "a stop in force changed its number");
                world.stop = Some(number);
            }
            Event::Reset(number) => world.reset(number),
            Event::ResetAgo(ago) => world.reset(world.latch.get().asked.wrapping_sub(ago.into())),
            Event::ResetAny => assert_eq!(world.latch.reset_any(), world.stop.take().is_some()),
            Event::Fail { really } => {
                if really == 255 {
                    world.machine.fail(world.now);
                    world.failed = true;
                }
            }
        }
    }
});

impl World {
    fn pose(&mut self, claim: &Claim, clutch: Clutch) {
        let (holder, follows) = (self.lease.holder(self.now), self.machine.mode().follows());
        let admitted = self.lease.admit(self.now, claim, follows).is_ok();
        let after = self.lease.holder(self.now);
        if !admitted {
            assert_eq!(after, holder, "a pose that is refused changed who has the robot");
            return;
        }
        let (age, uncertainty) = claim.age.expect("a pose of unknown age passed");
        let most = MAX_AGE.as_secs_f64();
        assert!(age <= most && uncertainty <= most, "a pose of {age} +- {uncertainty} s passed");
        if let Some(holder) = holder.filter(|holder| *holder != claim.epoch) {
            assert!(claim.takeover && self.takeover != Takeover::Never, "{holder} lost the robot to {}", claim.epoch);
            assert!(self.takeover == Takeover::Always || !follows, "{holder} lost the robot while it followed");
        }
        assert_eq!(after, (!claim.leaving).then_some(claim.epoch));
        if let Some(last) = self.newest.filter(|last| last.epoch == claim.epoch) {
            assert!(claim.sequence > last.sequence, "{} after {}", claim.sequence, last.sequence);
        }
        let again = self.lease.admit(self.now, claim, follows);
        assert!(again.is_err(), "the same pose passed twice");
        let captured = MonoTime(self.now.0 - 20 * MS);
        let (epoch, sequence) = (claim.epoch, claim.sequence);
        self.newest = Some(Heard { epoch, sequence, captured, received: self.now, clutch });
    }

    fn reset(&mut self, number: u32) {
        let right = self.stop == Some(number);
        assert_eq!(self.latch.reset(number), right, "reset of {number} while {:?} is in force", self.stop);
        if right {
            self.stop = None;
        }
    }

    fn tick(&mut self, passed: u64) {
        self.now = MonoTime(self.now.0 + passed);
        let now = self.now;
        let before = self.machine.mode();
        let latch = self.latch.get();
        assert_eq!(latch.is_stopped(), self.stop.is_some());
        let mode = self.machine.step(now, self.newest.as_ref(), latch);
        let patience = self.machine.patience();
        assert!(patience <= HOLD_AFTER + MAX_PERIOD);
        if self.failed {
            return assert_eq!(mode, Mode::Faulted, "a fault is for ever");
        }
        assert_ne!(mode, Mode::Faulted, "nothing failed");
        if self.stop.is_some() {
            assert_eq!(mode, Mode::Stopped);
        } else if before == Mode::Stopped {
            assert_eq!(mode, Mode::Disarmed, "after the reset");
        } else {
            assert_ne!(mode, Mode::Stopped, "without a stop");
        }
        let fresh = self.newest.filter(|heard| now.since(heard.received) <= patience);
        if mode.follows() {
            let heard = fresh.expect("it follows a pose that is too old");
            assert!(heard.clutch.is_closed(), "it follows with the clutch open");
            if !before.follows() {
                let (epoch, clutch) = self.open.expect("it follows an operator that it never met");
                assert!(matches!(before, Mode::Armed | Mode::Holding | Mode::Relaxed), "from {before}");
                assert_eq!(epoch, heard.epoch, "it follows an operator that it was not armed for");
                assert!(heard.clutch.closed_since(clutch), "from {clutch:?} to {:?}", heard.clutch);
                assert_eq!(mode, Mode::Engaging, "no ramp");
                self.engaging_since = now;
            } else if self.open.is_some_and(|(epoch, _)| epoch != heard.epoch) {
                panic!("it follows {} without its clutch", heard.epoch);
            }
            if mode == Mode::Engaged && before == Mode::Engaging {
                assert!(now.since(self.engaging_since) >= RAMP, "the ramp was cut short");
            }
            if mode == Mode::Engaging && before == Mode::Engaged {
                self.engaging_since = now;
            }
        }
        if before.follows() && fresh.is_none() && self.stop.is_none() {
            assert_eq!(mode, Mode::Holding, "poses stopped");
        }
        if mode == Mode::Relaxed && before != mode {
            let since = self.held_since.expect("it never held");
            assert!(self.relaxes && before == Mode::Holding && now.since(since) >= RELAX_AFTER);
        }
        self.held_since = if mode == Mode::Holding { self.held_since.or(Some(now)) } else { None };
        // What the next closing is measured by.
        if let Some(heard) = fresh
            && !matches!(mode, Mode::Disarmed | Mode::Stopped)
        {
            self.open = Some((heard.epoch, heard.clutch));
        } else if matches!(mode, Mode::Disarmed | Mode::Stopped) {
            self.open = None;
        }
    }
}
