//! Descriptions of a hand, with the Allegro's URDF: refused in a line, or a hand that computes.
#![no_main]

use libfuzzer_sys::fuzz_target;
use teleop_common::hand::{HandSide, allegro_v4_texts};
use teleop_fuzz::hands::exercise;

fuzz_target!(|bytes: &[u8]| {
    if let Ok(description) = std::str::from_utf8(bytes) {
        exercise(allegro_v4_texts(HandSide::Right).0, description);
    }
});
