//! Contacts first: a thumb and a finger that cannot keep up meet before they take up their postures.
//!
//! Speed and acceleration are limited joint by joint, so every joint arrives in its own time, and two tips meet when the
//! last one has. The joints of both can share the way instead: of the velocities v that the limits allow in this tick,
//! [`close`] takes those that minimise
//!
//! ```text
//! sum_f w_f^2 ||r_f(q) - r_f(target) + T (J_f v_f - J_T v_T)||^2 + mu^2 T^2 ||v - wanted||^2,    low <= v <= high
//! ```
//!
//! with r_f the vector from the thumb's pole to the finger's and J its derivatives. The weight w_f is the finger's gain k
//! (Eq. 14), and nothing for one that the target does not bring nearer to the thumb: a hand opens as its joints can. At
//! the target nothing is left of it, so that it changes the way there and not the posture. Solved by coordinate descent;
//! an early end costs no more than some of the speed gained.

use nalgebra::{SVector, Vector3};

use crate::hand::{Finger, FingerChain, HandModel, JointVector, MAX_FINGERS, TipFrame, TipJacobian};

/// T, s: a joint brakes from full speed in about that time.
const HORIZON: f64 = 0.02;
/// mu: what a rad/s beside the wanted velocity weighs against a m/s between the poles, m/rad.
const POSTURE_WEIGHT: f64 = 0.03;
/// A finger counts in full if it is to come nearer to the thumb by this much, m.
const FULL: f64 = 0.01;
/// Rounds over the joints.
const SWEEPS: usize = 12;

/// A finger on its way to the thumb.
#[derive(Clone, Copy)]
struct Opposed<'a> {
    chain: &'a FingerChain,
    // T J, m per rad/s.
    jacobian: TipJacobian,
    // w^2, and the vector that would be left after T, m.
    weight: f64,
    left: Vector3<f64>,
}

/// Changes `velocity` (rad/s, wire order), about to be commanded at posture `q` (rad), so that tips meet sooner.
///
/// Each joint stays between `low` and `high` (rad/s); those of fingers with gain 0 are not touched. `gains` are of the
/// hand's fingers, in its order. Does not allocate; bounded work.
pub fn close(
    hand: &HandModel,
    gains: &[f64; MAX_FINGERS],
    q: &JointVector,
    target: &JointVector,
    velocity: &mut JointVector,
    range: [&JointVector; 2],
) {
    let Some(thumb) = hand.fingers.iter().find(|chain| chain.finger == Finger::Thumb) else { return };
    let pole = |chain: &FingerChain, q: &JointVector| chain.tip(&chain.select(q)[..chain.joints.len()], TipFrame::Pole);
    let moving = |chain: &FingerChain, velocity: &JointVector| {
        let (pole, jacobian) = chain.tip_and_jacobian(&chain.select(q)[..chain.joints.len()], TipFrame::Pole);
        (pole, jacobian * HORIZON, jacobian * SVector::from(chain.select(velocity)) * HORIZON)
    };
    let (own, own_jacobian, own_way) = moving(thumb, velocity);
    let mut opposed = [Opposed { chain: thumb, jacobian: own_jacobian, weight: 0.0, left: own }; MAX_FINGERS];
    let mut count = 0;
    for (chain, gain) in hand.fingers.iter().zip(gains).filter(|(chain, _)| chain.finger != Finger::Thumb) {
        if *gain > 0.0 {
            let (other, jacobian, way) = moving(chain, velocity);
            let (now, then) = (other - own, pole(chain, target) - pole(thumb, target));
            let weight = (gain * ((now.norm() - then.norm()) / FULL).clamp(0.0, 1.0)).powi(2);
            // Not for a target that is no number.
            if weight > 0.0 {
                opposed[count] = Opposed { chain, jacobian, weight, left: now + way - own_way - then };
                count += 1;
            }
        }
    }
    let opposed = &mut opposed[..count];
    if opposed.is_empty() {
        return;
    }
    let wanted = *velocity;
    for _ in 0..SWEEPS {
        for (slot, joint) in thumb.joints.iter().enumerate() {
            improve(joint.joint, slot, Some(&own_jacobian), opposed, &wanted, velocity, range);
        }
        for finger in opposed.iter_mut() {
            for (slot, joint) in finger.chain.joints.iter().enumerate() {
                improve(joint.joint, slot, None, std::slice::from_mut(finger), &wanted, velocity, range);
            }
        }
    }
}

