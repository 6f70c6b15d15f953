use std::io::BufRead;
use std::path::{Path, PathBuf};
use std::time::Duration;

use teleop_common::master::Calibrator;
use teleop_common::recording::{Frame, FrameData, LastLine, RecordingError, RecordingHeader, RecordingReader};

use super::{Poll, SourceError, SourceFrame};

/// Opens the bytes of a recording, from the beginning.
type Opener = Box<dyn Fn() -> std::io::Result<Box<dyn BufRead + Send>> + Send>;
type Reader = RecordingReader<Box<dyn BufRead + Send>>;

/// A recording that can be played: readable from the first line to the last, whatever its length.
pub struct RecordingFile {
    path: PathBuf,
    open: Opener,
    /// What its first line says.
    pub header: RecordingHeader,
    /// Whole frames in it.
    pub frames: u64,
    /// Time from the first to the last, s.
    pub duration: f64,
    /// Whether it holds keypoints.
    pub keypoints: bool,
    /// Whether its last line is cut off.
    pub cut: bool,
    /// What its keypoints say about the hand.
    pub calibrator: Calibrator,
    start: f64,
}

impl std::fmt::Debug for RecordingFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RecordingFile").field("path", &self.path).field("frames", &self.frames).finish_non_exhaustive()
    }
}

impl RecordingFile {
    /// Reads the recording at `path` once through, to know that all of it can be played.
    ///
    /// # Errors
    /// [`SourceError::Recording`] with the file, and the line that is wrong.
    pub fn scan(path: &Path) -> Result<Self, SourceError> {
        Self::scan_first(path, None)
    }

    /// Like [`RecordingFile::scan`], but only of the first `seconds` (all if `None`).
    ///
    /// # Errors
    /// [`SourceError::Recording`]
    pub fn scan_first(path: &Path, seconds: Option<f64>) -> Result<Self, SourceError> {
        Self::scan_bytes(path, Self::opener(path), seconds)
    }

    fn opener(path: &Path) -> Opener {
        let file = path.to_owned();
        Box::new(move || Ok(Box::new(std::io::BufReader::new(std::fs::File::open(&file)?))))
    }

    fn scan_bytes(path: &Path, open: Opener, seconds: Option<f64>) -> Result<Self, SourceError> {
        let fail = |error| SourceError::Recording { path: path.to_owned(), error };
        let mut reader = read(&open).map_err(fail)?;
        let header = reader.header().clone();
        let mut calibrator = Calibrator::default();
        let (mut frames, mut keypoints, mut span) = (0, false, None::<(f64, f64)>);
        for frame in &mut reader {
            let Frame { t, data } = frame.map_err(fail)?;
            if seconds.zip(span).is_some_and(|(seconds, (first, _))| t - first > seconds) {
                break;
            }
            if let FrameData::Keypoints(hand) = &data {
                calibrator.push(hand);
                keypoints = true;
            }
            frames += 1;
            span = Some((span.map_or(t, |(first, _)| first), t));
        }
        let (start, end) = span.ok_or_else(|| fail(RecordingError::Empty))?;
        let cut = reader.is_cut();
        Ok(Self {
            path: path.to_owned(),
            open,
            header,
            frames,
            duration: end - start,
            keypoints,
            cut,
            calibrator,
            start,
        })
    }

    /// The file's name, for messages.
    #[must_use]
    pub fn name(&self) -> std::path::Display<'_> {
        self.path.display()
    }

    /// Whether its keypoints ought to be in the palm frame (x palmar, y radial, z distal), as those in CSV are.
    #[must_use]
    pub fn claims_palm_frame(&self) -> bool {
        self.path.extension().is_some_and(|extension| extension == "csv")
    }

    /// Plays it at `speed` times its own pace, once or again and again.
    ///
    /// # Errors
    /// [`SourceError::Recording`] if it can no longer be opened.
    pub fn play(self, speed: f64, repeat: bool) -> Result<FileSource, SourceError> {
        let reader = read(&self.open).map_err(|error| SourceError::Recording { path: self.path.clone(), error })?;
        // Between the last frame and the first of the next lap there is one period, as between the others.
        let period = if self.frames > 1 { self.duration / (self.frames - 1) as f64 } else { 1.0 };
        Ok(FileSource { recording: self, speed, repeat, period, reader, lap: 0, pending: None, fraction: 0.0 })
    }
}

fn read(open: &Opener) -> Result<Reader, RecordingError> {
    RecordingReader::new(open()?, LastLine::MayBeCut)
}

/// A recording at its own time stamps. It is read while it plays, so its length does not matter.
pub struct FileSource {
    recording: RecordingFile,
    speed: f64,
    repeat: bool,
    period: f64,
    reader: Reader,
    lap: u64,
    pending: Option<Pending>,
    fraction: f64,
}

impl std::fmt::Debug for FileSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FileSource").field("recording", &self.recording).field("lap", &self.lap).finish_non_exhaustive()
    }
}

#[derive(Clone, Copy)]
struct Pending {
    due: Duration,
    hand: FrameData,
    fraction: f64,
    first: bool,
}

