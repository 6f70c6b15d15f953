//! Time of every step between a tracker's keypoints and the joints' targets:
//! `cargo bench -p teleop-common [-- PART-OF-A-NAME]`; instructions per call: `deploy/bench`.
#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs, reason = "a bench reports on the terminal")]

mod motion;
mod suite;

use std::fs::File;
use std::hint::black_box;
use std::io::BufReader;

use nalgebra::Vector3;
use suite::Suite;
use teleop_common::authority::Intent;
use teleop_common::guard::TipGuard;
use teleop_common::hand::{FingerChain, HandModel, HandSide, JointVector, MAX_FINGER_JOINTS, MAX_FINGERS, TipFrame};
use teleop_common::ik::FingerIk;
use teleop_common::mapping::{Anchor, MappingMode, MappingOutput, MappingParams, Retargeter, ThumbMap};
use teleop_common::master::{
    Calibration, Calibrator, Filter, FilterSettings, Fitter, Gesture, Keypoints, MasterGeometry, MasterPose,
};
use teleop_common::recording::{FrameData, LastLine, RecordingReader};
use teleop_common::testing::shared_data;
use teleop_common::time::MonoTime;
use teleop_common::wire::{Echo, Header, MAX_MESSAGE, PoseMessage, decode, encode_into};

type Own = [f64; MAX_FINGER_JOINTS];

/// A target, a reference and a last solution.
type Case = (Vector3<f64>, Own, Option<Own>);

/// mu of the Cartesian phase, m/rad.
const MU: f64 = 2e-5;
/// Cases per finger and kind.
const CASES: u32 = 1000;
/// The operator's default rate, 1/s.
const RATE: f64 = 100.0;
/// Frames of the recording per second.
const RECORDED_RATE: f64 = 30.0;
/// The control loop's default, m.
const TIP_OVERLAP: f64 = 0.0005;

fn main() {
    let mut suite = Suite::from_args();
    let tour: Vec<MasterPose> = (0..(Gesture::Tour.duration() * RATE) as u32)
        .map(|n| MasterPose {
            q: Gesture::Tour.sample(f64::from(n) / RATE),
            geometry: MasterGeometry::PARADIGMATIC,
            tuning: None,
        })
        .collect();
    let hand = HandModel::allegro_v4(HandSide::Right);
    let mapped = outputs(&hand, &MappingParams::default(), &tour);

    kinematics(&mut suite, &hand, &mapped);
    finger_ik(&mut suite, &hand);
    for (name, params) in [("default", MappingParams::default()), ("paper", MappingParams::paper())] {
        mapping(&mut suite, &format!("tour, {name}"), &hand, params, &tour);
    }
    let mode = |mode| MappingParams { mode, ..MappingParams::default() };
    mapping(&mut suite, "tour, vector", &hand, mode(MappingMode::Vector), &tour);
    mapping(&mut suite, "tour, dexpilot", &hand, mode(MappingMode::DexPilot), &tour);
    codec(&mut suite, &tour);
    motion::poses(&mut suite, "tour", &hand, &tour, RATE);
    motion::jumps(&mut suite, &hand);

    let Some((calibration, keypoints)) = recording() else { return };
    perception(&mut suite, &calibration, &keypoints);
    for side in [HandSide::Right, HandSide::Left] {
        let hand = HandModel::allegro_v4(side);
        let poses = tracked(&calibration, &hand, &keypoints);
        let name = format!("recording, {}", side.name());
        mapping(&mut suite, &name, &hand, MappingParams::default(), &poses);
        motion::poses(&mut suite, &name, &hand, &poses, RECORDED_RATE);
        if side == HandSide::Right {
            // The joint mapping alone, with what is left of the step where nothing is solved.
            for (name, thumb_map) in [("angles", ThumbMap::Angles), ("directions", ThumbMap::Directions)] {
                let anchor = Anchor::Reference;
                let params = MappingParams { thumb_map, anchor, ..mode(MappingMode::Joint) };
                let mut retargeter = Retargeter::new(hand.clone(), params).unwrap();
                suite.run(&format!("joint mapping, thumb by {name}"), &poses, |pose| {
                    black_box(retargeter.map(pose));
                });
            }
            mapping(&mut suite, "recording, vector", &hand, mode(MappingMode::Vector), &poses);
            mapping(&mut suite, "recording, dexpilot", &hand, mode(MappingMode::DexPilot), &poses);
        }
    }
}

