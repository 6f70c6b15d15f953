//! Calibration: what it finds, what it refuses, and its file.
#![allow(clippy::needless_range_loop, reason = "an index names a joint or an axis in several arrays")]

mod master_support;

use master_support::{Noise, keypoints, noisy, recorded};
use proptest::prelude::*;
use teleop_common::hand::{Finger, HandModel, HandSide};
use teleop_common::mapping::MappingParams;
use teleop_common::master::{
    Calibration, CalibrationError, CalibrationTextError, Calibrator, Gesture, Keypoints, MAX_FRAMES, MIN_FRAMES,
    MasterGeometry, OPEN, PalmFrame, Touch,
};

/// A person's hand, larger than the paradigmatic one.
fn person() -> MasterGeometry {
    let mut geometry = MasterGeometry::PARADIGMATIC;
    geometry.bases.as_flattened_mut().iter_mut().for_each(|x| *x *= 1.2);
    geometry.phalanges.as_flattened_mut().iter_mut().for_each(|x| *x *= 1.25);
    geometry
}

fn calibrate(frames: impl IntoIterator<Item = Keypoints>) -> Result<Calibration, CalibrationError> {
    let mut calibrator = Calibrator::default();
    frames.into_iter().for_each(|frame| calibrator.push(&frame));
    calibrator.finish()
}

/// Fists for `seconds` at 30 Hz.
fn fists(seconds: u32, sigma: f64) -> impl Iterator<Item = Keypoints> {
    let mut noise = Noise(5);
    (0..seconds * 30)
        .map(move |i| noisy(&keypoints(&person(), &Gesture::Fist.sample(f64::from(i) / 30.0)), &mut noise, sigma))
}

#[test]
fn finds_lengths_and_side() {
    for mirror in [false, true] {
        let frames = fists(5, 0.0).map(|frame| if mirror { frame.mirrored() } else { frame });
        let calibration = calibrate(frames).unwrap();
        assert_eq!(calibration.side, if mirror { HandSide::Left } else { HandSide::Right });
        let person = person();
        for finger in Finger::ALL {
            let f = finger.index();
            for k in 0..3 {
                assert!((calibration.geometry.phalanges[f][k] - person.phalanges[f][k]).abs() < 1e-12);
            }
            // The bases are in the palm frame, whose distal axis goes to the middle knuckle.
            let hand = keypoints(&person, &OPEN);
            let base = PalmFrame::estimate(&hand).to_hand(HandSide::Right, &hand.finger(finger)[0]);
            assert!((base - nalgebra::Vector3::from(calibration.geometry.bases[f])).norm() < 1e-12);
        }
        assert_eq!(calibration.frames, 150);
        assert!(calibration.spread.phalanges.as_flattened().iter().all(|&s| s < 1e-12));
    }
}

#[test]
fn noise_averages_out() {
    const SIGMA: f64 = 3e-3;
    let calibration = calibrate(fists(10, SIGMA)).unwrap();
    for finger in Finger::ALL {
        for k in 0..3 {
            let f = finger.index();
            let (found, truth) = (calibration.geometry.phalanges[f][k], person().phalanges[f][k]);
            // The distance of two noisy points is too long by about 2 sigma^2 over it.
            let bias = 2.0 * SIGMA * SIGMA / truth;
            assert!((found - truth - bias).abs() < 8e-4, "{finger:?} {k} {found} {truth}");
            assert!(calibration.spread.phalanges[f][k] > 1e-3, "and the noise is reported");
        }
    }
}

#[test]
fn refuses_and_says_why() {
    let few = calibrate(fists(1, 0.0).take(MIN_FRAMES - 1));
    assert!(matches!(few, Err(CalibrationError::TooFewFrames { frames: 29, rejected: 0 })));

    let still = calibrate(std::iter::repeat_n(keypoints(&person(), &OPEN), 100)).unwrap_err();
    assert!(matches!(still, CalibrationError::NoMotion { .. }) && still.to_string().contains("open and close"));

    // The thumb moves, the fingers stay straight: left or right cannot be told.
    let thumb = calibrate((0..100).map(|i| {
        let mut q = OPEN;
        q[1] = f64::from(i) * 0.01;
        keypoints(&person(), &q)
    }));
    assert!(matches!(thumb, Err(CalibrationError::SideUnclear { .. })), "{thumb:?}");

    // Both hands in turn.
    let both = calibrate(fists(5, 0.0).flat_map(|frame| [frame, frame.mirrored()]));
    assert!(matches!(both, Err(CalibrationError::SideUnclear { .. })), "{both:?}");

    let unsteady = calibrate(fists(5, 0.0).enumerate().map(|(i, frame)| {
        let mut points = *frame.points();
        // The tracker cannot decide where the index tip is.
        let stretch = if i % 2 == 0 { 0.4 } else { 1.6 };
        for axis in 0..3 {
            points[8][axis] = points[7][axis] + stretch * (points[8][axis] - points[7][axis]);
        }
        Keypoints::new(points).unwrap()
    }));
    assert!(matches!(unsteady, Err(CalibrationError::Unsteady { finger: Finger::Index, phalanx: 2, .. })));
}

