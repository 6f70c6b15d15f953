//! What can be wrong with a recording.

use super::{CSV_COLUMNS, FORMAT, MAX_LINE, MAX_MESSAGE, VERSION};
use crate::master::{KeypointsError, MasterError};

/// What is wrong with the content of one frame.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FrameError {
    /// A message too long to be a frame.
    #[error("{length} bytes; a frame has at most {MAX_MESSAGE}")]
    TooLong {
        /// Its length.
        length: usize,
    },
    /// Not JSON, or a field that is unknown or of the wrong type.
    #[error("{0}")]
    Json(String),
    /// A required field is missing.
    #[error("missing field `{0}`")]
    Missing(&'static str),
    /// Both kinds of data.
    #[error("both `q` and `keypoints`; a frame has one of them")]
    Both,
    /// Wrong number of elements.
    #[error("`{field}` has {found} elements; expected {expected}")]
    Length {
        /// The field, with the element's index if it is one of `keypoints`.
        field: String,
        /// How many there are.
        found: usize,
        /// How many there should be.
        expected: usize,
    },
    /// Not finite.
    #[error("`{field}` is {value}; expected a finite number")]
    NotFinite {
        /// The field.
        field: &'static str,
        /// What it is.
        value: f64,
    },
    /// Not an angle.
    #[error("`q[{index}]` is {value}; expected a finite angle within +-2 pi rad (degrees?)")]
    Angle {
        /// Which of the 20.
        index: usize,
        /// What it is.
        value: f64,
    },
    /// Not a hand.
    #[error("{0}")]
    Keypoints(#[from] KeypointsError),
}

/// Why a recording cannot be read or written. Lines count from 1.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The bytes could not be read or written.
    #[error("recording: {0}")]
    Io(#[from] std::io::Error),
    /// There is no line.
    #[error("recording is empty")]
    Empty,
    /// A line without end.
    #[error("line {line}: longer than {MAX_LINE} bytes")]
    LineTooLong {
        /// Where.
        line: u64,
    },
    /// Not text.
    #[error("line {line}: not UTF-8")]
    NotUtf8 {
        /// Where.
        line: u64,
    },
    /// The file ends in the middle of a frame.
    #[error("line {line}: the recording is cut off in this line; the {} lines before it are whole", line - 1)]
    Cut {
        /// Where.
        line: u64,
    },
    /// A CSV header of something else.
    #[error("line 1: column {column} is `{found}`, expected `{expected}`")]
    Header {
        /// From 1.
        column: usize,
        /// What it says.
        found: String,
        /// What it should say.
        expected: String,
    },
    /// A header line of the project's own format that cannot be used.
    #[error("line 1: header: {0}")]
    JsonHeader(String),
    /// A recording of another program.
    #[error("line 1: format is `{found}`, expected `{FORMAT}`")]
    Format {
        /// What it says.
        found: String,
    },
    /// A recording of another version of this program.
    #[error("line 1: recording has version {found}; this program reads version {VERSION}")]
    Version {
        /// What it says.
        found: String,
    },
    /// The recorded geometry is not that of a hand.
    #[error("line 1: geometry: {0}")]
    Geometry(#[from] MasterError),
    /// Wrong number of columns.
    #[error("line {line}: {found} columns, expected {CSV_COLUMNS}")]
    Columns {
        /// Where.
        line: u64,
        /// How many there are.
        found: usize,
    },
    /// Not a number.
    #[error("line {line}: {column} is `{text}`, expected a finite number")]
    Number {
        /// Where.
        line: u64,
        /// Name of the column.
        column: String,
        /// What it says.
        text: String,
    },
    /// The line is no frame.
    #[error("line {line}: {error}")]
    Frame {
        /// Where.
        line: u64,
        /// Why.
        error: FrameError,
    },
    /// Time stands still or runs backwards.
    #[error("line {line}: time {t} s does not come after {previous} s")]
    Time {
        /// Where.
        line: u64,
        /// This frame's, s.
        t: f64,
        /// The frame's before, s.
        previous: f64,
    },
}
