//! The baselines against dex-retargeting's own values, a dense multistart, and each other on the real recording.

#![allow(clippy::unwrap_used, clippy::print_stdout, reason = "helpers of tests")]

mod master_support;

use master_support::{Noise, recorded};
use nalgebra::Vector3;
use teleop_common::hand::{ChainJoint, Finger, HandModel, HandSide, JointVector, MAX_FINGERS, TipFrame};
use teleop_common::ik::IkStatus;
use teleop_common::mapping::{
    Baseline, BaselineParams, MappingMode, MappingOutput, MappingParams, Retargeter, TipObjective,
};
use teleop_common::master::{Calibrator, Fitter, Gesture, JOINT_LIMITS, MasterGeometry, MasterPose};
use teleop_common::time::MonoTime;
use teleop_common::wire::{Header, MAX_MESSAGE, MappingMessage, decode, encode_into};

const MM: f64 = 1e-3;
const MODES: [MappingMode; 2] = [MappingMode::Vector, MappingMode::DexPilot];

fn right() -> HandModel {
    HandModel::allegro_v4(HandSide::Right)
}

fn baseline(hand: &HandModel, mode: MappingMode) -> Baseline {
    Baseline::new(hand, mode, BaselineParams::default()).unwrap()
}

fn retargeter(hand: HandModel, mode: MappingMode) -> Retargeter {
    Retargeter::new(hand, MappingParams { mode, ..MappingParams::default() }).unwrap()
}

fn pose(q: [f64; 20]) -> MasterPose {
    MasterPose { q, geometry: MasterGeometry::PARADIGMATIC, tuning: None }
}

fn tips(pose: &MasterPose) -> [Vector3<f64>; MAX_FINGERS] {
    Finger::ALL.map(|finger| pose.tip(finger))
}

/// The recording as the hand fit sees it.
fn recording() -> Option<Vec<MasterPose>> {
    let frames = recorded()?;
    let mut calibrator = Calibrator::default();
    frames.iter().for_each(|frame| calibrator.push(frame));
    let calibration = calibrator.finish().unwrap();
    let mut fitter = Fitter::new(calibration.geometry, calibration.side);
    Some(frames.iter().map(|frame| fitter.pose(frame)).collect())
}

fn uniform(noise: &mut Noise, from: f64, to: f64) -> f64 {
    from + (to - from) * noise.uniform()
}

fn random_pose(noise: &mut Noise) -> MasterPose {
    pose(std::array::from_fn(|joint| {
        let range = JOINT_LIMITS[joint / 4][joint % 4];
        uniform(noise, range.min, range.max)
    }))
}

fn random_posture(hand: &HandModel, noise: &mut Noise) -> JointVector {
    let values: Vec<_> = hand.joints.iter().map(|joint| uniform(noise, joint.lower, joint.upper)).collect();
    JointVector::from_slice(&values)
}

/// Values of `VectorOptimizer` and `DexPilotOptimizer` of dex-retargeting 0.5.0 with its configurations for the right
/// Allegro Hand, at our home posture, for the same fingertips one after the other: near, touching, and apart again,
/// so that 39 mm (tap) and 43 and 52 mm (tripod) come both before and after a projection.
#[test]
fn the_sums_are_those_of_dex_retargeting() {
    let hand = right();
    let home = hand.home();
    for (mode, gesture, rows) in [
        (
            MappingMode::Vector,
            Gesture::TapIndex,
            [(1.0, 0.055_338_10), (1.35, 0.057_045_20), (2.0, 0.070_285_19), (3.15, 0.057_045_20)],
        ),
        (
            MappingMode::Vector,
            Gesture::Tripod,
            [(1.3, 0.054_975_23), (2.0, 0.076_698_27), (3.2, 0.054_975_23), (3.6, 0.048_174_18)],
        ),
        (
            MappingMode::DexPilot,
            Gesture::TapIndex,
            [(1.0, 0.244_669_50), (1.35, 0.256_529_15), (2.0, 2.853_735_36), (3.15, 2.799_819_35)],
        ),
        (
            MappingMode::DexPilot,
            Gesture::Tripod,
            [(1.3, 0.252_868_60), (2.0, 6.108_447_44), (3.2, 2.796_646_30), (3.6, 0.215_957_77)],
        ),
    ] {
        let mut baseline = baseline(&hand, mode);
        for (t, expected) in rows {
            let objective = baseline.objective(&hand, &tips(&pose(gesture.sample(t))));
            // Theirs is without the temporal term, whose gradient they add by hand.
            let middle = hand.joints.iter().map(|joint| 0.5 * (joint.lower + joint.upper));
            let temporal: f64 = home.iter().zip(middle).map(|(q, last)| 4e-3 * (q - last).powi(2)).sum();
            let value = objective.value(&hand, &home) - temporal;
            assert!((value - expected).abs() < 2e-6 * expected.max(1.0), "{mode:?} {gesture} at {t} s: {value}");
        }
    }
}

