//! Where a hand comes from.
//!
//! A source is asked what to do at a time since the start, and answers with a frame, with the time to come again, or
//! that it has to wait for others. It reads no clock: [`crate::pipeline`] does.

mod file;
mod gesture;
mod zenoh;

use std::path::PathBuf;
use std::time::Duration;

use teleop_common::master::{Gesture, UnknownGesture};
use teleop_common::recording::{FrameData, RecordingError};
use teleop_common::time::MonoTime;

pub use file::{FileSource, RecordingFile};
pub use gesture::GestureSource;
pub use zenoh::ZenohSource;

/// A hand at one moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SourceFrame {
    /// When it belongs, since the start.
    pub time: Duration,
    /// When it arrived, if it came from outside.
    pub captured: Option<MonoTime>,
    /// The hand.
    pub hand: FrameData,
    /// Frames passed over before it because they came too late.
    pub skipped: u64,
    /// Whether it need not be near the frame before, as where a recording starts over.
    pub jump: bool,
}

/// What a source has to say.
#[derive(Clone, Copy, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "lives on the stack for one frame; a box would allocate for each")]
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
    Unknown(UnknownGesture),
    /// A recording that cannot be played.
    #[error("{}: {error}", path.display())]
    Recording {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        error: RecordingError,
    },
}

/// What `--source` says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SourceSpec {
    /// A scripted gesture.
    Gesture(Gesture),
    /// A recording.
    File(PathBuf),
    /// Hand data from other programs.
    Zenoh,
}

impl std::str::FromStr for SourceSpec {
    type Err = SourceError;

    fn from_str(text: &str) -> Result<Self, SourceError> {
        if text == "zenoh" {
            return Ok(Self::Zenoh);
        }
        let is_file = text.contains('/') || text.ends_with(".csv") || text.ends_with(".jsonl");
        if is_file {
            return Ok(Self::File(PathBuf::from(text)));
        }
        // Whoever writes tap-index means tap_index.
        text.replace('-', "_")
            .parse()
            .map(Self::Gesture)
            .map_err(|_: UnknownGesture| SourceError::Unknown(UnknownGesture { name: text.chars().take(80).collect() }))
    }
}

/// Where a hand comes from.
#[derive(Debug)]
pub enum Source {
    /// A scripted gesture.
    Gesture(GestureSource),
    /// A recording.
    File(Box<FileSource>),
    /// Another program.
    Zenoh(ZenohSource),
}

impl Source {
    /// What there is at `elapsed` since the start.
    ///
    /// # Errors
    /// [`SourceError::Recording`] if a recording changed or vanished while it plays.
    pub fn poll(&mut self, elapsed: Duration) -> Result<Poll, SourceError> {
        match self {
            Self::Gesture(gesture) => Ok(gesture.poll(elapsed)),
            Self::File(file) => file.poll(elapsed),
            Self::Zenoh(zenoh) => Ok(zenoh.poll()),
        }
    }

    /// Waits for something from outside, at most for `timeout`; true if it came.
    pub fn wait(&self, timeout: Duration) -> bool {
        match self {
            Self::Zenoh(zenoh) => zenoh.wait(timeout),
            Self::Gesture(_) | Self::File(_) => false,
        }
    }

    /// How far a recording is, 0 to 1.
    #[must_use]
    pub fn fraction(&self) -> Option<f64> {
        match self {
            Self::File(file) => Some(file.fraction()),
            Self::Gesture(_) | Self::Zenoh(_) => None,
        }
    }

    /// Messages that were no hand.
    #[must_use]
    pub fn bad_input(&self) -> u64 {
        match self {
            Self::Zenoh(zenoh) => zenoh.bad_input(),
            Self::Gesture(_) | Self::File(_) => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_source_may_say() {
        let parse = |text: &str| text.parse::<SourceSpec>().unwrap();
        assert_eq!(parse("tour"), SourceSpec::Gesture(Gesture::Tour));
        assert_eq!(parse("tap-index"), SourceSpec::Gesture(Gesture::TapIndex));
        assert_eq!(parse("zenoh"), SourceSpec::Zenoh);
        assert_eq!(parse("a/run.jsonl"), SourceSpec::File("a/run.jsonl".into()));
        assert_eq!(parse("hand.csv"), SourceSpec::File("hand.csv".into()));
        let message = "jazz-hands".parse::<SourceSpec>().unwrap_err().to_string();
        for part in ["`jazz-hands`", "tap_index", "tour", "FILE.csv", "zenoh"] {
            assert!(message.contains(part), "{message}");
        }
    }
}
