//! The fit: exactness, invariance, noise, the thumb, and the real recording.
#![allow(clippy::needless_range_loop, reason = "an index names a joint or an axis in several arrays")]

mod master_support;

use std::f64::consts::PI;

use master_support::{Noise, keypoints, moved, noisy, recorded};
use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;
use teleop_common::hand::{Finger, HandSide};
use teleop_common::master::{
    Calibrator, FINGER_TAPS, FIT_LIMITS, FitSettings, FitStatus, Fitter, Gesture, JOINT_LIMITS, Keypoints,
    MasterGeometry, MasterPose, PalmFrame,
};

const GEOMETRY: MasterGeometry = MasterGeometry::PARADIGMATIC;

fn fitter() -> Fitter {
    Fitter::new(GEOMETRY, HandSide::Right)
}

fn largest_difference(a: &[f64; 20], b: &[f64; 20]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// A posture inside the paradigmatic limits (the thumb's first joint inside the fit's, too) by 20 shares of them.
fn posture(shares: &[f64]) -> [f64; 20] {
    let mut q = [0.0; 20];
    for finger in Finger::ALL {
        for joint in 0..4 {
            let (range, fit) = (JOINT_LIMITS[finger.index()][joint], FIT_LIMITS[finger.index()][joint]);
            let max = range.max.min(fit.max);
            q[finger.index() * 4 + joint] = range.min + (max - range.min) * shares[finger.index() * 4 + joint];
        }
    }
    q
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn recovers_points_and_angles_from_nothing(shares in prop::collection::vec(0.05f64..0.95, 20)) {
        let q = posture(&shares);
        let keypoints = keypoints(&GEOMETRY, &q);
        let mut fitter = fitter();
        // The first frame has no posture to start from; the second starts from the first.
        fitter.fit(&keypoints);
        let fit = fitter.fit(&keypoints);
        for finger in Finger::ALL {
            let f = finger.index();
            prop_assert!(fit.fingers[f].residual < 5e-4, "{finger:?} {:?} {:?}", fit.fingers[f], &q[4 * f..4 * f + 4]);
            // Where the finger leaves the palm's normal, its angles are determined, too.
            let points = GEOMETRY.finger_points(finger, &[q[4 * f], q[4 * f + 1], q[4 * f + 2], q[4 * f + 3]]);
            let reach = (1..4).map(|k| (points[k] - points[0]).xy().norm()).fold(0.0, f64::max);
            if reach > 0.02 && q[4 * f + 1] < 1.4 {
                for joint in 4 * f..4 * f + 4 {
                    prop_assert!((fit.q[joint] - q[joint]).abs() < 1e-2, "{finger:?} {joint} {:?}", fit.q);
                }
            }
        }
    }

    #[test]
    fn where_the_hand_is_does_not_matter(
        axis in prop::array::uniform3(-PI..PI), t in prop::array::uniform3(-2.0f64..2.0), time in 0.0f64..60.0,
    ) {
        let hand = keypoints(&GEOMETRY, &Gesture::Tour.sample(time));
        let other = moved(&hand, &Rotation3::new(Vector3::from(axis)), Vector3::from(t));
        let (a, b) = (fitter().fit(&hand), fitter().fit(&other));
        prop_assert!(largest_difference(&a.q, &b.q) < 1e-3, "{:?} {:?}", a.q, b.q);
        // A left hand is the mirror image; its joint angles are the same.
        let left = Fitter::new(GEOMETRY, HandSide::Left).fit(&other.mirrored());
        prop_assert!(largest_difference(&a.q, &left.q) < 1e-3);
    }

    #[test]
    fn any_points_give_angles_inside_the_ranges(values in prop::collection::vec(-0.1f64..0.1, 63)) {
        let mut points = [[0.0; 3]; 21];
        points.as_flattened_mut().copy_from_slice(&values);
        if let Ok(keypoints) = Keypoints::new(points) {
            let fit = fitter().fit(&keypoints);
            for finger in Finger::ALL {
                for joint in 0..4 {
                    let q = fit.q[finger.index() * 4 + joint];
                    prop_assert!(FIT_LIMITS[finger.index()][joint].contains(q), "{finger:?} {joint} {q}");
                }
            }
            prop_assert!(fit.residual().is_finite());
        }
    }
}

#[test]
fn follows_every_gesture_without_noise() {
    for gesture in Gesture::ALL {
        let mut fitter = fitter();
        let (mut worst, mut tip) = (0f64, 0f64);
        for i in 0..(gesture.duration() * 100.0) as usize {
            let q = gesture.sample(i as f64 * 0.01);
            let fit = fitter.fit(&keypoints(&GEOMETRY, &q));
            worst = worst.max(largest_difference(&fit.q, &q));
            tip = fit.fingers.iter().map(|f| f.tip_error).fold(tip, f64::max);
        }
        println!("{gesture:18} angles within {worst:.5} rad, tips within {:.4} mm", tip * 1e3);
        assert!(worst < 0.05 && tip < 1e-4, "{gesture}: {worst} rad, {tip} m");
    }
}

#[test]
fn noise_does_not_flip_the_posture() {
    const SIGMA: f64 = 3e-3;
    const FRAMES: usize = 1000;
    for gesture in FINGER_TAPS.into_iter().chain([Gesture::Open, Gesture::Fist]) {
        let truth = gesture.posture().unwrap();
        let hand = keypoints(&GEOMETRY, &truth);
        let mut noise = Noise(11);
        let mut fitter = fitter();
        fitter.fit(&hand);
        let mut previous = truth;
        let (mut angle_squares, mut tip_squares, mut raw_squares, mut step) = ([0.0; 20], 0.0, 0.0, 0f64);
        let in_palm = |hand: &Keypoints, finger: Finger| {
            PalmFrame::estimate(hand).to_hand(HandSide::Right, &hand.finger(finger)[3])
        };
        for _ in 0..FRAMES {
            let seen = noisy(&hand, &mut noise, SIGMA);
            let fit = fitter.fit(&seen);
            for joint in 0..20 {
                angle_squares[joint] += (fit.q[joint] - truth[joint]).powi(2);
            }
            let (fitted, true_pose) = (
                MasterPose { q: fit.q, geometry: GEOMETRY, tuning: None },
                MasterPose { q: truth, geometry: GEOMETRY, tuning: None },
            );
            for finger in Finger::ALL {
                tip_squares += (fitted.tip(finger) - true_pose.tip(finger)).norm_squared() / 5.0;
                raw_squares += (in_palm(&seen, finger) - in_palm(&hand, finger)).norm_squared() / 5.0;
            }
            if gesture != Gesture::Fist {
                step = step.max(largest_difference(&fit.q, &previous));
            }
            previous = fit.q;
        }
        let rms = angle_squares.map(|s: f64| (s / FRAMES as f64).sqrt());
        let [tip, raw] = [tip_squares, raw_squares].map(|s| (s / FRAMES as f64).sqrt());
        // The fist's thumb stands up from the palm: its q0 and q3 are not determined, its tip is.
        let first = if gesture == Gesture::Fist { 4 } else { 0 };
        let thumb_to_middle = rms[first..12].iter().copied().fold(0.0, f64::max);
        let ring_and_little = rms[12..].iter().copied().fold(0.0, f64::max);
        println!(
            "{gesture:18} rms angle {thumb_to_middle:.2} rad (thumb to middle) {ring_and_little:.2} (ring, little), tip \
             {:.1} mm (raw {:.1}), largest step {step:.2} rad",
            tip * 1e3,
            raw * 1e3
        );
        // A little finger's distal phalanx of 10 mm seen with 3 mm of noise is itself uncertain by 0.4 rad.
        assert!(thumb_to_middle < 0.5 && ring_and_little < 0.5, "{gesture}: {rms:?}");
        assert!(tip < raw, "{gesture}: {tip} m, without the fit {raw} m");
        assert!(step < 1.5, "{gesture}: {step}");
    }
}

#[test]
fn a_thumb_with_other_axes_keeps_its_tip() {
    // A real thumb's MCP and IP axes are nearly parallel. Bend it that way, in a plane oblique to the palm.
    let mut worst = 0f64;
    for (mcp, ip) in [(0.2, 0.3), (0.5, 0.6), (0.3, 1.0)] {
        let mut points = master_support::points(&GEOMETRY, &Gesture::Open.sample(0.0));
        let base = Vector3::from(points[1]);
        let first = Vector3::new(0.6, 0.6, 0.5).normalize();
        let axis = nalgebra::Unit::new_normalize(first.cross(&Vector3::new(-1.0, 0.3, 0.4)));
        let bend = |angle: f64| Rotation3::from_axis_angle(&axis, angle) * first;
        let [a1, a2, a3] = GEOMETRY.phalanges[0];
        let second = base + first * a1;
        let third = second + bend(mcp) * a2;
        let tip = third + bend(mcp + ip) * a3;
        (points[2], points[3], points[4]) = (second.into(), third.into(), tip.into());
        let fit = fitter().fit(&Keypoints::new(points).unwrap());
        worst = worst.max(fit.fingers[0].tip_error);
    }
    println!("thumb tip within {:.2} mm", worst * 1e3);
    assert!(worst < 1e-3, "{worst}");
}

struct Summary {
    mean: f64,
    p95: f64,
}

fn summary(values: impl IntoIterator<Item = f64>) -> Summary {
    let mut values: Vec<f64> = values.into_iter().collect();
    values.sort_by(f64::total_cmp);
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    Summary { mean, p95: values[values.len() * 95 / 100] }
}

/// Root mean square second difference, m.
fn jerkiness(points: &[Vector3<f64>]) -> f64 {
    let sum: f64 = points.windows(3).map(|w| (w[2] - w[1] * 2.0 + w[0]).norm_squared()).sum();
    (sum / (points.len() - 2) as f64).sqrt()
}

#[test]
fn the_real_recording_fits() {
    let Some(frames) = recorded() else { return };
    let mut calibrator = Calibrator::default();
    frames.iter().for_each(|frame| calibrator.push(frame));
    let calibration = calibrator.finish().unwrap();
    let geometry = calibration.geometry;

    for (name, settings) in [("wide", FitSettings::default()), ("paradigmatic", FitSettings::paradigmatic())] {
        let mut fitter = Fitter::with_settings(geometry, calibration.side, settings);
        let fits: Vec<_> = frames.iter().map(|frame| fitter.fit(frame)).collect();
        assert_eq!(fits.len(), 400);
        let residual = summary(fits.iter().map(|fit| fit.residual() * 1e3));
        let budget = fits.iter().flat_map(|fit| fit.fingers).filter(|f| f.status == FitStatus::Budget).count();
        println!(
            "{name}: residual rms {:.1} mm, p95 {:.1}; {budget} of 2000 out of budget",
            residual.mean, residual.p95
        );
        let pose = |i: usize| MasterPose { q: fits[i].q, geometry, tuning: None };
        for finger in Finger::ALL {
            let f = finger.index();
            let tip = summary(fits.iter().map(|fit| fit.fingers[f].tip_error * 1e3));
            let at_limit = fits.iter().filter(|fit| fit.fingers[f].status == FitStatus::AtLimit).count();
            let fitted: Vec<_> = (0..400).map(|i| pose(i).tip(finger)).collect();
            let raw: Vec<_> = frames
                .iter()
                .map(|frame| PalmFrame::estimate(frame).to_hand(HandSide::Right, &frame.finger(finger)[3]))
                .collect();
            let (fitted, raw) = (jerkiness(&fitted) * 1e3, jerkiness(&raw) * 1e3);
            println!(
                "  {:6} tip error {:.1} mm, p95 {:.1}; at a limit in {at_limit}; second difference {fitted:.2} mm, raw {raw:.2}",
                finger.name(),
                tip.mean,
                tip.p95
            );
            if name == "wide" {
                assert!(fitted < 1.05 * raw, "the fit must not add jerk");
                assert!(tip.mean < 3.0, "{finger:?}");
            }
        }
        for finger in [Finger::Index, Finger::Middle, Finger::Ring] {
            let errors: Vec<(f64, f64)> = (0..400)
                .map(|i| {
                    let measured = (frames[i].finger(Finger::Thumb)[3] - frames[i].finger(finger)[3]).norm();
                    let fitted = (pose(i).tip(Finger::Thumb) - pose(i).tip(finger)).norm();
                    (measured, (fitted - measured).abs() * 1e3)
                })
                .collect();
            let all = summary(errors.iter().map(|e| e.1));
            print!("  thumb-{} distance error {:.1} mm, p95 {:.1}", finger.name(), all.mean, all.p95);
            let near: Vec<f64> = errors.iter().filter(|e| e.0 < 0.04).map(|e| e.1).collect();
            if near.is_empty() {
                println!();
                continue;
            }
            let frames = near.len();
            let near = summary(near);
            println!("; below 40 mm ({frames} frames) {:.1} mm, p95 {:.1}", near.mean, near.p95);
            if name == "wide" {
                assert!(near.mean < 2.5 && near.p95 < 4.5, "{finger:?}: pinches must survive the fit");
            }
        }
        if name == "wide" {
            assert!(residual.mean < 6.5 && budget < 150, "{} {budget}", residual.mean);
        }
    }
}