impl FileSource {
    pub(super) fn poll(&mut self, elapsed: Duration) -> Result<Poll, SourceError> {
        let mut skipped = 0;
        let Some(mut frame) = self.pending.take().map_or_else(|| self.read(), |frame| Ok(Some(frame)))? else {
            return Ok(Poll::End);
        };
        let mut jump = frame.first;
        if elapsed < frame.due {
            self.pending = Some(frame);
            return Ok(Poll::WaitUntil(frame.due));
        }
        // The newest frame that is due; those before it came too late.
        while let Some(next) = self.read()? {
            if elapsed < next.due {
                self.pending = Some(next);
                break;
            }
            skipped += 1;
            jump |= next.first;
            frame = next;
        }
        self.fraction = frame.fraction;
        Ok(Poll::Frame(SourceFrame { time: frame.due, captured: None, hand: frame.hand, skipped, jump }))
    }

    pub(super) fn fraction(&self) -> f64 {
        self.fraction
    }

    fn read(&mut self) -> Result<Option<Pending>, SourceError> {
        let mut first = false;
        for _attempt in 0..2 {
            if let Some(frame) = self.reader.next() {
                let frame = frame.map_err(|error| self.fail(error))?;
                let lap = self.lap as f64 * (self.recording.duration + self.period);
                let t = (frame.t - self.recording.start).max(0.0);
                let fraction = if self.recording.duration > 0.0 { t / self.recording.duration } else { 1.0 };
                let due = Duration::try_from_secs_f64((lap + t) / self.speed).unwrap_or(Duration::MAX);
                return Ok(Some(Pending { due, hand: frame.data, fraction, first }));
            }
            if !self.repeat {
                break;
            }
            self.reader = read(&self.recording.open).map_err(|error| self.fail(error))?;
            self.lap += 1;
            first = true;
        }
        Ok(None)
    }

    fn fail(&self, error: RecordingError) -> SourceError {
        SourceError::Recording { path: self.recording.path.clone(), error }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recording(text: String) -> Result<RecordingFile, SourceError> {
        let open: Opener = Box::new(move || Ok(Box::new(std::io::Cursor::new(text.clone().into_bytes()))));
        RecordingFile::scan_bytes(Path::new("run.jsonl"), open, None)
    }

    /// Frame `i` at `times[i]`, its first angle is i / 100.
    fn frames(times: &[f64]) -> String {
        let line = |(i, t): (usize, &f64)| {
            let mut q = [0.0; 20];
            q[0] = i as f64 / 100.0;
            format!("{{\"t\": {t}, \"q\": {q:?}}}\n")
        };
        times.iter().enumerate().map(line).collect()
    }

    fn index(hand: &FrameData) -> usize {
        match hand {
            FrameData::Joints(q) => (q[0] * 100.0).round() as usize,
            FrameData::Keypoints(_) => unreachable!(),
        }
    }

    /// Plays on a virtual clock that is never late: due time (ms), frame, skipped, jump.
    fn play(source: &mut FileSource, from: u64, until: u64) -> Vec<(u64, usize, u64, bool)> {
        let mut now = Duration::from_millis(from);
        let mut played = Vec::new();
        while now < Duration::from_millis(until) {
            match source.poll(now).unwrap() {
                Poll::Frame(frame) => {
                    let ms = (frame.time.as_secs_f64() * 1e3).round() as u64;
                    played.push((ms, index(&frame.hand), frame.skipped, frame.jump));
                }
                Poll::WaitUntil(due) => {
                    assert!(due > now);
                    now = due;
                }
                Poll::End => break,
                Poll::Idle => unreachable!(),
            }
        }
        played
    }

    #[test]
    fn frames_come_at_their_own_times_whatever_the_origin() {
        let mut source = recording(frames(&[100.0, 100.03, 100.05, 100.2])).unwrap().play(1.0, false).unwrap();
        let expected = [(0, 0, 0, false), (30, 1, 0, false), (50, 2, 0, false), (200, 3, 0, false)];
        assert_eq!(play(&mut source, 0, 1000), expected);
        assert_eq!(source.poll(Duration::from_secs(1)).unwrap(), Poll::End);
        assert_eq!(source.fraction(), 1.0);
    }

    #[test]
    fn speed_and_laps() {
        let mut source = recording(frames(&[0.0, 0.1, 0.2])).unwrap().play(2.0, true).unwrap();
        let expected = [(0, 0, 0, false), (50, 1, 0, false), (100, 2, 0, false), (150, 0, 0, true), (200, 1, 0, false)];
        assert_eq!(play(&mut source, 0, 210), expected);
    }

    #[test]
    fn after_a_stall_the_newest_frame_and_no_burst() {
        let times: Vec<f64> = (0..90).map(|i| f64::from(i) * 0.01).collect();
        let mut source = recording(frames(&times)).unwrap().play(1.0, false).unwrap();
        assert_eq!(play(&mut source, 0, 100).len(), 10);
        let after = play(&mut source, 505, 540);
        assert_eq!(after, [(500, 50, 40, false), (510, 51, 0, false), (520, 52, 0, false), (530, 53, 0, false)]);
    }

    #[test]
    fn a_bad_line_is_found_before_anything_moves() {
        let message = recording(format!("{}{{\"t\": 1, \"q\": [0]}}\n", frames(&[0.0]))).unwrap_err().to_string();
        assert!(message.contains("run.jsonl") && message.contains("line 2"), "{message}");
        assert!(recording(String::new()).unwrap_err().to_string().contains("empty"));
        let cut = recording(format!("{}{{\"t\": 1, \"q\"", frames(&[0.0, 0.5]))).unwrap();
        assert!(cut.cut && cut.frames == 2);
    }
}
