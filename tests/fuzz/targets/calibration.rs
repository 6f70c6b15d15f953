//! Calibration files: refused in a line, or the same again when saved and read, and a tuning that can be sent follows.
#![no_main]

use libfuzzer_sys::fuzz_target;
use teleop_common::mapping::MappingParams;
use teleop_common::master::Calibration;
use teleop_fuzz::{allegro, brief, within};

fuzz_target!(|bytes: &[u8]| {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    let mut calibration = match within(1024 * text.len() + (1 << 16), || Calibration::from_text(text)) {
        Ok(calibration) => calibration,
        Err(error) => return brief(&error),
    };
    assert_eq!(Calibration::from_text(&calibration.to_text()).as_ref(), Ok(&calibration));
    calibration.report().iter().for_each(brief);
    calibration.tuning = None;
    calibration.tune(allegro(false), &MappingParams::default()).expect("the presets fit the hand");
    let tuning = calibration.tuning.expect("just worked out");
    tuning.values.validate().expect("a tuning that can be sent");
});