/// Compares the minimum of every pose to the best of 20 descents from random postures; of a thousand poses `misses`
/// may have been found lower by those.
fn assert_lowest(mode: MappingMode, name: &str, poses: &[MasterPose], misses: usize) {
    let hand = right();
    let mut baseline = baseline(&hand, mode);
    let mut noise = Noise(1);
    let (mut iterations, mut excess, mut missed, mut several) = (0, f64::NEG_INFINITY, 0, 0);
    for pose in poses {
        let (objective, minimum) = baseline.step(&hand, &tips(pose));
        assert!(minimum.converged, "{mode:?} {name}");
        assert!((objective.value(&hand, &minimum.q) - minimum.value).abs() < 1e-12);
        assert_stationary(&hand, &objective, &minimum.q);
        iterations = iterations.max(minimum.iterations);
        let (mut best, mut worst) = (f64::INFINITY, 0.0_f64);
        for _ in 0..20 {
            let end = objective.minimize(&hand, &[random_posture(&hand, &mut noise)]).value;
            (best, worst) = (best.min(end), worst.max(end));
        }
        several += usize::from(worst > best + 1e-6);
        missed += usize::from(minimum.value > best + 1e-9);
        excess = excess.max(minimum.value - best);
    }
    println!(
        "{mode:?}, {name}: of {} poses {several} have several minima, {missed} a lower one than found (by {excess:.0e} \
         at most); at most {iterations} iterations",
        poses.len()
    );
    assert!(missed * 1000 <= misses * poses.len(), "{mode:?} {name}: {missed}");
}

/// No joint moved alone, either way within its limits, makes the sum smaller.
fn assert_stationary(hand: &HandModel, objective: &TipObjective, q: &JointVector) {
    let value = objective.value(hand, q);
    for (slot, joint) in hand.joints.iter().enumerate() {
        for step in [-1e-3, -1e-4, 1e-4, 1e-3] {
            let mut moved = *q;
            moved[slot] = (q[slot] + step).clamp(joint.lower, joint.upper);
            assert!(objective.value(hand, &moved) > value - 1e-12, "{} by {step}", joint.name);
        }
    }
}

#[test]
fn no_random_start_finds_a_lower_sum() {
    let mut noise = Noise(2);
    let tour: Vec<_> = (0..300).map(|n| pose(Gesture::Tour.sample(f64::from(n) * 0.2))).collect();
    let random: Vec<_> = (0..1000).map(|_| random_pose(&mut noise)).collect();
    for mode in MODES {
        assert_lowest(mode, "tour", &tour, 0);
        assert_lowest(mode, "random poses", &random, 2);
        if let Some(recording) = recording() {
            assert_lowest(mode, "recording", &recording, 0);
        }
    }
}

fn gap(output: &MappingOutput, finger: Finger) -> f64 {
    (output.finger(Finger::Thumb).unwrap().p - output.finger(finger).unwrap().p).norm()
}

