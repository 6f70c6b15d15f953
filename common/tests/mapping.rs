//! The mapping against closed forms, the paper's figures and an independent numerical reference.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use nalgebra::Vector3;
use proptest::prelude::*;
use teleop_common::hand::{Finger, HandModel, HandSide};
use teleop_common::ik::IkStatus;
use teleop_common::mapping::{
    Anchor, CartesianMap, MappingMode, MappingOutput, MappingParams, Pinned, Retargeter, ThumbMap, Tuning, TuningUse,
};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};

const MM: f64 = 1e-3;

fn hand() -> HandModel {
    HandModel::allegro_v4(HandSide::Right)
}

fn pose(q: [f64; 20]) -> MasterPose {
    MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None }
}

fn retargeter(params: MappingParams) -> Retargeter {
    Retargeter::new(hand(), params).unwrap()
}

/// The paper's scale and blend but for one parameter.
fn scaled(scale: f64, anchor: Anchor, joint_map: &str) -> MappingParams {
    MappingParams { scale, anchor, joint_map: joint_map.to_owned(), ..MappingParams::paper() }
}

/// Maps the closing half of a comparison run at 100 Hz and returns the output at the peak.
fn peak(retargeter: &mut Retargeter, gesture: Gesture) -> MappingOutput {
    (0..=200).map(|tick| retargeter.map(&pose(gesture.sample(f64::from(tick) * 0.01)))).last().unwrap()
}

fn pole_distance(output: &MappingOutput, finger: Finger) -> f64 {
    (output.finger(Finger::Thumb).unwrap().p - output.finger(finger).unwrap().p).norm()
}

#[test]
fn thumb_map_has_the_spot_values() {
    let map = CartesianMap::new(&hand(), 2.7);
    let geometry = MasterGeometry::PARADIGMATIC;
    for (x, expected) in [
        (24.0, 44.929_354),
        (8.0, 0.0),
        (-8.0, -44.929_354),
        (16.0, 22.464_677),
        (34.0, 71.929_354),
        (-18.0, -71.929_354),
    ] {
        let target = map.thumb(&geometry, &Vector3::new(x * MM, 73.0 * MM, 0.0));
        assert!((target.x / MM - expected).abs() < 1e-5, "x_S({x}) = {}", target.x / MM);
        assert!((target.y / MM - 14.795_593).abs() < 1e-5 && target.z.abs() < 1e-12);
    }
    let target = map.thumb(&geometry, &Vector3::new(0.0, 83.0, 20.0).scale(MM));
    assert!((target.y / MM - (14.795_593 + 27.0)).abs() < 1e-5 && (target.z / MM - 54.0).abs() < 1e-9);
}

proptest! {
    #[test]
    fn thumb_map_is_continuous_and_monotone(x in -0.08..0.08_f64, step in 0.0..0.002_f64, scale in 0.5..3.0_f64) {
        let map = CartesianMap::new(&hand(), scale);
        let at = |x: f64| map.thumb(&MasterGeometry::PARADIGMATIC, &Vector3::new(x, 0.05, 0.02)).x;
        prop_assert!(at(x + step) - at(x) >= 0.0);
        prop_assert!(at(x + step) - at(x) <= scale.max(2.81) * step + 1e-12);
    }
}

