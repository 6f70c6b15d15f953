//! Time of the mapping step and its parts. `cargo bench -p teleop-common --bench mapping`.
#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs, reason = "a bench reports on the terminal")]

mod report;

use std::fs::File;
use std::hint::black_box;
use std::io::BufReader;

use report::report;
use teleop_common::hand::{HandModel, HandSide, JointVector, TipFrame};
use teleop_common::mapping::{Anchor, MappingMode, MappingParams, Retargeter};
use teleop_common::master::{Calibrator, Fitter, Gesture, MasterGeometry, MasterPose};
use teleop_common::recording::{FrameData, LastLine, RecordingReader};
use teleop_common::testing::shared_data;

fn main() {
    let hand = HandModel::allegro_v4(HandSide::Right);
    let geometry = MasterGeometry::PARADIGMATIC;
    let tour: Vec<_> = (0..20_000)
        .map(|n| MasterPose { q: Gesture::Tour.sample(f64::from(n) * 0.003), geometry, tuning: None })
        .collect();

    let mut retargeter = Retargeter::new(hand.clone(), MappingParams::default()).unwrap();
    let postures: Vec<JointVector> = tour.iter().map(|pose| retargeter.map(pose).q).collect();
    report("FK, four tips", &postures, |q| {
        for chain in &hand.fingers {
            black_box(chain.tip(&chain.select(q), TipFrame::Pole));
        }
    });
    report("FK + Jacobian, four tips", &postures, |q| {
        for chain in &hand.fingers {
            black_box(chain.tip_and_jacobian(&chain.select(q), TipFrame::Pole));
        }
    });
    let of = |mode| MappingParams { mode, ..MappingParams::default() };
    let reference = MappingParams { anchor: Anchor::Reference, ..MappingParams::default() };
    for (name, params) in [
        ("default", MappingParams::default()),
        ("paper", MappingParams::paper()),
        ("default, no projection", reference),
        ("vector", of(MappingMode::Vector)),
        ("dexpilot", of(MappingMode::DexPilot)),
    ] {
        let mut retargeter = Retargeter::new(hand.clone(), params).unwrap();
        report(&format!("whole hand, tour, {name}"), &tour, |pose| {
            black_box(retargeter.map(pose));
        });
    }
    let Some(recording) = recording() else { return };
    for mode in [MappingMode::Vector, MappingMode::DexPilot] {
        let mut retargeter = Retargeter::new(hand.clone(), of(mode)).unwrap();
        report(&format!("whole hand, recording, {mode:?}"), &recording, |pose| {
            black_box(retargeter.map(pose));
        });
    }
    for side in [HandSide::Right, HandSide::Left] {
        let mut retargeter = Retargeter::new(HandModel::allegro_v4(side), MappingParams::default()).unwrap();
        report(&format!("whole hand, recording, {}", side.name()), &recording, |pose| {
            black_box(retargeter.map(pose));
        });
    }
}

/// The real recording, fitted.
fn recording() -> Option<Vec<MasterPose>> {
    let path = shared_data("human_hand_right.csv")?;
    let reader = RecordingReader::new(BufReader::new(File::open(path).unwrap()), LastLine::Whole).unwrap();
    let frames: Vec<_> = reader
        .filter_map(|frame| match frame.unwrap().data {
            FrameData::Keypoints(keypoints) => Some(keypoints),
            FrameData::Joints(_) => None,
        })
        .collect();
    let mut calibrator = Calibrator::default();
    frames.iter().for_each(|frame| calibrator.push(frame));
    let calibration = calibrator.finish().unwrap();
    let mut fitter = Fitter::new(calibration.geometry, calibration.side);
    Some(frames.iter().map(|frame| fitter.pose(frame)).collect())
}
