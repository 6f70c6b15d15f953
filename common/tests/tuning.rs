//! The tuner against the reference's coverage figures, and on a person's recording.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use teleop_common::hand::{Finger, HandModel, HandSide};
use teleop_common::mapping::{Anchor, Judge, MappingParams, Retargeter, Tuning, contacts, tune};
use teleop_common::master::{Calibration, Calibrator, Fitter, Keypoints, MasterGeometry, MasterPose};
use teleop_common::recording::{FrameData, LastLine, RecordingReader};
use teleop_common::testing::shared_data;

const FINGERS: [Finger; 3] = [Finger::Index, Finger::Middle, Finger::Ring];

fn hand() -> HandModel {
    HandModel::allegro_v4(HandSide::Right)
}

/// Shares of contacts that close at c_s 1.6 and 2.7, both targets reachable and with the projected anchor.
///
/// The reference drew 150 contacts per finger (standard error up to 4 %) and does not say how their postures were
/// distributed, on which the shares depend. At 1.6 these 300 give its shares to 0.1; at 2.7 they lie farther out, and
/// fewer of them close.
#[test]
fn coverage_is_the_references() {
    let hand = hand();
    let judge = Judge::new(&hand, hand.joint_map("split").unwrap());
    let reference = [[0.92, 1.0, 0.21, 0.57], [0.83, 1.0, 0.43, 0.49], [0.95, 1.0, 0.10, 0.97]];
    for (finger, expected) in FINGERS.into_iter().zip(reference) {
        let sample = contacts(&MasterGeometry::PARADIGMATIC, finger, 0.0, 300, 1);
        assert_eq!(sample.len(), 300);
        for pose in &sample {
            assert!((pose.tip(Finger::Thumb) - pose.tip(finger)).norm() < 1.1e-5);
            pose.validate().unwrap();
        }
        let found = [
            judge.coverage(&sample, finger, 1.6, Anchor::Reference),
            judge.coverage(&sample, finger, 1.6, Anchor::Projected),
            judge.coverage(&sample, finger, 2.7, Anchor::Reference),
            judge.coverage(&sample, finger, 2.7, Anchor::Projected),
        ];
        println!("{:6} found {found:.3?}, reference {expected:.2?}", finger.name());
        assert!((found[0] - expected[0]).abs() < 0.1 && (found[1] - expected[1]).abs() < 0.015, "{finger:?} {found:?}");
        // The paper's scale leaves most contacts open, and the projected anchor closes more of them.
        assert!(found[2] < 0.25 && found[2] < found[3] && found[3] < 0.85, "{finger:?} {found:?}");
    }
}

#[test]
fn an_exact_hand_is_tuned_so_that_99_percent_of_its_contacts_close() {
    let hand = hand();
    let tuned = tune(&hand, &MappingParams::default(), &MasterGeometry::PARADIGMATIC, &[0.0; 5]).unwrap();
    tuned.report().iter().for_each(|line| println!("{line}"));
    let Tuning { scale, r1, r2, contact } = tuned.tuning;
    tuned.tuning.validate().unwrap();
    assert_eq!((tuned.hand.as_str(), contact), ("allegro-v4-right", [0.0; 5]));
    assert!(r1 == 0.020 && r2 >= 0.050 && tuned.speed <= 1.0, "{r1} {r2} {}", tuned.speed);
    let judge = Judge::new(&hand, hand.joint_map("split").unwrap());
    for finger in FINGERS {
        // Other contacts than it was tuned with.
        let sample = contacts(&MasterGeometry::PARADIGMATIC, finger, 0.0, 400, 1_000_000);
        let share = judge.coverage(&sample, finger, scale[0], Anchor::Projected);
        println!("{:6} {:.1} % of {} other contacts", finger.name(), share * 100.0, sample.len());
        assert!(share >= 0.985, "{finger:?} {share}");
        assert!(scale[finger.index()] >= scale[0] && scale[finger.index()] <= 1.25 * scale[0] + 1e-12);
    }
}

#[test]
fn tuning_is_deterministic_and_the_same_for_both_hands() {
    let tune = |side| {
        let hand = HandModel::allegro_v4(side);
        tune(&hand, &MappingParams::default(), &MasterGeometry::PARADIGMATIC, &[0.0, 0.02, 0.02, 0.02, 0.02]).unwrap()
    };
    let right = tune(HandSide::Right);
    assert_eq!(right.tuning, tune(HandSide::Right).tuning);
    assert_eq!(right.tuning, tune(HandSide::Left).tuning);
    assert_eq!(right.tuning.r1, 0.025);
}

/// The person of the recording, measured and tuned as `robot retarget` does it.
fn person() -> Option<(Vec<Keypoints>, Calibration)> {
    let path = shared_data("human_hand_right.csv")?;
    let input = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let frames: Vec<Keypoints> = RecordingReader::new(input, LastLine::Whole)
        .unwrap()
        .map(|frame| match frame.unwrap().data {
            FrameData::Keypoints(keypoints) => keypoints,
            FrameData::Joints(_) => unreachable!("the recording is of keypoints"),
        })
        .collect();
    let mut calibrator = Calibrator::default();
    frames.iter().for_each(|frame| calibrator.push(frame));
    Some((frames, calibrator.finish().unwrap()))
}

