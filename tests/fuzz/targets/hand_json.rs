//! Hand data from other programs, a message per line, through fit and filter: refused in a line, or a pose that can be
//! sent; and the clutch of other programs. Bounded memory.
#![no_main]

use libfuzzer_sys::fuzz_target;
use teleop_common::authority::ClutchInput;
use teleop_common::hand::HandSide;
use teleop_common::master::{Calibrator, Filter, FilterSettings, Fitter, Inspector, MasterGeometry, MasterPose};
use teleop_common::recording::{FrameData, parse_hand_json};
use teleop_fuzz::{brief, within};

/// Lines of one input.
const LINES: usize = 40;

fuzz_target!(|bytes: &[u8]| {
    let mut geometry = MasterGeometry::PARADIGMATIC;
    let mut fitter = Fitter::new(geometry, HandSide::Right);
    let mut filter = Filter::new(geometry, FilterSettings::default());
    let (mut inspector, mut calibrator) = (Inspector::default(), Calibrator::default());
    for line in bytes.split(|byte| *byte == b'\n').take(LINES) {
        match ClutchInput::parse(line) {
            Ok(input) => assert!(input.lasts.is_none_or(|lasts| (0.01..=60.0).contains(&lasts.as_secs_f64()))),
            Err(error) => brief(&error),
        }
        // A row of no points, `[],`, takes three bytes, and a vector 24, which double while it grows.
        let frame = match within(64 * line.len() + 4096, || parse_hand_json(line)) {
            Ok(frame) => frame,
            Err(error) => {
                brief(&error);
                continue;
            }
        };
        let valid = |q| MasterPose { q, geometry, tuning: None }.validate().expect("a pose that can be sent");
        match frame {
            FrameData::Joints(q) => valid(q),
            FrameData::Keypoints(keypoints) => {
                inspector.push(&keypoints);
                calibrator.push(&keypoints);
                assert!((0.0..=1.0).contains(&inspector.agreement()));
                let fit = fitter.fit(&keypoints);
                valid(fit.q);
                valid(filter.apply(0.01, &keypoints, &fit.q));
            }
        }
    }
    // What a person of these frames would be measured as.
    if let Ok(calibration) = calibrator.best_effort(HandSide::Right) {
        geometry = calibration.geometry;
        geometry.validate().expect("a calibration is of a hand");
        assert!(calibration.residual.is_finite());
    }
});
