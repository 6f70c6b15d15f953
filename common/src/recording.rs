//! Recordings of a human hand: readers and writers over lines, without touching files.
//!
//! Two formats, told apart by the first line:
//! - CSV of keypoints: a header, then per row frame, time (s) and x, y, z (m) of the 21 keypoints.
//! - JSON lines: `{"t": s, "q": [20 angles, rad]}` or `{"t": s, "keypoints": [[x, y, z] x 21, m]}` per line, after an
//!   optional first line `{"format":"allegro-teleop-recording","version":1}`, which may also hold `side`,
//!   `geometry`, `tuning` and `source`.

mod error;

use std::io::{BufRead, Read as _, Write};

use serde::{Deserialize, Serialize};

pub use self::error::{FrameError, RecordingError};
use crate::hand::HandSide;
use crate::mapping::Tuning;
use crate::master::{KEYPOINT_NAMES, Keypoints, MAX_ANGLE, MasterError, MasterGeometry};

/// Longest line read, bytes.
pub const MAX_LINE: usize = 64 * 1024;
/// Longest message [`parse_hand_json`] looks at, bytes.
pub const MAX_MESSAGE: usize = 16 * 1024;

const FORMAT: &str = "allegro-teleop-recording";
const VERSION: u32 = 1;
/// frame, time and three coordinates per keypoint.
const CSV_COLUMNS: usize = 2 + 3 * KEYPOINT_NAMES.len();

/// The hand in one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "frames are passed by value without allocating; half a kilobyte is fine")]
pub enum FrameData {
    /// Joint angles of the paradigmatic hand, rad.
    Joints([f64; 20]),
    /// Tracked points, m, in the tracker's frame.
    Keypoints(Keypoints),
}

/// One frame of a recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Time from any origin, s.
    pub t: f64,
    /// The hand.
    pub data: FrameData,
}

/// First line of the project's own recordings: what the frames are of, as far as known.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordingHeader {
    /// Which hand.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub side: Option<HandSide>,
    /// The operator's hand, for joint angles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub geometry: Option<MasterGeometry>,
    /// What the mapping should know about the operator, for joint angles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tuning: Option<Tuning>,
    /// Where the frames came from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
}

/// What to do with a last line that is cut off, as in a file whose writer was killed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LastLine {
    /// Refuse it with [`RecordingError::Cut`].
    #[default]
    Whole,
    /// Leave it out; [`RecordingReader::is_cut`] tells. A last line without a line feed counts as cut off, because
    /// a number may have lost digits.
    MayBeCut,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Format {
    Csv,
    JsonLines,
}

/// Reads frame after frame. After an error it ends.
#[derive(Debug)]
pub struct RecordingReader<R> {
    input: R,
    /// The line at hand; at the start the first line, if it is a frame already.
    buffer: Vec<u8>,
    format: Option<Format>,
    header: RecordingHeader,
    last_line: LastLine,
    line: u64,
    previous: Option<f64>,
    cut: bool,
    done: bool,
}

impl<R: BufRead> RecordingReader<R> {
    /// Reads the first line, to know the format.
    ///
    /// # Errors
    /// If there is no first line or it is neither of the two formats.
    pub fn new(input: R, last_line: LastLine) -> Result<Self, RecordingError> {
        let mut reader = Self {
            input,
            buffer: Vec::new(),
            format: None,
            header: RecordingHeader::default(),
            last_line,
            line: 0,
            previous: None,
            cut: false,
            done: false,
        };
        reader.start()?;
        Ok(reader)
    }

    /// What the first line says; empty for CSV and for JSON lines without a header.
    pub const fn header(&self) -> &RecordingHeader {
        &self.header
    }

    /// True if the last line was cut off and left out.
    pub const fn is_cut(&self) -> bool {
        self.cut
    }

    /// Number of the line read last, from 1.
    pub const fn line(&self) -> u64 {
        self.line
    }

    fn start(&mut self) -> Result<(), RecordingError> {
        // A frame on the first line stays in the buffer and is parsed by `next`.
        if !self.read_line()? {
            return Err(RecordingError::Empty);
        }
        let line = self.text()?;
        if !line.trim_start().starts_with('{') {
            check_csv_header(line)?;
            self.format = Some(Format::Csv);
            self.buffer.clear();
            return Ok(());
        }
        if let Some(header) = parse_header(line)? {
            self.header = header;
            self.buffer.clear();
        }
        self.format = Some(Format::JsonLines);
        Ok(())
    }

    /// Fills the buffer with the next line that is not blank; false at the end.
    fn read_line(&mut self) -> Result<bool, RecordingError> {
        loop {
            self.buffer.clear();
            let limit = MAX_LINE as u64 + 1;
            let length = self.input.by_ref().take(limit).read_until(b'\n', &mut self.buffer)?;
            if length == 0 {
                return Ok(false);
            }
            self.line += 1;
            if length > MAX_LINE {
                return Err(RecordingError::LineTooLong { line: self.line });
            }
            if !self.buffer.trim_ascii().is_empty() {
                return Ok(true);
            }
        }
    }

