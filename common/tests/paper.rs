//! The paper's tables and figures as numbers: closed forms, spot values, an independent numerical reference, properties.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::f64::consts::{PI, TAU};

use nalgebra::Vector2;
use proptest::prelude::*;
use teleop_common::hand::{Finger, HandModel, HandSide, JointVector};
use teleop_common::mapping::{Gain, GainShape, MappingMode, MappingParams};
use teleop_common::master::{FINGER_TAPS, Gesture, MasterGeometry};
use teleop_common::paper::fig6::Tap;
use teleop_common::paper::{Check, fig2, fig4, fig6, fig8, motion, smoothness, table1};

fn hand() -> HandModel {
    HandModel::allegro_v4(HandSide::Right)
}

#[track_caller]
fn assert_near(what: &str, value: f64, expected: f64, tolerance: f64) {
    assert!((value - expected).abs() <= tolerance, "{what}: {value}, expected {expected} +- {tolerance}");
}

fn value(check: &Check, name: &str) -> f64 {
    check.values.iter().find(|(own, _)| own == name).unwrap_or_else(|| panic!("{name} in {check:?}")).1
}

fn check<'a>(checks: &'a [Check], name: &str) -> &'a Check {
    checks.iter().find(|check| check.name == name).unwrap()
}

#[test]
fn table_1_is_the_printed_one_and_the_models() {
    assert_near("c_s", table1::printed_scale(), 2.7, 1e-12);
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        for chain in &hand.fingers {
            let model = table1::lengths(&hand, chain).unwrap();
            let expected =
                if chain.finger == Finger::Thumb { [0.0576, 0.0514, 0.0543] } else { [0.054, 0.0384, 0.0387] };
            let (_, printed) = table1::ALLEGRO.into_iter().find(|(finger, _)| *finger == chain.finger).unwrap();
            for phalanx in 0..3 {
                assert_near(chain.finger.name(), model[phalanx], expected[phalanx], 1e-9);
                // Printed without the tenths.
                assert_eq!(printed[phalanx], (model[phalanx] * 1e3 + 1e-9).floor() / 1e3);
            }
        }
        for (_, _, ratio) in table1::spacing_ratios(&hand, &MasterGeometry::PARADIGMATIC) {
            assert_near("d", ratio, 2.808_085, 1e-6);
        }
    }
}

#[test]
fn fig2_covers_455_combinations_that_all_reach() {
    let combinations = fig2::combinations();
    assert_eq!(combinations.len(), 455);
    for lengths in &combinations {
        assert!(lengths.iter().sum::<f64>() >= 0.082 - 1e-12);
    }
    for q in fig2::POSTURES_DEG.map(|q| q.map(f64::to_radians)) {
        let losses = fig2::losses(&q);
        assert_eq!(losses.len(), 455);
        let target = fig2::tip(&fig2::MASTER, &q);
        for loss in &losses {
            let own = std::array::from_fn(|joint| q[joint] + loss.shape[joint]);
            assert!((fig2::tip(&loss.lengths, &own) - target).norm() < 1e-12, "{:?} misses", loss.lengths);
            // (b) is a sum over the phalanges.
            let (mut angle, mut y) = (0.0, 0.0);
            for (phalanx, joint) in q.iter().enumerate() {
                angle += joint;
                y += (loss.lengths[phalanx] - fig2::MASTER[phalanx]) * f64::cos(angle);
            }
            assert_near("error along y", loss.position[0], y, 1e-15);
        }
    }
}

#[test]
fn the_same_finger_loses_nothing() {
    for q in fig2::POSTURES_DEG.map(|q| q.map(f64::to_radians)) {
        let own = fig2::nearest_posture(&fig2::MASTER, &fig2::tip(&fig2::MASTER, &q), &q).unwrap();
        for joint in 0..3 {
            assert_near("posture", own[joint], q[joint], 1e-9);
        }
    }
    assert!(fig2::nearest_posture(&[0.01; 3], &Vector2::new(0.031, 0.0), &[0.0; 3]).is_none());
}