/// Gives one joint its best velocity: it moves the poles of `fingers`, or, by the slope given, the thumb's.
fn improve(
    joint: usize,
    slot: usize,
    thumb: Option<&TipJacobian>,
    fingers: &mut [Opposed<'_>],
    wanted: &JointVector,
    velocity: &mut JointVector,
    [low, high]: [&JointVector; 2],
) {
    let slope = |finger: &Opposed<'_>| match thumb {
        Some(own) => -own.column(slot),
        None => finger.jacobian.column(slot).into_owned(),
    };
    let own = (POSTURE_WEIGHT * HORIZON).powi(2);
    let (mut gradient, mut curvature) = (own * (velocity[joint] - wanted[joint]), own);
    for finger in fingers.iter() {
        let slope = slope(finger);
        gradient += finger.weight * slope.dot(&finger.left);
        curvature += finger.weight * slope.norm_squared();
    }
    let next = (velocity[joint] - gradient / curvature).max(low[joint]).min(high[joint]);
    for finger in fingers {
        let slope = slope(finger);
        finger.left += slope * (next - velocity[joint]);
    }
    velocity[joint] = next;
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::conditioner::Conditioner;
    use crate::hand::HandSide;

    const PERIOD: f64 = 0.003;
    /// Thumb and index at it; the others copy the human's shape.
    const GAINS: [f64; MAX_FINGERS] = [1.0, 1.0, 0.0, 0.0, 0.0];

    fn in_box(hand: &HandModel, shares: &[f64]) -> JointVector {
        let mut q = hand.home();
        for ((value, joint), share) in q.iter_mut().zip(&hand.joints).zip(shares) {
            *value = joint.lower + (joint.upper - joint.lower) * share;
        }
        q
    }

    fn gap(hand: &HandModel, q: &JointVector) -> f64 {
        let pole = |slot: usize| hand.fingers[slot].tip(&hand.fingers[slot].select(q), TipFrame::Pole);
        (pole(1) - pole(0)).norm()
    }

    /// A posture of thumb and index at one point, as the recorded hand pinches.
    fn pinch(hand: &HandModel) -> JointVector {
        let mut q = hand.home();
        q[..4].copy_from_slice(&[-0.231, 0.432, 1.051, 1.618]);
        q[12..16].copy_from_slice(&[1.396, 0.029, 1.365, 0.007]);
        assert!(gap(hand, &q) < 0.002);
        q
    }

    /// Ticks until the tips are within 2 mm, and the commands.
    fn approach(target: &JointVector, closing: bool) -> (usize, Vec<JointVector>) {
        let hand = HandModel::allegro_v4(HandSide::Right);
        let mut conditioner = Conditioner::new(&hand, &hand.home(), PERIOD, 0.008);
        let mut commands = Vec::new();
        for _ in 0..400 {
            conditioner.follow(target, f64::INFINITY, |q, velocity, range| {
                if closing {
                    close(&hand, &GAINS, q, target, velocity, range);
                }
            });
            commands.push(*conditioner.position());
        }
        let met = commands.iter().position(|q| gap(&hand, q) < 0.002).unwrap_or(usize::MAX);
        (met, commands)
    }

    #[test]
    fn tips_meet_sooner_and_the_posture_is_the_same_in_the_end() {
        let hand = HandModel::allegro_v4(HandSide::Right);
        let target = pinch(&hand);
        let ((alone, _), (shared, commands)) = (approach(&target, false), approach(&target, true));
        assert!(4 * shared < 3 * alone, "{shared} ticks instead of {alone}");
        assert!(commands[399].iter().zip(target.iter()).all(|(a, b)| (a - b).abs() < 1e-6));
        // While the posture is taken up they stay together, but for what the joints cannot make even.
        assert!(commands[shared..].iter().all(|q| gap(&hand, q) < 0.004));
    }

    #[test]
    fn a_hand_that_opens_and_a_target_that_is_no_number_are_left_alone() {
        let hand = HandModel::allegro_v4(HandSide::Right);
        let limits = [JointVector::from_slice(&[-7.0; 16]), JointVector::from_slice(&[7.0; 16])];
        let wanted = JointVector::from_slice(&[1.0; 16]);
        let mut target = hand.home();
        for nan in [false, true] {
            target[1] = if nan { f64::NAN } else { target[1] };
            let mut velocity = wanted;
            close(&hand, &GAINS, &pinch(&hand), &target, &mut velocity, [&limits[0], &limits[1]]);
            assert_eq!(velocity, wanted);
        }
    }

    proptest! {
        #[test]
        fn stays_within_the_limits_and_off_the_other_fingers(
            from in prop::collection::vec(0.0..=1.0, 16),
            to in prop::collection::vec(0.0..=1.0, 16),
            wanted in prop::collection::vec(-7.0..=7.0, 16),
            gains in prop::collection::vec(0.0..=1.0_f64, 4),
        ) {
            let hand = HandModel::allegro_v4(HandSide::Right);
            let (q, target) = (in_box(&hand, &from), in_box(&hand, &to));
            let wanted = JointVector::from_slice(&wanted);
            let (mut low, mut high) = (wanted, wanted);
            low.iter_mut().for_each(|value| *value = (*value - 0.9).max(-7.0));
            high.iter_mut().for_each(|value| *value = (*value + 0.9).min(7.0));
            let mut own = [0.0; MAX_FINGERS];
            own[..4].copy_from_slice(&gains);
            own[2] = 0.0;
            let mut velocity = wanted;
            close(&hand, &own, &q, &target, &mut velocity, [&low, &high]);
            for joint in 0..16 {
                prop_assert!(velocity[joint] >= low[joint] && velocity[joint] <= high[joint]);
            }
            prop_assert_eq!(&velocity[4..8], &wanted[4..8], "the middle finger has gain 0");
        }
    }
}