#[test]
fn dexpilot_pinches_and_says_so() {
    let mut retargeter = retargeter(right(), MappingMode::DexPilot);
    let mut last = 0.0;
    let mut seen = [0; 2];
    for tick in 0..450 {
        let output = retargeter.map(&pose(Gesture::TapIndex.sample(f64::from(tick) * 0.01)));
        let [thumb, index, middle] =
            [Finger::Thumb, Finger::Index, Finger::Middle].map(|finger| *output.finger(finger).unwrap());
        // Projected below 3 cm, released above 5 cm, and in between as before.
        let expected = if index.delta < 0.03 || (last == 1.0 && index.delta <= 0.05) { 1.0 } else { 0.0 };
        assert_eq!((thumb.k, index.k, middle.k), (expected, expected, 0.0), "at {} m", index.delta);
        last = index.k;
        if (0.03..0.05).contains(&index.delta) {
            seen[index.k as usize] += 1;
        }
        if index.k == 1.0 {
            // 200 times the weight of the wrist's vectors: on the thumb but for a fraction of a millimetre.
            assert!((index.p_cartesian - thumb.p).norm() < 0.11 * MM);
            assert!(gap(&output, Finger::Index) < 3.0 * MM, "{} m", gap(&output, Finger::Index));
        }
        assert_eq!(index.p_input, index.p_cartesian);
        assert!((index.e_c - (index.p_cartesian - index.p).norm()).abs() < 1e-12);
        assert_ne!(index.ik.status, IkStatus::Skipped);
    }
    assert!(seen[0] > 5 && seen[1] > 5, "{seen:?}");
}

#[test]
fn vector_reaches_scaled_tips_that_are_in_reach() {
    // A human hand that is this robot's, 1.6 times smaller: the sum is 0 but for the temporal term.
    let hand = right();
    let mut baseline = baseline(&hand, MappingMode::Vector);
    let mut tips = [Vector3::zeros(); MAX_FINGERS];
    let home = hand.home();
    for chain in &hand.fingers {
        let tip = chain.tip(&chain.select(&home), TipFrame::Pole) - hand.wrist;
        tips[chain.finger.index()] = hand.anatomical_from_palm * tip / 1.6;
    }
    let mut value = f64::INFINITY;
    for _ in 0..100 {
        let minimum = baseline.step(&hand, &tips).1;
        assert!(minimum.value < value + 1e-12);
        value = minimum.value;
    }
    assert!(value < 1e-9, "{value}");
}

#[test]
fn a_low_pass_follows_slowly_and_changes_nothing_else() {
    let hand = right();
    for mode in MODES {
        let filtered = BaselineParams { low_pass: 0.2, ..BaselineParams::default() };
        let mut filtered =
            Retargeter::new(hand.clone(), MappingParams { mode, baseline: filtered, ..MappingParams::default() })
                .unwrap();
        let mut plain = retargeter(hand.clone(), mode);
        let mut expected: Option<JointVector> = None;
        for tick in 0..200 {
            let pose = pose(Gesture::Tour.sample(f64::from(tick) * 0.1));
            let (plain, filtered) = (plain.map(&pose), filtered.map(&pose));
            let mut q = expected.unwrap_or(plain.q);
            q.iter_mut().zip(plain.q.iter()).for_each(|(value, new)| *value += 0.2 * (new - *value));
            assert!(q.iter().zip(filtered.q.iter()).all(|(a, b)| (a - b).abs() < 1e-12));
            let tip = filtered.fingers()[1].p;
            let chain = &hand.fingers[1];
            assert!((chain.tip(&chain.select(&filtered.q), TipFrame::Pole) - tip).norm() < 1e-12);
            expected = Some(q);
        }
    }
}

#[test]
fn both_hands_do_the_same_and_a_reset_forgets() {
    for mode in MODES {
        let (mut right, mut left) =
            (retargeter(right(), mode), retargeter(HandModel::allegro_v4(HandSide::Left), mode));
        for tick in 0..600 {
            let pose = pose(Gesture::Tour.sample(f64::from(tick) * 0.1));
            let (right, left) = (right.map(&pose), left.map(&pose));
            for (right, left) in right.fingers().iter().zip(left.fingers()) {
                let mirrored = Vector3::new(left.p.x, -left.p.y, left.p.z);
                assert!((right.p - mirrored).norm() < 1e-6, "{mode:?} {:?} at tick {tick}", right.finger);
                assert_eq!(right.k, left.k);
            }
        }
        let mut fresh = retargeter(HandModel::allegro_v4(HandSide::Right), mode);
        right.reset();
        let pose = pose(Gesture::Tripod.sample(1.5));
        assert_eq!(right.map(&pose), fresh.map(&pose));
    }
}

