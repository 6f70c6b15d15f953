//! The authority against any sequence of events: what it promises holds after every step.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::time::Duration;

use proptest::prelude::*;
use teleop_common::authority::{Claim, Clutch, Heard, Latch, Lease, LeaseParams, Machine, MachineParams, Takeover};
use teleop_common::mode::Mode;
use teleop_common::time::MonoTime;

const MS: u64 = 1_000_000;
const HOLD_AFTER: Duration = Duration::from_millis(100);
const MAX_PERIOD: Duration = Duration::from_millis(100);
const MAX_AGE: f64 = 0.25;

#[derive(Clone, Copy, Debug)]
enum Event {
    /// A pose of one of three operators.
    Pose {
        operator: u64,
        sequence: i64,
        clutch: u32,
        age_ms: f64,
        takeover: bool,
        leaving: bool,
        known: bool,
    },
    /// Nothing comes for a while.
    Silence(u64),
    Stop,
    /// The reset of the stop so many stops ago.
    Reset(u32),
    /// A fault; seldom, since nothing comes after it.
    Fail,
}

fn event() -> impl Strategy<Value = Event> {
    let age = prop_oneof![8 => 0.0..60.0_f64, 1 => -50.0..3000.0_f64, 1 => Just(f64::NAN), 1 => Just(f64::INFINITY)];
    let pose = (1..4_u64, -3..6_i64, 0..3_u32, age, any::<(bool, bool)>(), 0..40_u32, 0..20_u32);
    prop_oneof![
        60 => pose.prop_map(|(operator, sequence, clutch, age_ms, (takeover, _), leaving, known)| Event::Pose {
            operator,
            sequence,
            clutch,
            age_ms,
            takeover,
            leaving: leaving == 0,
            known: known > 0,
        }),
        6 => (0..400_u64).prop_map(Event::Silence),
        1 => (0..9000_u64).prop_map(Event::Silence),
        1 => Just(Event::Stop),
        2 => (0..3_u32).prop_map(Event::Reset),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn promises(
        events in prop::collection::vec(event(), 1..400),
        fail_at in prop::option::weighted(0.2, 0..400_usize),
        permitted in prop_oneof![Just(Takeover::Never), Just(Takeover::Idle), Just(Takeover::Always)],
    ) {
        let mut lease = Lease::new(LeaseParams {
            max_age: Duration::from_secs_f64(MAX_AGE),
            release_after: Duration::from_secs(2),
            takeover: permitted,
        });
        let mut machine = Machine::new(MachineParams {
            hold_after: HOLD_AFTER,
            relax_after: Some(Duration::from_secs(3)),
            engage_ramp: Duration::from_millis(300),
        });
        let (mut latch, mut newest) = (Latch::default(), None::<Heard>);
        let mut sequences = [100_i64; 4];
        let mut clutches = [0_u32; 4];
        // The clutch of the operator that was armed last, when it was armed.
        let mut armed = None::<(u64, Clutch)>;
        let (mut now, mut failed) = (1000 * MS, false);
        for (index, event) in events.into_iter().enumerate() {
            let event = if fail_at == Some(index) { Event::Fail } else { event };
            let mut ticks = 3;
            match event {
                Event::Pose { operator, sequence, clutch, age_ms, takeover, leaving, known } => {
                    let slot = operator as usize;
                    // Mostly the next one, sometimes an old one or a leap.
                    let sequence = sequences[slot] + sequence;
                    sequences[slot] = sequences[slot].max(sequence);
                    // Closed, opened, or left.
                    clutches[slot] += u32::from(clutch == 0);
                    let claim = Claim {
                        epoch: operator,
                        sequence: sequence as u64,
                        age: known.then_some((age_ms * 1e-3, 0.001)),
                        takeover,
                        leaving,
                    };
                    let holder = lease.holder(MonoTime(now));
                    let follows = machine.mode().follows();
                    let admitted = lease.admit(MonoTime(now), &claim, follows).is_ok();
                    if admitted {
                        prop_assert!(known && age_ms <= MAX_AGE * 1e3, "an old pose passed");
                        if let Some(holder) = holder && holder != operator {
                            prop_assert!(takeover && permitted != Takeover::Never, "the robot was taken from its operator");
                            prop_assert!(permitted == Takeover::Always || !follows, "while it followed");
                        }
                        let at = MonoTime(now);
                        let clutch = Clutch(clutches[slot]);
                        newest = Some(Heard { epoch: operator, sequence: claim.sequence, captured: at, received: at, clutch });
                    }
                }
                Event::Silence(ms) => ticks = 1 + ms / 3,
                Event::Stop => latch = latch.stop(),
                Event::Reset(ago) => {
                    let before = latch;
                    latch = latch.reset(latch.asked.wrapping_sub(ago));
                    prop_assert!(latch == before || ago == 0);
                }
                Event::Fail => {
                    machine.fail(MonoTime(now));
                    failed = true;
                }
            }
            for _ in 0..ticks {
                now += 3 * MS;
                let before = machine.mode();
                let mode = machine.step(MonoTime(now), newest.as_ref(), latch);
                if failed {
                    prop_assert_eq!(mode, Mode::Faulted, "a fault is for ever");
                    continue;
                }
                if latch.is_stopped() {
                    prop_assert_eq!(mode, Mode::Stopped);
                } else if before == Mode::Stopped {
                    prop_assert_eq!(mode, Mode::Disarmed);
                }
                if mode == Mode::Armed && (before != mode || armed.map(|(epoch, _)| epoch) != newest.map(|heard| heard.epoch)) {
                    armed = newest.map(|heard| (heard.epoch, heard.clutch));
                }
                if mode.follows() {
                    let heard = newest.unwrap();
                    prop_assert!(heard.clutch.is_closed(), "it follows with the clutch open");
                    let silent = MonoTime(now).since(heard.received);
                    prop_assert!(silent <= HOLD_AFTER + MAX_PERIOD, "it follows after {:?} of silence", silent);
                    let (epoch, clutch) = armed.unwrap();
                    prop_assert_eq!(epoch, heard.epoch, "it follows an operator that was not armed");
                    prop_assert!(heard.clutch.closed_since(clutch), "the clutch was not closed since the hand was armed");
                }
                if before.follows() && MonoTime(now).since(newest.unwrap().received) > machine.patience() && !latch.is_stopped() {
                    prop_assert_eq!(mode, Mode::Holding, "one tick after the patience ended");
                }
                if mode == Mode::Engaged {
                    prop_assert!(matches!(before, Mode::Engaging | Mode::Engaged), "no ramp: from {}", before);
                }
            }
        }
    }
}
