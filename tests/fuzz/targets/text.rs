//! What is short: keys of the network, names, and the mapping's part of a configuration.
#![no_main]

use libfuzzer_sys::fuzz_target;
use teleop_common::authority::OperatorName;
use teleop_common::key::{Keys, MAX_NAME};
use teleop_common::mapping::MappingParams;
use teleop_common::master::Gesture;
use teleop_fuzz::{brief, within};

fuzz_target!(|bytes: &[u8]| {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    match Keys::new(text) {
        Ok(keys) => assert!(keys.name() == text && text.len() <= MAX_NAME),
        Err(error) => brief(&error),
    }
    if let Some(keys) = Keys::of_live_robot(text) {
        let epoch = keys.live_epoch(text).expect("it is alive");
        assert_eq!(keys.live_robot(epoch), text, "another key for the same robot");
    }
    match OperatorName::new(text) {
        Ok(name) => assert!(name.is_valid() && name.as_str() == text),
        Err(error) => brief(&error),
    }
    let name = OperatorName::lossy(text);
    assert!(name.is_valid() && name.as_str().len() <= OperatorName::MAX);
    if let Err(error) = text.parse::<Gesture>() {
        brief(&error);
    }
    match within(1024 * text.len() + (1 << 16), || toml::from_str::<MappingParams>(text)) {
        Ok(params) => {
            if let Err(error) = params.validate() {
                brief(&error);
            }
        }
        Err(error) => brief(&error.message()),
    }
});