fn kinematics(suite: &mut Suite, hand: &HandModel, mapped: &[MappingOutput]) {
    suite.run("FK + Jacobian, four tips", mapped, |output| {
        for chain in &hand.fingers {
            black_box(chain.tip_and_jacobian(&chain.select(&output.q), TipFrame::Pole));
        }
    });
    suite.run("FK, four tips", mapped, |output| {
        for chain in &hand.fingers {
            black_box(chain.tip(&chain.select(&output.q), TipFrame::Pole));
        }
    });
    // What the mapping asks of the guard, by whether there is anything to do.
    let guard = TipGuard::new(hand, TIP_OVERLAP);
    let (overlapping, apart): (Vec<MappingOutput>, Vec<MappingOutput>) =
        mapped.iter().partition(|output| guard.deepest(hand, &output.q) > 2.0 * TIP_OVERLAP);
    for (name, outputs) in [("apart", apart), ("overlapping", overlapping)] {
        suite.run(&format!("guard, {name}"), &outputs, |output| {
            black_box(guarded(&guard, hand, output));
        });
    }
}

fn finger_ik(suite: &mut Suite, hand: &HandModel) {
    for chain in &hand.fingers {
        let ik = FingerIk::new(chain, &hand.joints);
        let posture = |unit: &dyn Fn(usize) -> f64| -> Own {
            let mut q = [0.0; MAX_FINGER_JOINTS];
            for (slot, joint) in chain.joints.iter().enumerate() {
                let joint = &hand.joints[joint.joint];
                q[slot] = joint.lower + (joint.upper - joint.lower) * unit(slot);
            }
            q
        };
        // Low-discrepancy numbers in 0..1 instead of random ones.
        let spread = |n: u32, slot: usize| (f64::from(n) * [0.754_878, 0.569_84, 0.810_44, 0.671_04][slot]).fract();
        let tip = |q: &Own| chain.tip(q, TipFrame::Pole);
        let reachable = |n: u32| {
            let witness = posture(&|slot| spread(n, slot));
            (tip(&witness), posture(&|slot| 0.5 * (spread(n, slot) + spread(n + 77, 3 - slot))))
        };
        // A smooth path inside the joint box, from one pose of the operator to the next.
        let mut last = None;
        let warm = (0..CASES).map(|n| {
            let time = f64::from(n) / RATE;
            let wave = |slot: usize| 0.5 + 0.35 * (time * (2.0 + slot as f64 * 0.7)).sin();
            let target = tip(&posture(&wave));
            let reference = posture(&|slot| 0.5 + 0.3 * (time * (1.5 + slot as f64 * 0.3)).cos());
            let case = (target, reference, last);
            last = Some(ik.solve(chain, &target, &reference, last.as_ref(), MU).0);
            case
        });
        let far = |n: u32| {
            let (target, reference) = reachable(n);
            let origin = chain_origin(chain);
            (origin + (target - origin) * 1.3 + Vector3::new(0.0, 0.03, 0.0), reference, None)
        };
        let straight = tip(&[0.0; MAX_FINGER_JOINTS]);
        let singular = |n: u32| {
            let beside = Vector3::new(spread(n, 0) - 0.5, spread(n, 1) - 0.5, spread(n, 2) - 0.5) * 4e-3;
            (straight + beside, reachable(n).1, None)
        };
        let kinds: [(&str, Vec<Case>); 4] = [
            ("warm", warm.collect()),
            ("cold", (0..CASES).map(|n| (reachable(n).0, reachable(n).1, None)).collect()),
            ("unreachable, cold", (0..CASES).map(far).collect()),
            ("singular, cold", (0..CASES).map(singular).collect()),
        ];
        for (kind, cases) in kinds {
            let name = format!("IK, {}, {kind}", chain.finger.name());
            suite.run(&name, &cases, |(target, reference, start)| {
                black_box(ik.solve(chain, target, reference, start.as_ref(), MU));
            });
        }
    }
}

fn chain_origin(chain: &FingerChain) -> Vector3<f64> {
    chain.joints[0].translation
}