#[test]
fn memory_is_bounded_and_the_whole_stream_counts() {
    let mut calibrator = Calibrator::default();
    // A long stream whose second half is of a larger hand: the median lies between only if both halves are kept.
    for i in 0..10 * MAX_FRAMES {
        let mut geometry = person();
        if i >= 5 * MAX_FRAMES - 10 {
            geometry.phalanges[1][0] *= 1.1;
        }
        calibrator.push(&keypoints(&geometry, &Gesture::Fist.sample(i as f64 / 30.0)));
    }
    calibrator.reject();
    let calibration = calibrator.finish().unwrap();
    assert_eq!((calibration.frames, calibration.rejected), (10 * MAX_FRAMES as u64, 1));
    assert!((calibration.geometry.phalanges[1][0] - person().phalanges[1][0] * 1.1).abs() < 1e-9);
    assert!(calibration.spread.phalanges[1][0] >= 0.0);
    assert!((calibration.geometry.phalanges[1][1] - person().phalanges[1][1]).abs() < 1e-9);
}

#[test]
fn file_round_trip_and_refusals() {
    let calibration = calibrate(fists(5, 1e-3)).unwrap();
    let text = calibration.to_text();
    assert_eq!(Calibration::from_text(&text).unwrap(), calibration);

    let refuse = |from: &str, to: &str| {
        assert!(text.contains(from), "{from} is not in\n{text}");
        Calibration::from_text(&text.replacen(from, to, 1)).unwrap_err()
    };
    assert_eq!(refuse("version = 1", "version = 2"), CalibrationTextError::Version { found: 2 });
    assert!(matches!(refuse("allegro-teleop-calibration", "shopping-list"), CalibrationTextError::Format { .. }));
    let unknown = refuse("side = ", "colour = 3\nside = ").to_string();
    assert!(unknown.contains("colour"), "{unknown}");
    let missing = refuse("residual = ", "# residual = ").to_string();
    assert!(missing.contains("residual"), "{missing}");
    let side = refuse("\"right\"", "\"middle\"").to_string();
    assert!(side.contains("middle"), "{side}");
    assert!(matches!(refuse("residual = ", "residual = -"), CalibrationTextError::Statistic { .. }));
    let mut tuned = calibration.clone();
    let hand = HandModel::allegro_v4(HandSide::Right);
    assert!(tuned.tune(&hand, &MappingParams::default()).unwrap()[0].contains("tuned for allegro-v4-right"));
    let values = tuned.tuning.as_ref().unwrap().values;
    let text_tuned = tuned.to_text();
    assert!(text_tuned.contains("[tuning]\nhand = \"allegro-v4-right\"\n"), "{text_tuned}");
    let mut read = Calibration::from_text(&text_tuned).unwrap();
    assert_eq!(read, tuned);
    // Known already: nothing to work out, nothing to tell; for another hand there is.
    assert!(read.tune(&hand, &MappingParams::default()).unwrap().is_empty());
    assert!(!read.tune(&HandModel::allegro_v4(HandSide::Left), &MappingParams::default()).unwrap().is_empty());
    let wrong = text_tuned.replacen(&format!("r1 = {}", values.r1), "r1 = -1.0", 1);
    let wrong = Calibration::from_text(&wrong).unwrap_err().to_string();
    assert!(wrong.contains("r1 of the thumb is -1"), "{wrong}");
    // A file from before there were touches and tunings.
    let (before, _) = text.split_once("[calibration.touch]").unwrap();
    let old = Calibration::from_text(before).unwrap();
    assert_eq!(old, Calibration { touch: Touch::default(), ..calibration.clone() });
    let far = text.split_once("distance = [").unwrap();
    let far = format!("{}distance = [0.06, {}", far.0, far.1.split_once(", ").unwrap().1);
    assert_eq!(Calibration::from_text(&far), Err(CalibrationTextError::Touch { value: 0.06 }));

    let mut huge = calibration;
    huge.geometry.phalanges[2][0] = 40.0;
    assert!(matches!(Calibration::from_text(&huge.to_text()), Err(CalibrationTextError::Implausible(_))));
    assert!(matches!(Calibration::from_text("hello"), Err(CalibrationTextError::Toml(_))));
    assert!(matches!(Calibration::from_text(""), Err(CalibrationTextError::Format { .. })));
    let long = Calibration::from_text(&"#".repeat(70_000)).unwrap_err().to_string();
    assert!(long.contains("70000 bytes are more than the 65536 allowed"), "{long}");
    let cut = Calibration::from_text(&text[..text.len() / 2]);
    assert!(cut.is_err(), "{cut:?}");
}

#[test]
fn report_names_every_finger() {
    let report = calibrate(fists(5, 1e-3)).unwrap().report().join("\n");
    assert!(Finger::ALL.iter().all(|finger| report.contains(finger.name())) && report.contains("right hand"));
}

#[test]
fn the_recording_calibrates() {
    let Some(frames) = recorded() else { return };
    let calibration = calibrate(frames).unwrap();
    println!("{}", calibration.report().join("\n"));
    assert_eq!((calibration.side, calibration.frames), (HandSide::Right, 400));
    assert!(calibration.residual < 7e-3, "{}", calibration.residual);
    let middle: f64 = calibration.geometry.phalanges[2].iter().sum();
    assert!((0.08..0.11).contains(&middle), "{middle}");
}

proptest! {
    #[test]
    fn any_text_is_refused_or_read(text in "\\PC{0,200}") {
        prop_assert!(Calibration::from_text(&text).is_err());
    }
}