/// The hand with a little finger beside its ring finger: 20 joints.
fn five_fingers() -> HandModel {
    let mut hand = right();
    let mut little = hand.fingers.last().unwrap().clone();
    little.finger = Finger::Little;
    little.base.x -= 0.045;
    for (slot, joint) in little.joints.iter_mut().enumerate() {
        let translation = joint.translation - Vector3::y() * if slot == 0 { 0.045 } else { 0.0 };
        let copied = hand.joints[joint.joint].clone();
        *joint = ChainJoint::new(16 + slot, translation, joint.rotation, joint.axis);
        hand.joints.push(copied);
    }
    hand.fingers.push(little);
    for map in &mut hand.joint_maps {
        map.rows.extend_from_within(8..12);
    }
    hand
}

#[test]
fn any_hand_and_any_pose_give_a_posture_inside_the_limits() {
    let mut three = right();
    three.fingers.retain(|chain| chain.finger != Finger::Ring);
    let mut noise = Noise(3);
    for hand in [right(), HandModel::allegro_v4(HandSide::Left), three, five_fingers()] {
        for mode in MODES {
            let mut retargeter = retargeter(hand.clone(), mode);
            let mut projected = 0;
            for n in 0..300 {
                let pose = match n % 3 {
                    0 => random_pose(&mut noise),
                    1 => pose(Gesture::Tripod.sample(2.0)),
                    _ => pose(std::array::from_fn(|_| uniform(&mut noise, -6.3, 6.3))),
                };
                let output = retargeter.map(&pose);
                assert_eq!((output.q.len(), output.fingers().len()), (hand.joints.len(), hand.fingers.len()));
                for (q, joint) in output.q.iter().zip(&hand.joints) {
                    assert!(*q >= joint.lower && *q <= joint.upper, "{}: {q}", joint.name);
                }
                projected += output.fingers().iter().filter(|signals| signals.k == 1.0).count();
                // As the robot publishes it.
                let message = MappingMessage::new(
                    Header::new::<MappingMessage>(1, n, MonoTime(1)),
                    1,
                    retargeter.params().r1,
                    retargeter.params().r2,
                    &output,
                );
                let mut bytes = [0; MAX_MESSAGE];
                let len = encode_into(&message, &mut bytes).unwrap();
                assert_eq!(*decode::<MappingMessage>(&bytes[..len]).unwrap(), message);
            }
            assert_eq!(projected > 0, mode == MappingMode::DexPilot);
        }
    }
}

#[test]
fn parameters_out_of_range_are_named() {
    for (params, name) in [
        (BaselineParams { scale: 0.0, ..BaselineParams::default() }, "mapping.baseline.scale = 0"),
        (BaselineParams { low_pass: 0.0, ..BaselineParams::default() }, "mapping.baseline.low_pass = 0"),
        (BaselineParams { low_pass: f64::NAN, ..BaselineParams::default() }, "mapping.baseline.low_pass = NaN"),
    ] {
        let error = MappingParams { baseline: params, ..MappingParams::default() }.validate().unwrap_err();
        assert!(error.to_string().starts_with(name), "{error}");
    }
}

/// What a run over the recording amounts to; see the printed heading.
struct Quality {
    frames: usize,
    gap: f64,
    gap_p95: f64,
    correlation: f64,
    lag: usize,
    second_difference: f64,
    step: f64,
    at_limit: f64,
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let product =
        |x: &[f64], mx: f64, y: &[f64], my: f64| -> f64 { x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum() };
    product(a, ma, b, mb) / (product(a, ma, a, ma) * product(b, mb, b, mb)).sqrt()
}

