//! Where a hand comes from.
//!
//! A source is asked what to do at a time since the start, and answers with a frame, with the time to come again, or
//! that it has to wait for others. It reads no clock: [`crate::pipeline`] does.

mod gesture;

use std::time::Duration;

use teleop_common::master::UnknownGesture;
use teleop_common::time::MonoTime;

pub use gesture::GestureSource;

use crate::hand::Hand;

/// A hand at one moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SourceFrame {
    /// When it belongs, since the start.
    pub time: Duration,
    /// When it arrived, if it came from outside.
    pub captured: Option<MonoTime>,
    /// The hand.
    pub hand: Hand,
    /// Frames passed over before it because they came too late.
    pub skipped: u64,
}

/// What a source has to say.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Poll {
    /// A frame, due now.
    Frame(SourceFrame),
    /// Nothing before this time since the start.
    WaitUntil(Duration),
    /// Nothing until others send something, see [`Source::wait`].
    Idle,
    /// Nothing more.
    End,
}

/// A source that cannot be used, or failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SourceError {
    /// None of the sources there are.
    #[error("{0}; or give a recording FILE.csv or FILE.jsonl, or zenoh for live hand data")]
    Unknown(#[from] UnknownGesture),
}

/// Where a hand comes from.
#[derive(Debug)]
pub enum Source {
    /// A scripted gesture.
    Gesture(GestureSource),
}

impl Source {
    /// What there is at `elapsed` since the start.
    ///
    /// # Errors
    /// [`SourceError`]
    pub fn poll(&mut self, elapsed: Duration) -> Result<Poll, SourceError> {
        match self {
            Self::Gesture(gesture) => Ok(gesture.poll(elapsed)),
        }
    }

    /// Waits for something from outside, at most for `timeout`; true if it came.
    pub fn wait(&self, timeout: Duration) -> bool {
        match self {
            Self::Gesture(_) => {
                std::thread::sleep(timeout);
                false
            }
        }
    }

    /// How far a recording is, 0 to 1.
    #[must_use]
    pub fn fraction(&self) -> Option<f64> {
        None
    }

    /// Messages that were no hand.
    #[must_use]
    pub fn bad_input(&self) -> u64 {
        0
    }
}
