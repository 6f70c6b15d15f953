//! URDFs of a hand, with the Allegro's description: refused in a line, or a hand that computes.
#![no_main]

use libfuzzer_sys::fuzz_target;
use teleop_common::hand::{HandSide, allegro_v4_texts};
use teleop_fuzz::hands::exercise;
use teleop_fuzz::let_the_parser_panic;

fuzz_target!(init: let_the_parser_panic(), |bytes: &[u8]| {
    if let Ok(urdf) = std::str::from_utf8(bytes) {
        exercise(urdf, allegro_v4_texts(HandSide::Right).1);
    }
});
