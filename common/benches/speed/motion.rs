//! The guard of the commands, on what the control loop asks of it.

use std::hint::black_box;

use teleop_common::conditioner::Conditioner;
use teleop_common::guard::{Intervention, MotionGuard, TipGuard};
use teleop_common::hand::{HandModel, JointVector, MAX_FINGERS};
use teleop_common::mapping::{MappingParams, Retargeter};
use teleop_common::master::MasterPose;

use crate::suite::Suite;
use crate::{TIP_OVERLAP, guarded};

/// The control loop's default, s.
const PERIOD: f64 = 1.0 / 333.0;

/// One tick's question.
#[derive(Clone)]
struct Case {
    q: JointVector,
    movable: [bool; MAX_FINGERS],
    velocity: JointVector,
    range: [JointVector; 2],
    answer: Intervention,
}

/// All ticks while the hand follows `targets`, each for so many ticks.
fn drive(hand: &HandModel, targets: &[(JointVector, [bool; MAX_FINGERS], usize)]) -> Vec<Case> {
    let guard = MotionGuard::new(hand, TIP_OVERLAP);
    let mut conditioner = Conditioner::new(hand, &hand.home(), PERIOD, 0.008);
    let mut out = Vec::new();
    for (target, movable, ticks) in targets {
        for _ in 0..*ticks {
            conditioner.follow(target, f64::INFINITY, |q, velocity, [low, high]| {
                let before = *velocity;
                let answer = guard.guard(hand, q, movable, velocity, [low, high], PERIOD);
                out.push(Case { q: *q, movable: *movable, velocity: before, range: [*low, *high], answer });
            });
        }
    }
    out
}

fn measure(suite: &mut Suite, name: &str, hand: &HandModel, cases: &[Case]) {
    let guard = MotionGuard::new(hand, TIP_OVERLAP);
    suite.run(name, cases, |case| {
        let mut velocity = case.velocity;
        let range = [&case.range[0], &case.range[1]];
        black_box(guard.guard(hand, &case.q, &case.movable, &mut velocity, range, PERIOD));
    });
}

/// While mapped poses are followed that come `rate` times a second.
pub(crate) fn poses(suite: &mut Suite, name: &str, hand: &HandModel, poses: &[MasterPose], rate: f64) {
    let mut retargeter = Retargeter::new(hand.clone(), MappingParams::default()).unwrap();
    let tips = TipGuard::new(hand, TIP_OVERLAP);
    let ticks = (1.0 / (rate * PERIOD)).round() as usize;
    let targets: Vec<_> = poses
        .iter()
        .map(|pose| {
            let output = retargeter.map(pose);
            let mut movable = [false; MAX_FINGERS];
            movable.iter_mut().zip(output.fingers()).for_each(|(own, signals)| *own = signals.k > 0.0);
            (guarded(&tips, hand, &output), movable, ticks)
        })
        .collect();
    measure(suite, &format!("motion guard, {name}"), hand, &drive(hand, &targets));
}

/// While targets jump through the whole joint box, by what the guard has to do.
pub(crate) fn jumps(suite: &mut Suite, hand: &HandModel) {
    let targets: Vec<_> = (0..400_u32)
        .map(|n| {
            let mut target = hand.home();
            for (index, (value, joint)) in target.iter_mut().zip(&hand.joints).enumerate() {
                // Low-discrepancy numbers in 0..1 instead of random ones.
                let share = (f64::from(n) * (index as f64 + 2.0).sqrt()).fract();
                *value = joint.lower + (joint.upper - joint.lower) * share;
            }
            (target, [true; MAX_FINGERS], 1 + n as usize % 90)
        })
        .collect();
    let cases = drive(hand, &targets);
    for (name, answer) in
        [("nothing to do", Intervention::None), ("slowing", Intervention::Slowed), ("braking", Intervention::Braked)]
    {
        let own: Vec<Case> = cases.iter().filter(|case| case.answer == answer).cloned().collect();
        measure(suite, &format!("motion guard, jumps, {name}"), hand, &own);
    }
}