/// The mapping of a whole hand, alone and with the guard behind it.
fn mapping(suite: &mut Suite, name: &str, hand: &HandModel, params: MappingParams, poses: &[MasterPose]) {
    let retargeter = Retargeter::new(hand.clone(), params).unwrap();
    let mut own = retargeter.clone();
    suite.run(&format!("mapping, {name}"), poses, |pose| {
        black_box(own.map(pose));
    });
    let (mut own, guard) = (retargeter, TipGuard::new(hand, TIP_OVERLAP));
    suite.run(&format!("mapping + guard, {name}"), poses, |pose| {
        black_box(guarded(&guard, hand, &own.map(pose)));
    });
}

/// As the control loop does it.
fn guarded(guard: &TipGuard, hand: &HandModel, output: &MappingOutput) -> JointVector {
    let mut movable = [false; MAX_FINGERS];
    movable.iter_mut().zip(output.fingers()).for_each(|(own, signals)| *own = signals.k > 0.0);
    guard.apart(hand, &output.q, &movable)
}

fn outputs(hand: &HandModel, params: &MappingParams, poses: &[MasterPose]) -> Vec<MappingOutput> {
    let mut retargeter = Retargeter::new(hand.clone(), params.clone()).unwrap();
    poses.iter().map(|pose| retargeter.map(pose)).collect()
}

fn codec(suite: &mut Suite, poses: &[MasterPose]) {
    let now = MonoTime(1);
    let messages: Vec<PoseMessage> = poses
        .iter()
        .map(|pose| PoseMessage::new(Header::new::<PoseMessage>(1, 1, now), Echo::NONE, now, pose, Intent::default()))
        .collect();
    let mut buffer = [0; MAX_MESSAGE];
    suite.run("codec, encode a pose", &messages, |message| {
        black_box(encode_into(message, &mut buffer).unwrap());
    });
    let encoded: Vec<Vec<u8>> = messages
        .iter()
        .map(|message| {
            let length = encode_into(message, &mut buffer).unwrap();
            buffer[..length].to_vec()
        })
        .collect();
    suite.run("codec, decode a pose", &encoded, |bytes| {
        black_box(decode::<PoseMessage>(bytes).unwrap().pose());
    });
}

fn perception(suite: &mut Suite, calibration: &Calibration, keypoints: &[Keypoints]) {
    let mut fitter = Fitter::new(calibration.geometry, calibration.side);
    suite.run("fit, recording", keypoints, |frame| {
        black_box(fitter.fit(frame));
    });
    suite.run("fit, recording, cold", keypoints, |frame| {
        black_box(Fitter::new(calibration.geometry, calibration.side).fit(frame));
    });
    let fitted: Vec<_> = keypoints.iter().map(|frame| (frame, fitter.fit(frame).q)).collect();
    let mut filter = Filter::new(calibration.geometry, FilterSettings::default());
    suite.run("filter, recording", &fitted, |(frame, q)| {
        black_box(filter.apply(1.0 / RECORDED_RATE, frame, q));
    });
}

/// The real recording, and the calibration it gives.
fn recording() -> Option<(Calibration, Vec<Keypoints>)> {
    let path = shared_data("human_hand_right.csv")?;
    let reader = RecordingReader::new(BufReader::new(File::open(path).unwrap()), LastLine::Whole).unwrap();
    let keypoints: Vec<Keypoints> = reader
        .filter_map(|frame| match frame.unwrap().data {
            FrameData::Keypoints(keypoints) => Some(keypoints),
            FrameData::Joints(_) => None,
        })
        .collect();
    let mut calibrator = Calibrator::default();
    keypoints.iter().for_each(|frame| calibrator.push(frame));
    Some((calibrator.finish().unwrap(), keypoints))
}

/// The recording as the operator sends it: fitted, filtered, with the person's tuning for `hand`.
fn tracked(calibration: &Calibration, hand: &HandModel, keypoints: &[Keypoints]) -> Vec<MasterPose> {
    let mut calibration = calibration.clone();
    calibration.tune(hand, &MappingParams::default()).unwrap();
    let tuning = calibration.tuning.map(|tuning| tuning.values);
    let mut fitter = Fitter::new(calibration.geometry, calibration.side);
    let mut filter = Filter::new(calibration.geometry, FilterSettings::default());
    keypoints
        .iter()
        .map(|frame| {
            let fitted = fitter.fit(frame).q;
            MasterPose { q: filter.apply(1.0 / RECORDED_RATE, frame, &fitted), geometry: calibration.geometry, tuning }
        })
        .collect()
}
