//! The quality figures against series whose answers are known.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use nalgebra::Vector3;
use teleop_common::hand::{Finger, HandModel, HandSide, JointVector, TipFrame};
use teleop_common::mapping::{MappingParams, Retargeter};
use teleop_common::master::{Gesture, MasterGeometry, MasterPose};
use teleop_common::quality::{HumanTips, PINCH, Quality, Sample, TIP_RADIUS};

fn pose(q: [f64; 20]) -> MasterPose {
    MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None }
}

/// A mapped gesture at these times, the robot `late` seconds behind the human.
fn mapped(hand: &HandModel, gesture: Gesture, times: impl Iterator<Item = f64>, late: f64) -> Vec<Sample> {
    let mut retargeter = Retargeter::new(hand.clone(), MappingParams::default()).unwrap();
    let sample = |t: f64| {
        let mapping = retargeter.map(&pose(gesture.sample((t - late).max(0.0))));
        Sample::new(hand, t, HumanTips::of_pose(&pose(gesture.sample(t))), &mapping)
    };
    times.map(sample).collect()
}

fn even(rate: f64, seconds: f64) -> impl Iterator<Item = f64> {
    (0..(seconds * rate) as u32).map(move |frame| f64::from(frame) / rate)
}

/// A still robot, with joint 1 where `angle` says.
fn one_joint(hand: &HandModel, times: &[f64], angle: impl Fn(f64) -> f64) -> Vec<Sample> {
    let human = HumanTips::of_pose(&pose(Gesture::Open.sample(0.0)));
    let sample = |&t: &f64| {
        let mut q = hand.home();
        q[1] = angle(t);
        Sample { t, human, q, uninvolved: 0.0 }
    };
    times.iter().map(sample).collect()
}

#[test]
fn second_difference_step_and_speed_of_one_joint() {
    let hand = HandModel::allegro_v4(HandSide::Right);
    let times: Vec<f64> = even(20.0, 1.0).collect();
    // 2 rad/s^2: a second difference of 2 * 0.05^2 = 5 mrad in one of 16 joints.
    let quality = Quality::measure(&hand, &one_joint(&hand, &times, |t| t * t)).unwrap();
    assert!((quality.second_difference_by_joint_rad[1] - 5e-3).abs() < 1e-12);
    assert!((quality.second_difference_rad - 5e-3 / 16.0).abs() < 1e-12);
    assert!((quality.max_step_rad - (0.95_f64.powi(2) - 0.9_f64.powi(2))).abs() < 1e-12);
    assert!((quality.max_speed_rad_s - quality.max_step_rad * 20.0).abs() < 1e-9);
    assert_eq!((quality.frames, quality.limit_violation_rad, quality.over_speed_share), (20, 0.0, 0.0));
    assert!((quality.period_s - 0.05).abs() < 1e-12);

    // One step too fast for the joint, and beyond its limit by 0.2 rad.
    let upper = hand.joints[1].upper;
    let step = |t: f64| if t < 0.475 { 0.0 } else { upper + 0.2 };
    let quality = Quality::measure(&hand, &one_joint(&hand, &times, step)).unwrap();
    assert!((quality.limit_violation_rad - 0.2).abs() < 1e-12);
    assert!((quality.over_speed_share - 1.0 / (19.0 * 16.0)).abs() < 1e-12);
    assert!((quality.at_limit_share - 0.5 / 16.0).abs() < 1e-12);
    assert!((quality.max_speed_rad_s - (upper + 0.2) * 20.0).abs() < 1e-9);
}

#[test]
fn uneven_times_are_brought_to_an_even_grid() {
    let hand = HandModel::allegro_v4(HandSide::Right);
    // A uniform motion has no second difference, however unevenly it is sampled.
    let mut times: Vec<f64> = even(30.0, 2.0).collect();
    for (index, t) in times.iter_mut().enumerate() {
        *t += 0.012 * f64::from(index as u32 % 3);
    }
    times.drain(20..24);
    let quality = Quality::measure(&hand, &one_joint(&hand, &times, |t| 0.3 * t)).unwrap();
    assert!(quality.second_difference_rad < 1e-12, "{}", quality.second_difference_rad);
    assert!((quality.max_speed_rad_s - 0.3).abs() < 1e-9);
    // The lag is in time, not in rows.
    let whole = Gesture::TapIndex.duration();
    for late in [0.0, 0.1] {
        let times = even(30.0, whole).enumerate().map(|(index, t)| t + 0.012 * f64::from(index as u32 % 3));
        let quality = Quality::measure(&hand, &mapped(&hand, Gesture::TapIndex, times, late)).unwrap();
        let lag = quality.fingers["index"].lag_s.unwrap();
        assert!((lag - late).abs() < 0.01, "{lag} s for {late} s");
    }
}

