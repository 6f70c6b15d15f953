//! The fingertips stay out of each other, at little cost.
#![allow(clippy::unwrap_used, missing_docs, reason = "tests")]

use proptest::prelude::*;
use teleop_common::guard::TipGuard;
use teleop_common::hand::{Finger, HandModel, HandSide, JointVector, MAX_FINGERS, TipFrame};
use teleop_common::mapping::{MappingOutput, MappingParams, Retargeter, Tuning};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};

const ALLOWANCE: f64 = 0.0005;

fn movable(mapping: &MappingOutput) -> [bool; MAX_FINGERS] {
    let mut out = [false; MAX_FINGERS];
    out.iter_mut().zip(mapping.fingers()).for_each(|(own, signals)| *own = signals.k > 0.0);
    out
}

fn gap(hand: &HandModel, q: &JointVector, finger: Finger) -> f64 {
    let pole = |wanted| {
        let chain = hand.fingers.iter().find(|chain| chain.finger == wanted).unwrap();
        chain.tip(&chain.select(q), TipFrame::Pole)
    };
    (pole(Finger::Thumb) - pole(finger)).norm()
}

#[test]
fn in_every_gesture_the_tips_are_apart_and_touches_remain_touches() {
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        let guard = TipGuard::new(&hand, ALLOWANCE);
        let (mut overlapping, mut deepest, mut widest) = (0, f64::NEG_INFINITY, 0.0_f64);
        for gesture in Gesture::ALL {
            let mut retargeter = Retargeter::new(hand.clone(), MappingParams::default()).unwrap();
            let mut last: Option<(JointVector, JointVector)> = None;
            for n in 0..3000 {
                let q = gesture.sample(f64::from(n) * 0.01);
                let mapping = retargeter.map(&MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None });
                let movable = movable(&mapping);
                let before = guard.deepest(&hand, &mapping.q);
                let x = guard.apart(&hand, &mapping.q, &movable);
                if before <= ALLOWANCE {
                    assert_eq!(x, mapping.q, "{}: nothing to do", gesture.name());
                } else {
                    overlapping += 1;
                }
                deepest = deepest.max(guard.deepest(&hand, &x));
                for (slot, chain) in hand.fingers.iter().enumerate().filter(|(slot, _)| !movable[*slot]) {
                    assert_eq!(chain.select(&x), chain.select(&mapping.q), "finger {slot} only copies the shape");
                }
                for signals in mapping.fingers().iter().skip(1).filter(|signals| signals.delta < 0.001) {
                    widest = widest.max(gap(&hand, &x, signals.finger));
                }
                if let Some((mapped, guarded)) = last.replace((mapping.q, x)) {
                    let step = |a: &JointVector, b: &JointVector| {
                        a.iter().zip(b.iter()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
                    };
                    let (pure, own) = (step(&mapped, &mapping.q), step(&guarded, &x));
                    assert!(own <= pure + 0.02, "{} at {n}: a step of {own} rad out of {pure}", gesture.name());
                }
            }
        }
        assert!(overlapping > 300, "only {overlapping} postures tested anything");
        assert!(deepest < ALLOWANCE + 1e-4, "{deepest} m of overlap left");
        assert!(widest < 0.0035, "a touch became a gap of {widest} m");
    }
}

#[test]
fn a_tripod_of_a_tracked_person_stays_a_tripod() {
    // Keypoints lie inside the fingertips: index and middle finger are both sent to the very tip of the thumb.
    let tuning =
        Tuning { scale: [1.3, 1.5, 1.3, 1.6, 1.3], r1: 0.033, r2: 0.08, contact: [0.0, 0.028, 0.028, 0.028, 0.028] };
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        let guard = TipGuard::new(&hand, ALLOWANCE);
        for gesture in [Gesture::Tripod, Gesture::TripodClose] {
            let mut retargeter = Retargeter::new(hand.clone(), MappingParams::default()).unwrap();
            let (mut tripods, mut widest, mut deepest) = (0, 0.0_f64, f64::NEG_INFINITY);
            for n in 0..(gesture.duration() * 30.0) as u32 {
                let q = gesture.sample(f64::from(n) / 30.0);
                let pose = MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: Some(tuning) };
                let mapping = retargeter.map(&pose);
                let x = guard.apart(&hand, &mapping.q, &movable(&mapping));
                deepest = deepest.max(guard.deepest(&hand, &x));
                if [Finger::Index, Finger::Middle].iter().all(|&finger| gap(&hand, &mapping.q, finger) < 0.002) {
                    tripods += 1;
                    widest = widest.max(gap(&hand, &x, Finger::Index)).max(gap(&hand, &x, Finger::Middle));
                }
            }
            println!("{side:?} {}: {tripods} frames, gaps up to {widest} m, overlap {deepest} m", gesture.name());
            assert!(tripods > 30, "only {tripods} postures tested anything");
            assert!(widest < 0.015, "{}: a touch became a gap of {widest} m", gesture.name());
            assert!(deepest < ALLOWANCE + 1e-4, "{}: {deepest} m of overlap left", gesture.name());
        }
    }
}

#[test]
fn two_fingers_that_meet_at_the_thumb_part_sideways_and_stay_there() {
    // Of the recorded hand: thumb, index and middle finger at one point, the distal phalanges 3 mm from each other.
    let hand = HandModel::allegro_v4(HandSide::Right);
    let guard = TipGuard::new(&hand, ALLOWANCE);
    let q = JointVector::from_slice(&[
        -0.231, 0.432, 1.051, 1.618, 0.47, 0.335, 1.282, 1.196, 0.146, 0.617, 1.277, 0.905, 1.396, 0.029, 1.365, 0.007,
    ]);
    assert!([Finger::Index, Finger::Middle].iter().all(|&finger| gap(&hand, &q, finger) < 0.002));
    let x = guard.apart(&hand, &q, &[true; MAX_FINGERS]);
    let [index, middle] = [Finger::Index, Finger::Middle].map(|finger| gap(&hand, &x, finger));
    assert!(index < 0.010 && middle < 0.010, "gaps of {index} and {middle} m");
    assert!(guard.deepest(&hand, &x) < ALLOWANCE + 1e-4);
}

proptest! {
    #[test]
    fn any_posture_ends_in_the_box_and_never_deeper(shares in prop::collection::vec(0.0..=1.0, 16), mask in any::<[bool; 5]>()) {
        let hand = HandModel::allegro_v4(HandSide::Right);
        let guard = TipGuard::new(&hand, ALLOWANCE);
        let mut q = hand.home();
        for ((value, joint), share) in q.iter_mut().zip(&hand.joints).zip(&shares) {
            *value = joint.lower + (joint.upper - joint.lower) * share;
        }
        let x = guard.apart(&hand, &q, &mask);
        prop_assert!(x.iter().zip(&hand.joints).all(|(value, joint)| (joint.lower..=joint.upper).contains(value)));
        prop_assert!(guard.deepest(&hand, &x) <= guard.deepest(&hand, &q));
    }
}