/// The least cost of reaching the target, by brute force over another parameter: the first joint's angle.
fn brute_force(lengths: &[f64; 3], target: &Vector2<f64>, q: &[f64; 3], steps: usize) -> f64 {
    let [a1, a2, a3] = *lengths;
    let turn = |angle: f64| (angle + PI).rem_euclid(TAU) - PI;
    let mut least = f64::INFINITY;
    for step in 0..steps {
        let first = TAU * step as f64 / steps as f64;
        let rest = target - Vector2::new(first.cos(), first.sin()) * a1;
        let cosine = (rest.norm_squared() - a2 * a2 - a3 * a3) / (2.0 * a2 * a3);
        if cosine.abs() > 1.0 {
            continue;
        }
        for third in [cosine.acos(), -cosine.acos()] {
            let second = rest.y.atan2(rest.x) - (a3 * third.sin()).atan2(a2 + a3 * third.cos()) - first;
            let own = [first, second, third];
            least = least.min((0..3).map(|joint| turn(own[joint] - q[joint]).powi(2)).sum());
        }
    }
    least
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    #[test]
    fn the_nearest_posture_is_the_global_optimum(
        lengths in prop::array::uniform3(0.01..0.05_f64), q in prop::array::uniform3(0.0..1.9_f64),
    ) {
        let target = fig2::tip(&fig2::MASTER, &q);
        if let Some(own) = fig2::nearest_posture(&lengths, &target, &q) {
            prop_assert!((fig2::tip(&lengths, &own) - target).norm() < 1e-9);
            let cost: f64 = (0..3).map(|joint| (own[joint] - q[joint]).powi(2)).sum();
            let brute = brute_force(&lengths, &target, &q, 20_000);
            prop_assert!(cost <= brute + 1e-9, "{cost} is worse than {brute}");
        }
    }
}

#[test]
fn fig2_extremes_are_magnitudes_with_their_signs() {
    let losses = fig2::losses(&fig2::POSTURES_DEG[0].map(f64::to_radians));
    let y = fig2::extremes(&losses, |loss| loss.position[0] * 1e3).unwrap();
    assert_near("largest along y", y.max, -33.735_448, 1e-6);
    assert_eq!(y.max_at, [0.010, 0.025, 0.050]);
    assert!(losses.iter().all(|loss| (y.min.abs()..=y.max.abs()).contains(&(loss.position[0] * 1e3).abs())));
    let mean = losses.iter().map(|loss| loss.position[0].abs() * 1e3).sum::<f64>() / 455.0;
    assert_near("mean", y.mean, mean, 1e-9);
    assert_eq!(fig2::extremes(&[], |loss| loss.position[0]), None);
}

#[test]
fn the_printed_gain_jumps_and_is_upside_down() {
    let gain = Gain { r1: 0.020, r2: 0.040, shape: GainShape::Cosine };
    for (delta, k) in [(0.025, 0.853_553), (0.030, 0.5), (0.035, 0.146_447)] {
        assert_near("k", gain.at(delta), k, 1e-6);
        assert_near("printed", fig4::as_printed(&gain, delta), 1.0 - k, 1e-6);
    }
    // Jumps at r1 and r2 of the printed form, for radii in mm.
    for ([r1, r2], jumps) in [([20.0, 40.0], [-1.0, -1.0]), ([15.0, 45.0], [-0.5, -0.5]), ([40.0, 60.0], [0.0, 0.0])] {
        let gain = Gain { r1: r1 * 1e-3, r2: r2 * 1e-3, shape: GainShape::Cosine };
        for (radius, jump) in [gain.r1, gain.r2].into_iter().zip(jumps) {
            let step = |k: &dyn Fn(f64) -> f64| k(radius + 1e-9) - k(radius - 1e-9);
            assert_near("printed", step(&|delta| fig4::as_printed(&gain, delta)), jump, 1e-4);
            assert_near("corrected", step(&|delta| gain.at(delta)), 0.0, 1e-4);
        }
    }
}

fn taps(params: &MappingParams, gesture: Gesture) -> [Tap; 3] {
    fig6::MODES.map(|mode| fig6::tap(&hand(), params, gesture, mode).unwrap())
}