#[test]
fn a_persons_contacts_close_too() {
    let Some((_, mut person)) = person() else { return };
    let hand = hand();
    person.tune(&hand, &MappingParams::default()).unwrap().iter().for_each(|line| println!("{line}"));
    let tuning = person.tuning.as_ref().unwrap().values;
    let judge = Judge::new(&hand, hand.joint_map("split").unwrap());
    for finger in FINGERS {
        let sample = contacts(&person.geometry, finger, tuning.contact[finger.index()], 400, 1_000_000);
        let share = |scale| judge.coverage(&sample, finger, scale, Anchor::Projected);
        let (tuned, paper) = (share(tuning.scale[0]), share(2.7));
        println!(
            "{:6} {:.1} % of {} other contacts; at 2.7 {:.1} %",
            finger.name(),
            tuned * 100.0,
            sample.len(),
            paper * 100.0
        );
        assert!(tuned >= 0.98, "{finger:?} {tuned}");
    }
}

/// Gaps of the robot's poles (m) in frames whose keypoints of thumb and finger are less than `below` (m) apart.
fn gaps(frames: &[Keypoints], person: &Calibration, tuning: Option<Tuning>, finger: Finger, below: f64) -> Vec<f64> {
    let mut fitter = Fitter::new(person.geometry, person.side);
    let mut retargeter = Retargeter::new(hand(), MappingParams::default()).unwrap();
    let mut gaps = Vec::new();
    for frame in frames {
        let output = retargeter.map(&MasterPose { tuning, ..fitter.pose(frame) });
        if (frame.finger(Finger::Thumb)[3] - frame.finger(finger)[3]).norm() < below {
            gaps.push((output.finger(Finger::Thumb).unwrap().p - output.finger(finger).unwrap().p).norm());
        }
    }
    gaps.sort_by(f64::total_cmp);
    gaps
}

#[test]
fn a_persons_touch_is_a_robot_touch() {
    let Some((frames, mut person)) = person() else { return };
    person.report().last().iter().for_each(|line| println!("{line}"));
    let touch = person.touch;
    assert!(touch.frames[1] >= 20 && (0.022..0.030).contains(&touch.distance[1]), "{touch:?}");
    // Index and middle were seen touching, ring and little never: they take what was seen.
    assert!(touch.frames[3] == 0 && touch.distance[3] == touch.distance[4] && touch.distance[3] > 0.02, "{touch:?}");
    person.tune(&hand(), &MappingParams::default()).unwrap();
    let tuning = person.tuning.as_ref().map(|tuning| tuning.values);
    for (finger, below) in [(Finger::Index, 0.025), (Finger::Index, 0.030), (Finger::Middle, 0.030)] {
        let summary = |gaps: &[f64]| {
            let mean = gaps.iter().sum::<f64>() / gaps.len() as f64;
            (mean * 1e3, gaps[gaps.len() * 95 / 100] * 1e3)
        };
        let before = summary(&gaps(&frames, &person, None, finger, below));
        let after = gaps(&frames, &person, tuning, finger, below);
        let (mean, p95) = summary(&after);
        println!(
            "{:6} keypoints below {:.0} mm in {} frames: gap mean {mean:.2} mm, p95 {p95:.2}; before {:.1}, {:.1}",
            finger.name(),
            below * 1e3,
            after.len(),
            before.0,
            before.1
        );
        assert!(mean <= 2.0 && p95 <= 5.0, "{finger:?} {mean} {p95}");
    }
}

#[test]
fn any_valid_hand_gets_a_valid_tuning() {
    let small = {
        let mut geometry = MasterGeometry::PARADIGMATIC;
        geometry.bases.as_flattened_mut().iter_mut().for_each(|x| *x *= 0.6);
        geometry.phalanges.as_flattened_mut().iter_mut().for_each(|x| *x *= 0.6);
        geometry
    };
    let mut no_thumb = MasterGeometry::PARADIGMATIC;
    no_thumb.phalanges[0] = [0.003; 3];
    let mut huge = MasterGeometry::PARADIGMATIC;
    huge.phalanges = [[0.15; 3]; 5];
    for (name, geometry) in [("small", small), ("no thumb", no_thumb), ("huge", huge)] {
        geometry.validate().unwrap();
        for contact in [0.0, 0.05] {
            let tuned = tune(&hand(), &MappingParams::default(), &geometry, &[contact; 5]).unwrap();
            println!("{name}: {}", tuned.report()[0]);
            tuned.tuning.validate().unwrap();
            if name == "no thumb" && contact == 0.0 {
                assert_eq!(tuned.tuning.scale, [1.6; 5], "nothing to go by");
            }
        }
    }
    let scale = |geometry| tune(&hand(), &MappingParams::default(), geometry, &[0.0; 5]).unwrap().tuning.scale[0];
    assert!(scale(&small) > 1.3 * scale(&MasterGeometry::PARADIGMATIC), "a small hand is scaled up");
}