#[test]
fn lag_and_correlation_of_a_delayed_robot() {
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        for (frames, late) in [(0_i64, 0.0), (3, 0.1), (-2, -1.0 / 15.0)] {
            let samples = mapped(&hand, Gesture::TapIndex, even(30.0, 4.5), late);
            let index = &Quality::measure(&hand, &samples).unwrap().fingers["index"];
            assert_eq!(index.lag_frames, Some(frames), "{late} s");
            assert!((index.lag_s.unwrap() - late).abs() < 5e-3, "{:?}", index.lag_s);
            assert!(index.correlation.unwrap() > 0.8);
        }
        // Nobody moves: there is nothing to correlate.
        let still: Vec<f64> = even(30.0, 1.0).collect();
        let quality = Quality::measure(&hand, &one_joint(&hand, &still, |_| 0.0)).unwrap();
        assert_eq!((quality.fingers["index"].correlation, quality.fingers["index"].lag_frames), (None, None));
    }
}

#[test]
fn pinches_are_where_the_human_pinches() {
    let hand = HandModel::allegro_v4(HandSide::Right);
    let samples = mapped(&hand, Gesture::TapIndex, even(100.0, 4.5), 0.0);
    let quality = Quality::measure(&hand, &samples).unwrap();
    let pole = |finger, q: &JointVector| {
        let chain = hand.fingers.iter().find(|chain| chain.finger == finger).unwrap();
        chain.tip(&chain.select(q), TipFrame::Pole)
    };
    let distance = |tips: &HumanTips| (tips.tips[0] - tips.tips[1]).norm();
    let pinched: Vec<&Sample> = samples.iter().filter(|sample| distance(&sample.human) < PINCH).collect();
    let index = &quality.fingers["index"];
    let count = pinched.len() as f64;
    let gaps = pinched.iter().map(|sample| (pole(Finger::Index, &sample.q) - pole(Finger::Thumb, &sample.q)).norm());
    assert!(index.pinch_frames == pinched.len() && pinched.len() > 50);
    assert!((index.pinch_gap_m.unwrap() - gaps.clone().sum::<f64>() / count).abs() < 1e-12);
    let p95 = index.pinch_gap_p95_m.unwrap();
    let below = gaps.filter(|gap| *gap <= p95).count() as f64 / count;
    assert!((0.94..=0.96).contains(&below), "{below}");
    assert!(index.pinch_human_m.unwrap() < PINCH);
    // The ring finger takes no part: no frames, no figures, and exactly where the joint mapping wants it.
    let ring = &quality.fingers["ring"];
    assert_eq!((ring.pinch_frames, ring.pinch_gap_m, ring.pinch_gap_p95_m), (0, None, None));
    assert_eq!(quality.uninvolved_rad, 0.0);
}

#[test]
fn directions_and_spheres_of_known_postures() {
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        // The straight human hand, and the robot straight but for the middle finger, bent by a radian.
        let human = HumanTips::of_pose(&pose([0.0; 20]));
        assert!((human.distal[2] - Vector3::y()).norm() < 1e-12);
        let mut q = JointVector::zeros(16);
        q[5] = 1.0;
        let samples: Vec<Sample> = (0..3).map(|k| Sample { t: f64::from(k), human, q, uninvolved: 0.25 }).collect();
        let quality = Quality::measure(&hand, &samples).unwrap();
        assert!((quality.tip_direction_rad["middle"] - 1.0).abs() < 1e-9, "{:?}", quality.tip_direction_rad);
        // The base of the index leans outwards by 5 degrees.
        assert!((quality.tip_direction_rad["index"] - 5_f64.to_radians()).abs() < 1e-6);
        assert_eq!((quality.uninvolved_rad, quality.penetration_share), (0.25, 0.0));
        let centre = |k: usize| {
            let chain = &hand.fingers[k];
            chain.tip(&chain.select(&q), TipFrame::Center)
        };
        let pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)];
        let nearest = pairs.map(|(a, b)| (centre(a) - centre(b)).norm()).into_iter().fold(1.0, f64::min);
        assert!((quality.penetration_m - (2.0 * TIP_RADIUS - nearest)).abs() < 1e-12);
    }
}

#[test]
fn too_short_or_out_of_order_is_refused() {
    let hand = HandModel::allegro_v4(HandSide::Right);
    assert_eq!(Quality::measure(&hand, &one_joint(&hand, &[0.0, 1.0], |_| 0.0)), None);
    assert_eq!(Quality::measure(&hand, &one_joint(&hand, &[0.0, 1.0, 1.0], |_| 0.0)), None);
    assert!(Quality::measure(&hand, &one_joint(&hand, &[0.0, 1.0, 2.0], |_| 0.0)).is_some());
}
