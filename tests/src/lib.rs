//! Helpers of the end-to-end tests.
//!
//! | module | one line |
//! |---|---|
//! | [`certificates`] | an authority and certificates of it |
//! | [`process`] | the real binaries as child processes |
//! | [`probe`] | what a robot publishes, with arrival times |
//! | [`judge`] | whether a robot's commands kept their limits |
//! | [`network`] | the network between two cores in virtual time |
//!
//! The bad network between two processes is the package `teleop-link`.

use std::time::{Duration, Instant};

pub mod certificates;
pub mod judge;
pub mod network;
pub mod probe;
pub mod process;

/// How long something that must come may take on a loaded machine.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// Waits for something that must come, however slow the machine.
///
/// # Panics
/// If it does not come within [`PATIENCE`].
#[track_caller]
pub fn eventually(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "waited {PATIENCE:?} in vain until {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