    fn text(&self) -> Result<&str, RecordingError> {
        std::str::from_utf8(&self.buffer).map(str::trim_ascii).map_err(|_| RecordingError::NotUtf8 { line: self.line })
    }

    fn read_frame(&mut self) -> Result<Option<Frame>, RecordingError> {
        if self.buffer.is_empty() && !self.read_line()? {
            return Ok(None);
        }
        let ended = self.buffer.ends_with(b"\n");
        if !ended && self.last_line == LastLine::MayBeCut {
            self.cut = true;
            return Ok(None);
        }
        let parsed = self.text().and_then(|text| match self.format {
            Some(Format::Csv) => parse_csv_row(text, self.line),
            _ => parse_json_frame(text).map_err(|error| RecordingError::Frame { line: self.line, error }),
        });
        self.buffer.clear();
        let frame = match parsed {
            Ok(frame) => frame,
            Err(_) if !ended => return Err(RecordingError::Cut { line: self.line }),
            Err(error) => return Err(error),
        };
        if let Some(previous) = self.previous
            && frame.t <= previous
        {
            return Err(RecordingError::Time { line: self.line, t: frame.t, previous });
        }
        self.previous = Some(frame.t);
        Ok(Some(frame))
    }
}

impl<R: BufRead> Iterator for RecordingReader<R> {
    type Item = Result<Frame, RecordingError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let item = self.read_frame().transpose();
        self.done = !matches!(item, Some(Ok(_)));
        item
    }
}

/// Writes a recording line by line: whatever is cut off later, the lines before are whole.
#[derive(Debug)]
pub struct RecordingWriter<W: Write> {
    output: W,
    buffer: Vec<u8>,
    line: u64,
    previous: Option<f64>,
}

impl<W: Write> RecordingWriter<W> {
    /// Writes the header line.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn new(output: W, header: &RecordingHeader) -> Result<Self, RecordingError> {
        let mut writer = Self { output, buffer: Vec::new(), line: 0, previous: None };
        writer.write_line(&HeaderLine { format: FORMAT, version: VERSION, header })?;
        Ok(writer)
    }

    /// Writes one frame and flushes.
    ///
    /// # Errors
    /// If it cannot be written, or if the reader would refuse it: time not finite or not increasing, angles that
    /// are none.
    pub fn write(&mut self, frame: &Frame) -> Result<(), RecordingError> {
        let (t, line) = (frame.t, self.line + 1);
        check_time(t).map_err(|error| RecordingError::Frame { line, error })?;
        if let Some(previous) = self.previous
            && t <= previous
        {
            return Err(RecordingError::Time { line, t, previous });
        }
        match &frame.data {
            FrameData::Joints(q) => {
                check_angles(q).map_err(|error| RecordingError::Frame { line, error })?;
                self.write_line(&JointsLine { t, q })?;
            }
            FrameData::Keypoints(keypoints) => {
                self.write_line(&KeypointsLine { t, keypoints: keypoints.points() })?;
            }
        }
        self.previous = Some(t);
        Ok(())
    }

    /// Gives the output back.
    pub fn into_inner(self) -> W {
        self.output
    }

    fn write_line(&mut self, value: &impl Serialize) -> Result<(), RecordingError> {
        self.buffer.clear();
        serde_json::to_writer(&mut self.buffer, value).map_err(std::io::Error::from)?;
        self.buffer.push(b'\n');
        self.output.write_all(&self.buffer)?;
        self.output.flush()?;
        self.line += 1;
        Ok(())
    }
}

/// One hand from a JSON message: `{"q": [20]}` or `{"keypoints": [[x, y, z] x 21]}`, with or without `t`.
///
/// # Errors
/// Names the field that is missing, unknown, too long or too short, or the value that cannot be.
pub fn parse_hand_json(bytes: &[u8]) -> Result<FrameData, FrameError> {
    if bytes.len() > MAX_MESSAGE {
        return Err(FrameError::TooLong { length: bytes.len() });
    }
    let raw: RawFrame = serde_json::from_slice(bytes).map_err(|error| FrameError::Json(error.to_string()))?;
    raw.t.map_or(Ok(()), check_time)?;
    raw.data()
}

#[derive(Serialize)]
struct HeaderLine<'a> {
    format: &'static str,
    version: u32,
    #[serde(flatten)]
    header: &'a RecordingHeader,
}

#[derive(Serialize)]
struct JointsLine<'a> {
    t: f64,
    #[serde(serialize_with = "<[f64]>::serialize")]
    q: &'a [f64],
}

#[derive(Serialize)]
struct KeypointsLine<'a> {
    t: f64,
    #[serde(serialize_with = "<[[f64; 3]]>::serialize")]
    keypoints: &'a [[f64; 3]],
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawFrame {
    t: Option<f64>,
    q: Option<Vec<f64>>,
    keypoints: Option<Vec<Vec<f64>>>,
}

