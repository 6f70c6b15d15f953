//! Commands: conditioner and guard with arbitrary targets, numbers and none. No limit of position, velocity or
//! acceleration is exceeded, and the hand never gets more than a millimetre into itself, in any tick.
#![no_main]

use arbitrary::Arbitrary;
use libfuzzer_sys::fuzz_target;
use teleop_common::conditioner::Conditioner;
use teleop_common::guard::{MAX_PENETRATION, MotionGuard};
use teleop_common::hand::{JointVector, MAX_FINGERS};
use teleop_fuzz::{allegro, without_allocating};

/// Ticks of one input.
const TICKS: u32 = 200;
const ALLOWANCE: f64 = 0.0005;

#[derive(Arbitrary, Debug)]
struct Input {
    left: bool,
    smoothing_ms: u8,
    slow: bool,
    phases: Vec<Phase>,
}

#[derive(Arbitrary, Clone, Copy, Debug)]
struct Phase {
    target: [u8; 16],
    ticks: u8,
    /// Bits 0 to 4: the fingers that give way. 5: a hold. 6: a lower speed limit. 7: the phase before goes on alternating
    /// with this one.
    how: u8,
    speed: f64,
}

/// Through the joint's range and a quarter beyond each end; the last are none.
fn goal(code: u8, lower: f64, upper: f64) -> f64 {
    match code {
        255 => f64::NAN,
        254 => f64::INFINITY,
        253 => f64::NEG_INFINITY,
        252 => 1e300,
        251 => -1e300,
        code => lower + (upper - lower) * (f64::from(code) / 250.0 * 1.5 - 0.25),
    }
}

fuzz_target!(|input: Input| {
    let hand = allegro(input.left);
    let period = if input.slow { 0.010 } else { 1.0 / 333.0 };
    let guard = MotionGuard::new(hand, ALLOWANCE);
    let mut conditioner = Conditioner::new(hand, &hand.home(), period, f64::from(input.smoothing_ms % 50) * 1e-3);
    let (mut q, mut v) = (*conditioner.position(), *conditioner.velocity());
    let (mut ticks, mut other) = (0, hand.home());
    for phase in input.phases {
        let goals = hand.joints.iter().zip(phase.target).map(|(joint, code)| goal(code, joint.lower, joint.upper));
        let target = JointVector::from_slice(&goals.collect::<Vec<_>>());
        let movable: [bool; MAX_FINGERS] = std::array::from_fn(|finger| phase.how & (1 << finger) != 0);
        let speed = if phase.how & 64 == 0 { f64::INFINITY } else { phase.speed.abs() };
        for tick in 0..1 + phase.ticks % 64 {
            let target = if phase.how & 128 != 0 && tick % 2 == 1 { &other } else { &target };
            without_allocating(|| {
                if phase.how & 32 != 0 {
                    return conditioner.hold();
                }
                conditioner.follow(target, speed, |q, velocity, range| {
                    guard.guard(hand, q, &movable, velocity, range, period);
                });
            });
            let (next, velocity) = (*conditioner.position(), *conditioner.velocity());
            for (slot, joint) in hand.joints.iter().enumerate() {
                assert!((joint.lower..=joint.upper).contains(&next[slot]), "{} at {}", joint.name, next[slot]);
                let moving = (next[slot] - q[slot]) / period;
                assert!(moving.abs() <= joint.velocity * (1.0 + 1e-9), "{} at {moving} rad/s", joint.name);
                let change = (velocity[slot] - v[slot]).abs() / period;
                assert!(change <= joint.acceleration * (1.0 + 1e-6), "{} at {change} rad/s2", joint.name);
            }
            let gap = guard.least_gap(hand, &next);
            assert!(gap >= -MAX_PENETRATION, "the hand is {} m inside itself", -gap);
            (q, v) = (next, velocity);
            ticks += 1;
            if ticks == TICKS {
                return;
            }
        }
        other = target;
    }
});