/// |p_ST - p_Sj| - c_s delta_j at the peaks, mm, computed independently with another solver.
#[test]
fn peaks_agree_with_the_reference() {
    use Gesture as G;
    type Row = (Gesture, &'static [(Finger, [f64; 4])]);
    let rows: [Row; 6] = [
        (G::TapIndex, &[(Finger::Index, [72.4, 22.4, 0.0, 0.0])]),
        (G::TapMiddle, &[(Finger::Middle, [88.0, 4.5, 0.0, 0.0])]),
        (G::TapRing, &[(Finger::Ring, [84.7, 0.0, 0.0, 0.0])]),
        (G::Tripod, &[(Finger::Index, [65.3, 3.6, 0.0, 0.0]), (Finger::Middle, [59.7, 3.3, 0.0, 0.0])]),
        (G::TapIndexClose, &[(Finger::Index, [64.8, 0.0, 0.0, 0.0])]),
        (G::TapMiddleClose, &[(Finger::Middle, [69.5, 0.0, 0.0, 0.0])]),
    ];
    let columns = [
        MappingParams { mode: MappingMode::Joint, ..scaled(2.7, Anchor::Reference, "role") },
        scaled(2.7, Anchor::Reference, "role"),
        scaled(2.7, Anchor::Projected, "role"),
        scaled(1.6, Anchor::Reference, "role"),
    ];
    for (gesture, fingers) in rows {
        for (column, params) in columns.iter().enumerate() {
            let output = peak(&mut retargeter(params.clone()), gesture);
            for &(finger, expected) in fingers {
                let delta = output.finger(finger).unwrap().delta;
                let error = pole_distance(&output, finger) - params.scale * delta;
                assert!(
                    (error.abs() / MM - expected[column]).abs() < 0.1,
                    "{gesture} {finger:?} column {column}: {:.2} mm, expected {} mm",
                    error / MM,
                    expected[column]
                );
            }
        }
    }
}

#[test]
fn taps_of_the_default_preset_close_and_leave_the_other_fingers_alone() {
    for (gesture, involved) in [
        (Gesture::TapIndex, &[Finger::Index] as &[Finger]),
        (Gesture::TapMiddle, &[Finger::Middle]),
        (Gesture::TapRing, &[Finger::Ring]),
        (Gesture::Tripod, &[Finger::Index, Finger::Middle]),
        (Gesture::TapIndexClose, &[Finger::Index]),
        (Gesture::TapMiddleClose, &[Finger::Middle]),
        (Gesture::TripodClose, &[Finger::Index, Finger::Middle]),
    ] {
        let mut retargeter = retargeter(MappingParams::default());
        let output = peak(&mut retargeter, gesture);
        for signals in output.fingers() {
            if involved.contains(&signals.finger) {
                let expected = retargeter.params().scale * signals.delta;
                let distance = pole_distance(&output, signals.finger);
                assert!((distance - expected).abs() < 0.5 * MM, "{gesture} {:?}: {distance} m", signals.finger);
                assert_eq!(signals.k, 1.0);
            } else if signals.finger != Finger::Thumb {
                assert_eq!((signals.k, signals.e_q), (0.0, 0.0), "{gesture} moves the {:?}", signals.finger);
            }
        }
    }
}

/// The tripod over 80 s at 10 Hz, as in the paper's Fig. 8.
fn fig8(params: MappingParams, gesture: Gesture) -> Vec<(f64, MappingOutput)> {
    let mut retargeter = retargeter(params);
    (0..800).map(|tick| f64::from(tick) * 0.1).map(|t| (t, retargeter.map(&pose(gesture.sample(t))))).collect()
}

#[test]
fn fig8_has_the_properties_of_a_joint_a_transition_and_a_cartesian_phase() {
    for params in [MappingParams::paper(), MappingParams::default()] {
        for gesture in [Gesture::TripodFig8, Gesture::TripodCloseFig8] {
            let run = fig8(params.clone(), gesture);
            for (t, output) in &run {
                let fingers: Vec<_> =
                    output.fingers().iter().filter(|signals| signals.finger != Finger::Thumb).collect();
                // P3: the thumb's gain is the closest finger's.
                let largest = fingers.iter().map(|signals| signals.k).fold(0.0, f64::max);
                assert_eq!(output.finger(Finger::Thumb).unwrap().k, largest);
                assert_eq!(output.finger(Finger::Ring).unwrap().k, 0.0);
                for signals in output.fingers() {
                    // P1: exactly the joint mapping where k = 0.
                    if signals.k == 0.0 {
                        assert_eq!(signals.e_q, 0.0);
                        assert_eq!(signals.ik.status, IkStatus::Skipped);
                        assert!(signals.e_c > 0.0, "{:?} at {t} s", signals.finger);
                        assert_eq!(signals.p_input, signals.p_joint);
                    }
                    if signals.k == 1.0 {
                        assert_eq!(signals.p_input, signals.p_cartesian);
                    }
                    // P6: Eq. 13.
                    let blend = signals.p_joint * (1.0 - signals.k) + signals.p_cartesian * signals.k;
                    assert!((signals.p_input - blend).norm() < 1e-12);
                }
            }
            // P3 and P5: symmetric about 40 s, rising before.
            for step in 1..=400 {
                for finger in [Finger::Thumb, Finger::Index, Finger::Middle] {
                    let k = |tick: usize| run[tick].1.finger(finger).unwrap().k;
                    assert!(k(step) >= k(step - 1), "{finger:?} at {step}");
                    if step < 400 {
                        assert!((k(400 - step) - k(400 + step)).abs() < 1e-9, "{finger:?} at 40 -+ {step} ticks");
                    }
                }
            }
            // P7: no jump of the input beyond its parts' motion and the blend's.
            for pair in run.windows(2) {
                for (before, after) in pair[0].1.fingers().iter().zip(pair[1].1.fingers()) {
                    let bound = (after.p_joint - before.p_joint).norm()
                        + (after.p_cartesian - before.p_cartesian).norm()
                        + std::f64::consts::PI
                            * (after.p_cartesian - after.p_joint)
                                .norm()
                                .max((before.p_cartesian - before.p_joint).norm())
                            * (after.delta - before.delta).abs()
                            / (2.0 * (params.r2 - params.r1));
                    assert!((after.p_input - before.p_input).norm() <= bound + 1e-12, "{:?}", after.finger);
                }
            }
        }
    }
}

#[test]
fn fig8_reaches_its_targets_in_the_cartesian_phase() {
    // P2: at 2.7 with the curled tripod for thumb and index; at 1.6 with both tripods for all three.
    let cases = [
        (MappingParams::paper(), Gesture::TripodCloseFig8, &[Finger::Thumb, Finger::Index] as &[Finger]),
        (scaled(1.6, Anchor::Reference, "role"), Gesture::TripodFig8, &[Finger::Thumb, Finger::Index, Finger::Middle]),
        (MappingParams::default(), Gesture::TripodFig8, &[Finger::Thumb, Finger::Index, Finger::Middle]),
        (MappingParams::default(), Gesture::TripodCloseFig8, &[Finger::Thumb, Finger::Index, Finger::Middle]),
    ];
    for (params, gesture, fingers) in cases {
        let mut seen = 0;
        for (t, output) in fig8(params, gesture) {
            for &finger in fingers {
                let signals = output.finger(finger).unwrap();
                if signals.k == 1.0 {
                    seen += 1;
                    assert!(signals.e_c < 1e-3 * MM, "{gesture} {finger:?} at {t} s: {} m", signals.e_c);
                    assert!(signals.e_q > 0.05, "{gesture} {finger:?} at {t} s: {} rad", signals.e_q);
                }
            }
        }
        assert!(seen > 100);
    }
}

#[test]
fn fig8_runs_on_the_papers_clock() {
    // P4: k leaves 0, passes 0.5 and reaches 1, s.
    for (gesture, finger, [leaves, half, full]) in [
        (Gesture::TripodFig8, Finger::Index, [29.3, 30.0, 30.9]),
        (Gesture::TripodFig8, Finger::Middle, [30.1, 30.8, 31.6]),
        (Gesture::TripodCloseFig8, Finger::Index, [28.7, 29.4, 30.3]),
        (Gesture::TripodCloseFig8, Finger::Middle, [29.6, 30.2, 31.1]),
    ] {
        let run = fig8(MappingParams::paper(), gesture);
        let first = |above: f64| run.iter().find(|(_, o)| o.finger(finger).unwrap().k > above).unwrap().0;
        for (name, value, expected) in
            [("leaves 0", first(0.0), leaves), ("passes 0.5", first(0.5), half), ("reaches 1", first(0.9999), full)]
        {
            assert!((value - expected).abs() < 0.11, "{gesture} {finger:?} {name} at {value} s, expected {expected}");
        }
    }
}

#[test]
fn both_hands_do_the_same() {
    let mut right = retargeter(MappingParams::default());
    let mut left = Retargeter::new(HandModel::allegro_v4(HandSide::Left), MappingParams::default()).unwrap();
    for tick in 0..2000 {
        let pose = pose(Gesture::Tour.sample(f64::from(tick) * 0.02));
        let (right, left) = (right.map(&pose), left.map(&pose));
        for (right, left) in right.fingers().iter().zip(left.fingers()) {
            assert_eq!(right.finger, left.finger);
            let mirrored = Vector3::new(left.p.x, -left.p.y, left.p.z);
            assert!((right.p - mirrored).norm() < 1e-6, "{:?} at tick {tick}", right.finger);
            assert!((right.e_q - left.e_q).abs() < 1e-4);
        }
    }
}

#[test]
fn the_tour_is_mapped_within_the_limits_and_without_jumps() {
    let hand = hand();
    let mut retargeter = retargeter(MappingParams::default());
    let mut last: Option<MappingOutput> = None;
    let (mut fastest, step) = (0.0_f64, 0.004);
    for tick in 0..(Gesture::Tour.duration() / step) as usize {
        let output = retargeter.map(&pose(Gesture::Tour.sample(tick as f64 * step)));
        for (q, joint) in output.q.iter().zip(&hand.joints) {
            assert!(*q >= joint.lower && *q <= joint.upper, "{}: {q}", joint.name);
        }
        if let Some(last) = last {
            for (q, before) in output.q.iter().zip(last.q.iter()) {
                fastest = fastest.max((q - before).abs() / step);
            }
        }
        last = Some(output);
    }
    assert!(fastest < 40.0, "{fastest} rad/s before conditioning");
}

#[test]
fn a_hand_without_ring_and_a_master_with_more_fingers_agree() {
    let mut model = hand();
    model.fingers.retain(|chain| chain.finger != Finger::Ring);
    let mut retargeter = Retargeter::new(model, MappingParams::default()).unwrap();
    let output = peak(&mut retargeter, Gesture::TapMiddle);
    assert_eq!(output.fingers().len(), 3);
    assert!(output.finger(Finger::Ring).is_none());
    assert!(pole_distance(&output, Finger::Middle) < 0.5 * MM);
}

proptest! {
    #[test]
    fn any_posture_gives_a_posture_inside_the_limits(
        q in prop::array::uniform20(-6.3..6.3_f64), paper: bool, mode in 0..5_usize,
    ) {
        use MappingMode as M;
        let mode = [M::Combined, M::Joint, M::Cartesian, M::Vector, M::DexPilot][mode];
        let preset = if paper { MappingParams::paper() } else { MappingParams::default() };
        let output = retargeter(MappingParams { mode, ..preset }).map(&pose(q));
        for (q, joint) in output.q.iter().zip(&hand().joints) {
            prop_assert!(*q >= joint.lower && *q <= joint.upper);
        }
        for signals in output.fingers() {
            prop_assert!(signals.p.iter().chain(signals.p_cartesian.iter()).all(|value| value.is_finite()));
            prop_assert!((0.0..=1.0).contains(&signals.k));
        }
    }
}

/// An operator whose keypoints touch at 20 mm.
const OPERATOR: Tuning =
    Tuning { scale: [1.5, 1.7, 1.8, 1.6, 1.6], r1: 0.025, r2: 0.090, contact: [0.0, 0.020, 0.021, 0.022, 0.0] };

#[test]
fn what_a_pose_says_about_its_operator_holds_but_for_what_is_pinned_or_fixed() {
    let params = MappingParams::default();
    let own = params.tuned(None);
    assert_eq!(own, Tuning { scale: [1.6; 5], r1: 0.020, r2: 0.080, contact: [0.0; 5] });
    assert_eq!(params.tuned(Some(&OPERATOR)), OPERATOR);
    assert_eq!(MappingParams::paper().tuned(Some(&OPERATOR)), MappingParams::paper().tuned(None));
    let fixed = MappingParams { tuning: TuningUse::Fixed, ..params.clone() };
    assert_eq!(fixed.tuned(Some(&OPERATOR)), own);

    let pinned = |scale, r1, r2| MappingParams { pinned: Pinned { scale, r1, r2 }, ..params.clone() };
    assert_eq!(pinned(true, false, false).tuned(Some(&OPERATOR)), Tuning { scale: own.scale, ..OPERATOR });
    assert_eq!(pinned(false, false, true).tuned(Some(&OPERATOR)), Tuning { r2: own.r2, ..OPERATOR });
    // Fingers do not touch beyond r1, where the mapping would not be Cartesian.
    let small = pinned(false, true, false).tuned(Some(&OPERATOR));
    assert_eq!(small, Tuning { r1: 0.020, contact: [0.0, 0.020, 0.020, 0.020, 0.0], ..OPERATOR });
    for (r1, r2) in [(true, false), (false, true), (true, true)] {
        for (own_r1, own_r2) in [(0.02, 0.021), (0.2, 0.21), (0.0001, 0.0012)] {
            let params = MappingParams { r1: own_r1, r2: own_r2, ..pinned(false, r1, r2) };
            let tuned = params.tuned(Some(&OPERATOR));
            tuned.validate().unwrap();
            assert!((!r1 || tuned.r1 == own_r1) && (!r2 || tuned.r2 == own_r2), "{tuned:?}");
        }
    }
}

#[test]
fn a_tuning_that_says_what_the_robot_says_changes_no_bit() {
    // But for the thumb of a tracked person, which is mapped otherwise.
    let params = || MappingParams { thumb_map: ThumbMap::Angles, ..MappingParams::default() };
    let mut plain = retargeter(params());
    let mut tuned = retargeter(params());
    let own = MappingParams::default().tuned(None);
    for tick in 0..3000 {
        let pose = pose(Gesture::Tour.sample(f64::from(tick) * 0.02));
        assert_eq!(plain.map(&pose), tuned.map(&MasterPose { tuning: Some(own), ..pose }), "tick {tick}");
    }
}

#[test]
fn fingers_that_touch_by_the_trackers_account_touch() {
    for (gesture, finger) in [
        (Gesture::TapIndex, Finger::Index),
        (Gesture::TapMiddle, Finger::Middle),
        (Gesture::TapIndexClose, Finger::Index),
        (Gesture::TapMiddleClose, Finger::Middle),
    ] {
        let mut retargeter = retargeter(MappingParams::default());
        let mut touched = 0;
        for tick in 0..=450 {
            let pose = MasterPose { tuning: Some(OPERATOR), ..pose(gesture.sample(f64::from(tick) * 0.01)) };
            let output = retargeter.map(&pose);
            let signals = output.finger(finger).unwrap();
            if signals.delta <= OPERATOR.contact[finger.index()] {
                touched += 1;
                let gap = pole_distance(&output, finger);
                assert!(gap < 0.1 * MM, "{gesture} at tick {tick}: {gap} m");
            }
            for other in output.fingers() {
                assert!(other.k > 0.0 || other.e_q == 0.0, "{gesture} disturbs the {:?}", other.finger);
            }
        }
        assert!(touched > 100, "{touched}");
    }
}

proptest! {
    /// P7 with the contact distances: the targets move no faster than their parts, for any tuning.
    #[test]
    fn a_tuned_target_moves_no_faster_than_its_contact_allows(
        q in prop::array::uniform20(0.0..1.5_f64), step in prop::array::uniform20(-1e-4..1e-4_f64),
    ) {
        let moved = std::array::from_fn(|joint| q[joint] + step[joint]);
        let map = |q| {
            let pose = MasterPose { tuning: Some(OPERATOR), ..pose(q) };
            (pose, retargeter(MappingParams { anchor: Anchor::Reference, ..MappingParams::default() }).map(&pose))
        };
        let ((before_pose, before), (after_pose, after)) = (map(q), map(moved));
        for (before, after) in before.fingers().iter().zip(after.fingers()) {
            let motion = |finger: Finger| (after_pose.tip(finger) - before_pose.tip(finger)).norm();
            let fastest = Finger::ALL.map(motion).into_iter().fold(0.0, f64::max);
            let offset = 0.022 + 0.004;
            let slope = 1.0 + 1.875 * offset / (0.090 - 0.022);
            // Of the meeting point: the thumb's own, half a removed vector's, and the change of weights (at most 1/2 per
            // 8 mm of difference between fingers, which part twice as fast as a tip moves, in vectors 2 offsets apart).
            let meeting = 1.0 + 0.5 * (2.0 * slope + 2.0 * 2.0 / 0.008 * offset);
            // The thumb's map has slope c_s or the ratio of the knuckles' spacings, per axis.
            let relative = if after.finger == Finger::Thumb { 0.0 } else { 1.8 * slope * 2.0 };
            let bound = (2.81 * meeting + relative) * fastest;
            prop_assert!((after.p_cartesian - before.p_cartesian).norm() <= bound + 1e-12, "{:?}", after.finger);
        }
    }
}