impl RawFrame {
    fn data(self) -> Result<FrameData, FrameError> {
        match (self.q, self.keypoints) {
            (Some(_), Some(_)) => Err(FrameError::Both),
            (None, None) => Err(FrameError::Missing("q` or `keypoints")),
            (Some(q), None) => {
                let q: [f64; 20] = exact("q", q)?;
                check_angles(&q)?;
                Ok(FrameData::Joints(q))
            }
            (None, Some(points)) => {
                let rows: [Vec<f64>; 21] = exact("keypoints", points)?;
                let mut points = [[0.0; 3]; 21];
                for (index, (point, row)) in points.iter_mut().zip(rows).enumerate() {
                    *point = exact(format_args!("keypoints[{index}]"), row)?;
                }
                Ok(FrameData::Keypoints(Keypoints::new(points)?))
            }
        }
    }
}

fn exact<T, const N: usize>(field: impl std::fmt::Display, values: Vec<T>) -> Result<[T; N], FrameError> {
    values.try_into().map_err(|values: Vec<T>| FrameError::Length {
        field: field.to_string(),
        found: values.len(),
        expected: N,
    })
}

fn check_time(t: f64) -> Result<(), FrameError> {
    if t.is_finite() { Ok(()) } else { Err(FrameError::NotFinite { field: "t", value: t }) }
}

fn check_angles(q: &[f64; 20]) -> Result<(), FrameError> {
    match q.iter().position(|angle| !(-MAX_ANGLE..=MAX_ANGLE).contains(angle)) {
        Some(index) => Err(FrameError::Angle { index, value: q[index] }),
        None => Ok(()),
    }
}

fn parse_json_frame(line: &str) -> Result<Frame, FrameError> {
    // The parser's own "at line 1" would contradict the recording's line number.
    let raw: RawFrame = serde_json::from_str(line).map_err(|error| FrameError::Json(without_position(&error)))?;
    let t = raw.t.ok_or(FrameError::Missing("t"))?;
    check_time(t)?;
    Ok(Frame { t, data: raw.data()? })
}

fn without_position(error: &serde_json::Error) -> String {
    let text = error.to_string();
    let end = text.rfind(" at line ").unwrap_or(text.len());
    format!("{} (column {})", &text[..end], error.column())
}

/// The header, or `None` if the line has no `format`: then it is a frame.
fn parse_header(line: &str) -> Result<Option<RecordingHeader>, RecordingError> {
    let Ok(serde_json::Value::Object(mut object)) = serde_json::from_str(line) else {
        return Ok(None);
    };
    let Some(format) = object.remove("format") else {
        return Ok(None);
    };
    if format.as_str() != Some(FORMAT) {
        let found = format.as_str().map_or_else(|| format.to_string(), str::to_owned);
        return Err(RecordingError::Format { found });
    }
    let version = object.remove("version").unwrap_or_default();
    if version.as_u64() != Some(u64::from(VERSION)) {
        return Err(RecordingError::Version { found: version.to_string() });
    }
    let header: RecordingHeader =
        serde_json::from_value(object.into()).map_err(|error| RecordingError::JsonHeader(error.to_string()))?;
    if let Some(geometry) = &header.geometry {
        geometry.validate()?;
    }
    if let Some(tuning) = &header.tuning {
        tuning.validate().map_err(MasterError::from)?;
    }
    Ok(Some(header))
}

/// Name of a CSV column, from 0.
fn column_name(column: usize) -> String {
    match column {
        0 => "frame".to_owned(),
        1 => "time_s".to_owned(),
        _ => {
            let name = KEYPOINT_NAMES.get((column - 2) / 3).copied().unwrap_or("none");
            format!("{name}_{}", ["x", "y", "z"][(column - 2) % 3])
        }
    }
}

fn check_csv_header(line: &str) -> Result<(), RecordingError> {
    let mut found = line.split(',').map(str::trim);
    for column in 0..CSV_COLUMNS {
        let (text, expected) = (found.next().unwrap_or_default(), column_name(column));
        if text != expected {
            // Whatever it is, quote no more than a name's length of it.
            let found = text.chars().take(40).collect();
            return Err(RecordingError::Header { column: column + 1, found, expected });
        }
    }
    match found.count() {
        0 => Ok(()),
        more => Err(RecordingError::Columns { line: 1, found: CSV_COLUMNS + more }),
    }
}

fn parse_csv_row(row: &str, line: u64) -> Result<Frame, RecordingError> {
    let found = row.split(',').count();
    if found != CSV_COLUMNS {
        return Err(RecordingError::Columns { line, found });
    }
    let mut numbers = [0.0; CSV_COLUMNS];
    for (column, (number, text)) in numbers.iter_mut().zip(row.split(',')).enumerate() {
        let text = text.trim();
        *number = match text.parse::<f64>() {
            Ok(value) if value.is_finite() => value,
            _ => {
                let text = text.chars().take(40).collect();
                return Err(RecordingError::Number { line, column: column_name(column), text });
            }
        };
    }
    let mut points = [[0.0; 3]; 21];
    for (point, numbers) in points.iter_mut().zip(numbers[2..].chunks_exact(3)) {
        point.copy_from_slice(numbers);
    }
    let keypoints = Keypoints::new(points).map_err(|error| RecordingError::Frame { line, error: error.into() })?;
    Ok(Frame { t: numbers[1], data: FrameData::Keypoints(keypoints) })
}