fn quality(hand: &HandModel, params: MappingParams, poses: &[MasterPose]) -> Quality {
    let keypoints = recorded().unwrap();
    let distance = |frame: usize, finger: Finger| {
        let points = keypoints[frame].points();
        (Vector3::from(points[4]) - Vector3::from(points[4 + 4 * finger.index()])).norm()
    };
    let mut retargeter = Retargeter::new(hand.clone(), params).unwrap();
    let outputs: Vec<_> = poses.iter().map(|pose| retargeter.map(pose)).collect();
    let pinched = (0..poses.len()).filter(|n| distance(*n, Finger::Index) < 0.025);
    let mut gaps: Vec<_> = pinched.map(|n| gap(&outputs[n], Finger::Index)).collect();
    gaps.sort_by(f64::total_cmp);
    let frames = gaps.len();
    let human: Vec<_> = (0..poses.len()).map(|n| distance(n, Finger::Index)).collect();
    let robot: Vec<_> = outputs.iter().map(|output| gap(output, Finger::Index)).collect();
    let shifted = |lag: usize| correlation(&human[..human.len() - lag], &robot[lag..]);
    let pairs = || outputs.windows(2).flat_map(|w| (0..16).map(|j| (w[1].q[j] - w[0].q[j]).abs()));
    let bends = outputs.windows(3).flat_map(|w| (0..16).map(|j| (w[2].q[j] - 2.0 * w[1].q[j] + w[0].q[j]).abs()));
    let at_limit = outputs.iter().flat_map(|output| {
        let near = |(q, joint): (&f64, &teleop_common::hand::Joint)| q - joint.lower < 1e-6 || joint.upper - q < 1e-6;
        output.q.iter().zip(&hand.joints).map(near).collect::<Vec<_>>()
    });
    Quality {
        frames,
        gap: gaps.iter().sum::<f64>() / frames as f64,
        gap_p95: gaps[(frames * 95).div_ceil(100) - 1],
        correlation: shifted(0),
        lag: (0..10).max_by(|a, b| shifted(*a).total_cmp(&shifted(*b))).unwrap(),
        second_difference: bends.sum::<f64>() / ((outputs.len() - 2) * 16) as f64,
        step: pairs().fold(0.0, f64::max),
        at_limit: at_limit.filter(|near| *near).count() as f64 / (outputs.len() * 16) as f64,
    }
}

/// `cargo test --release -p teleop-common --test baseline recording_in_three -- --nocapture` prints the table.
#[test]
fn the_recording_in_three_modes() {
    let Some(poses) = recording() else { return };
    let hand = right();
    let run = |mode, low_pass| {
        let baseline = BaselineParams { low_pass, ..BaselineParams::default() };
        let quality = quality(&hand, MappingParams { mode, baseline, ..MappingParams::default() }, &poses);
        print!("{:<22}", format!("{mode:?}{}", if low_pass < 1.0 { ", low-pass 0.2" } else { "" }));
        println!(
            "{:>5.1} /{:>5.1} ({}) {:>5.2} {:>2} {:>5.1} {:>6.3} {:>4.1} %",
            quality.gap / MM,
            quality.gap_p95 / MM,
            quality.frames,
            quality.correlation,
            quality.lag,
            quality.second_difference / 1e-3,
            quality.step,
            quality.at_limit * 100.0
        );
        quality
    };
    println!("gap between the poles of thumb and index, mm, mean / p95, while the human's keypoints are < 25 mm apart");
    println!(
        "(frames); correlation of robot and human thumb-index distance; its lag, frames; mean |second difference|,"
    );
    println!("mrad; largest step, rad; joints at a limit");
    run(MappingMode::Combined, 1.0);
    let vector = run(MappingMode::Vector, 1.0);
    let dexpilot = run(MappingMode::DexPilot, 1.0);
    let slow = run(MappingMode::DexPilot, 0.2);
    run(MappingMode::Vector, 0.2);
    // What is known of the originals: the snap closes pinches and jumps; the filter takes both away, and lags.
    assert!(dexpilot.gap < 10.0 * MM && vector.gap > 30.0 * MM && slow.gap > 30.0 * MM);
    assert!(dexpilot.step > 1.0 && slow.step < 0.4 && slow.lag >= 2 && dexpilot.lag == 0);
}
