//! The fingertips stay out of each other, at little cost.
#![allow(clippy::unwrap_used, missing_docs, reason = "tests")]

use proptest::prelude::*;
use teleop_common::guard::TipGuard;
use teleop_common::hand::{Finger, HandModel, HandSide, JointVector, MAX_FINGERS, TipFrame};
use teleop_common::mapping::{MappingOutput, MappingParams, Retargeter};
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