#[test]
fn fig6_agrees_with_the_reference() {
    // Fingertip distance minus c_s delta at contact, mm: joint, Cartesian, combined mapping.
    let paper = MappingParams::paper();
    for (gesture, finger, joint, other) in [
        (Gesture::TapIndex, Finger::Index, 72.4, 22.4),
        (Gesture::TapMiddle, Finger::Middle, 88.0, 4.5),
        (Gesture::TapRing, Finger::Ring, 84.7, 0.0),
        (Gesture::Tripod, Finger::Index, 65.3, 3.6),
        (Gesture::TapIndexClose, Finger::Index, 64.8, 0.0),
        (Gesture::TapMiddleClose, Finger::Middle, 69.5, 0.0),
    ] {
        for (tap, expected) in taps(&paper, gesture).iter().zip([joint, other, other]) {
            let own = tap.fingers.iter().find(|own| own.finger == finger).unwrap();
            assert!(own.involved);
            let what = format!("{gesture} {:?}", tap.mode);
            assert_near(&what, own.distance_error_peak.abs() * 1e3, expected, 0.1);
        }
    }
}

#[test]
fn mean_shape_errors_of_the_index_tap_agree_with_the_reference() {
    let at = |scale: f64| MappingParams { scale, ..MappingParams::paper() };
    for (params, cartesian, combined) in [(at(2.7), 1.23, 0.73), (at(1.6), 0.27, 0.08)] {
        for (tap, expected) in taps(&params, Gesture::TapIndex).iter().zip([0.0, cartesian, combined]) {
            let index = tap.fingers.iter().find(|own| own.finger == Finger::Index).unwrap();
            assert_near(&format!("{} {:?}", params.scale, tap.mode), index.e_q_mean, expected, 0.03);
        }
    }
}

#[test]
fn combined_mapping_keeps_the_shape_better_than_cartesian_mapping_and_meets_it_at_contact() {
    for params in [MappingParams::paper(), MappingParams::default()] {
        for gesture in fig6::TAPS {
            for check in fig6::checks(&hand(), &taps(&params, gesture)) {
                assert_eq!(check.holds, Some(true), "{check:?}");
            }
        }
    }
}

#[test]
fn fig8_has_its_properties_in_both_presets() {
    let hand = hand();
    for params in [MappingParams::paper(), MappingParams::default()] {
        for gesture in [Gesture::TripodFig8, Gesture::TripodCloseFig8] {
            let samples = fig8::signals(&hand, &params, gesture).unwrap();
            assert_eq!(samples.len(), 801);
            assert_eq!((samples[0].t, samples[800].t), (0.0, 80.0));
            let checks = fig8::checks(&hand, &params, &samples).unwrap();
            for check in &checks {
                // Where the paper's scale puts targets out of reach there is nothing to assert.
                let out_of_reach = check.name == "P2" && params.scale > 2.0 && gesture == Gesture::TripodFig8;
                assert_eq!(check.holds, if out_of_reach { None } else { Some(true) }, "{gesture} {check:?}");
                assert_eq!(check.note.contains("out of the hand's reach"), check.note.contains("not asserted"));
            }
            assert_eq!(
                checks.iter().map(|check| check.name).collect::<Vec<_>>(),
                ["P1", "P2", "P3", "P4", "P5", "P6", "P7"]
            );
        }
    }
}

