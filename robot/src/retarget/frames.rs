//! The frames of a recording as master poses.

use std::cell::Cell;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use anyhow::Context as _;
use teleop_common::hand::{HandModel, HandSide};
use teleop_common::mapping::{MappingParams, Tuning, TuningUse};
use teleop_common::master::{
    Calibration, Calibrator, Filter, FilterSettings, Fitter, Keypoints, MasterGeometry, MasterPose,
};
use teleop_common::quality::HumanTips;
use teleop_common::recording::{FrameData, LastLine, RecordingReader};

use crate::usage::UsageError;

/// Reads a recording and fits a hand to its keypoints.
pub(super) struct Frames {
    path: PathBuf,
    reader: RecordingReader<Counted>,
    read: Rc<Cell<u64>>,
    geometry: MasterGeometry,
    tuning: Option<Tuning>,
    tracker: Option<Tracker>,
}

/// One frame.
pub(super) struct HandFrame {
    /// s
    pub(super) t: f64,
    /// What is mapped.
    pub(super) pose: MasterPose,
    /// What was recorded.
    pub(super) human: HumanTips,
    /// Bytes of the file read so far.
    pub(super) read: u64,
}

/// Makes postures of keypoints.
struct Tracker {
    side: HandSide,
    fitter: Fitter,
    filter: Option<Filter>,
    last: Option<f64>,
}

impl Tracker {
    fn new(calibration: &Calibration, filtered: bool) -> Self {
        let filter = filtered.then(|| Filter::new(calibration.geometry, FilterSettings::default()));
        let fitter = Fitter::new(calibration.geometry, calibration.side);
        Self { side: calibration.side, fitter, filter, last: None }
    }

    fn pose(&mut self, t: f64, keypoints: &Keypoints) -> MasterPose {
        let mut pose = self.fitter.pose(keypoints);
        let last = self.last.replace(t);
        if let Some(filter) = &mut self.filter {
            pose.q = filter.apply(t - last.unwrap_or(t), keypoints, &pose.q);
        }
        pose
    }
}

impl Frames {
    /// Opens `path`. If it holds keypoints and no calibration is given, measures the hand over the whole file first. A
    /// person's hand is tuned for `hand`, unless its calibration says how.
    pub(super) fn open(
        path: &Path,
        calibration: Option<&Path>,
        hand: &HandModel,
        params: &MappingParams,
        filtered: bool,
    ) -> anyhow::Result<Self> {
        let mut known = calibration.map(load_calibration).transpose()?;
        let (reader, read) = read(path)?;
        let mut geometry = reader.header().geometry.unwrap_or(MasterGeometry::PARADIGMATIC);
        let mut tuning = reader.header().tuning;
        let mut tracker = None;
        let keypoints = matches!(first(path)?, Some(FrameData::Keypoints(_)));
        if known.is_none() && keypoints {
            let measured = measure(path, hand.side)?;
            for line in measured.report() {
                tracing::info!("{line}");
            }
            known = Some(measured);
        }
        if let Some(mut known) = known {
            geometry = known.geometry;
            tracker = Some(Tracker::new(&known, filtered));
            if keypoints {
                let reasons = known.tune(hand, params)?;
                // Also where the values do not hold: that there are any says that this is a tracked person.
                if params.tuning == TuningUse::Operator {
                    reasons.iter().for_each(|line| tracing::info!("{line}"));
                }
                tuning = known.tuning.map(|tuning| tuning.values);
            }
        }
        if let Some(error) = geometry.validate().err() {
            return Err(UsageError(format!("{}: {error}", path.display())).into());
        }
        Ok(Self { path: path.to_owned(), reader, read, geometry, tuning, tracker })
    }
}

impl Iterator for Frames {
    type Item = anyhow::Result<HandFrame>;

    fn next(&mut self) -> Option<Self::Item> {
        let frame = match self.reader.next()? {
            Ok(frame) => frame,
            Err(error) => return Some(Err(UsageError(format!("{}: {error}", self.path.display())).into())),
        };
        let (pose, human) = match (&frame.data, &mut self.tracker) {
            (FrameData::Joints(q), _) => {
                let pose = MasterPose { q: *q, geometry: self.geometry, tuning: self.tuning };
                (pose, HumanTips::of_pose(&pose))
            }
            (FrameData::Keypoints(keypoints), Some(tracker)) => {
                let pose = MasterPose { tuning: self.tuning, ..tracker.pose(frame.t, keypoints) };
                (pose, HumanTips::of_keypoints(keypoints, tracker.side))
            }
            (FrameData::Keypoints(_), None) => {
                let (path, line) = (self.path.display(), self.reader.line());
                let text = format!(
                    "{path}: line {line} has keypoints, the lines before have joint angles: \
                     give the hand's sizes with --calibration, or split the file"
                );
                return Some(Err(UsageError(text).into()));
            }
        };
        Some(Ok(HandFrame { t: frame.t, pose, human, read: self.read.get() }))
    }
}

fn load_calibration(path: &Path) -> anyhow::Result<Calibration> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    Calibration::from_text(&text).map_err(|error| UsageError(format!("{}: {error}", path.display())).into())
}

fn first(path: &Path) -> anyhow::Result<Option<FrameData>> {
    let (mut reader, _) = read(path)?;
    // A bad first line is told when its turn comes.
    Ok(reader.next().and_then(Result::ok).map(|frame| frame.data))
}

/// The person's hand out of the whole recording.
fn measure(path: &Path, side: HandSide) -> anyhow::Result<Calibration> {
    let mut calibrator = Calibrator::default();
    for frame in read(path)?.0.map_while(Result::ok) {
        if let FrameData::Keypoints(keypoints) = &frame.data {
            calibrator.push(keypoints);
        }
    }
    match calibrator.finish() {
        Ok(calibration) => Ok(calibration),
        Err(error) => {
            let rough = calibrator.best_effort(side);
            let rough = rough.map_err(|error| UsageError(format!("{}: {error}", path.display())))?;
            tracing::warn!("the hand's sizes are a rough estimate: {error}");
            Ok(rough)
        }
    }
}

fn read(path: &Path) -> anyhow::Result<(RecordingReader<Counted>, Rc<Cell<u64>>)> {
    let read = Rc::new(Cell::new(0));
    let input = Counted { inner: super::open(path)?, read: Rc::clone(&read) };
    let reader = RecordingReader::new(input, LastLine::Whole)
        .map_err(|error| UsageError(format!("{}: {error}", path.display())))?;
    Ok((reader, read))
}

/// Counts the bytes that go through.
struct Counted {
    inner: BufReader<File>,
    read: Rc<Cell<u64>>,
}

impl Read for Counted {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let count = self.inner.read(buffer)?;
        self.read.set(self.read.get() + count as u64);
        Ok(count)
    }
}

impl BufRead for Counted {
    fn fill_buf(&mut self) -> std::io::Result<&[u8]> {
        self.inner.fill_buf()
    }

    fn consume(&mut self, amount: usize) {
        self.read.set(self.read.get() + amount as u64);
        self.inner.consume(amount);
    }
}