#[test]
fn fig8_of_the_paper_agrees_with_the_reference() {
    let (hand, params) = (hand(), MappingParams::paper());
    let samples = fig8::signals(&hand, &params, Gesture::TripodFig8).unwrap();
    let checks = fig8::checks(&hand, &params, &samples).unwrap();
    let joint = check(&checks, "P1");
    for (finger, least, most) in [("thumb", 61.0, 79.0), ("index", 76.0, 92.0), ("middle", 88.0, 115.0)] {
        assert_near(finger, value(joint, &format!("{finger}_min_e_c_mm")), least, 0.6);
        assert_near(finger, value(joint, &format!("{finger}_max_e_c_mm")), most, 0.6);
    }
    let cartesian = check(&checks, "P2");
    for (finger, most) in [("thumb", 15.0), ("index", 14.0), ("middle", 22.0)] {
        assert_near(finger, value(cartesian, &format!("{finger}_max_e_c_mm")), most, 0.6);
    }
    for (gesture, [index, middle]) in [
        (Gesture::TripodFig8, [[29.3, 30.0, 30.9], [30.1, 30.8, 31.6]]),
        (Gesture::TripodCloseFig8, [[28.7, 29.4, 30.3], [29.6, 30.2, 31.1]]),
    ] {
        let samples = fig8::signals(&hand, &params, gesture).unwrap();
        for (finger, [leaves, half, reaches]) in [(Finger::Index, index), (Finger::Middle, middle)] {
            let times = fig8::rise(&samples, finger);
            assert_near("leaves 0", times.leaves, leaves, 0.051);
            assert_near("half", times.half, half, 0.11);
            assert_near("reaches 1", times.reaches, reaches, 0.051);
        }
        let curled = fig8::checks(&hand, &params, &samples).unwrap();
        if gesture == Gesture::TripodCloseFig8 {
            let cartesian = check(&curled, "P2");
            assert_near("index e_Q", value(cartesian, "index_min_e_q_rad"), 0.90, 0.02);
            assert_near("middle e_C", value(cartesian, "middle_max_e_c_mm"), 6.4, 0.1);
        }
    }
}

#[test]
fn a_gain_without_a_rise_has_no_times() {
    let params = MappingParams { mode: MappingMode::Joint, ..MappingParams::paper() };
    let samples = fig8::signals(&hand(), &params, Gesture::TripodFig8).unwrap();
    let times = fig8::rise(&samples, Finger::Index);
    assert!(times.leaves.is_nan() && times.half.is_nan() && times.reaches.is_nan());
}

#[test]
fn smoothness_of_known_motions() {
    let sampled = |q: &dyn Fn(f64) -> f64| -> Vec<JointVector> {
        (0..=1000).map(|tick| JointVector::from_slice(&[0.0, q(f64::from(tick) * 0.001)])).collect()
    };
    let still = smoothness::measure(&sampled(&|_| 0.3), 0.001);
    assert_eq!(still, smoothness::Smoothness::default());
    assert_eq!(smoothness::measure(&[], 0.001), smoothness::Smoothness::default());
    // A sine of amplitude 0.2 rad and 2 Hz.
    let w = 2.0 * TAU;
    let sine = smoothness::measure(&sampled(&|t| 0.2 * (w * t).sin()), 0.001);
    assert_near("speed", sine.peak_speed, 0.2 * w, 1e-3);
    assert_near("velocity jump", sine.velocity_jump, 0.2 * w * w * 0.001, 1e-4);
    assert_near("jerk", sine.peak_jerk, 0.2 * w.powi(3), 0.5);
    assert_near("RMS jerk", sine.rms_jerk, 0.2 * w.powi(3) / 2.0_f64.sqrt(), 0.5);
    // A corner of 1 rad/s.
    let corner = smoothness::measure(&sampled(&|t| (t - 0.5).max(0.0)), 0.001);
    assert_near("corner", corner.velocity_jump, 1.0, 1e-9);
}

#[test]
fn the_default_preset_is_smoother_than_the_papers() {
    let measured = |params: &MappingParams, gesture: Gesture| {
        let samples = motion::run(&hand(), params, gesture, 100.0).unwrap();
        assert_eq!(samples.len(), 451);
        let q: Vec<_> = samples.iter().map(|sample| sample.output.q).collect();
        smoothness::measure(&q, 0.01)
    };
    for gesture in FINGER_TAPS {
        let (paper, default) =
            (measured(&MappingParams::paper(), gesture), measured(&MappingParams::default(), gesture));
        assert!(default.peak_speed < paper.peak_speed, "{gesture}: {default:?}, paper {paper:?}");
        assert!(default.velocity_jump < paper.velocity_jump, "{gesture}: {default:?}, paper {paper:?}");
    }
}
