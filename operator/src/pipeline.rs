//! The source thread: frames in, poses out to the network, the recording and the picture.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use teleop_common::mapping::MappingParams;
use teleop_common::net::clock::{now, wall_offset_ns};
use teleop_common::time::MonoTime;
use teleop_common::viz::{Logger, OperatorFrame};

use crate::feedback::Feedback;
use crate::hand::{PoseFinder, Posed};
use crate::record::RecordSender;
use crate::shutdown::Shutdown;
use crate::source::{Poll, Source, SourceError, SourceFrame};
use crate::stream::{Outgoing, PoseSender};
use crate::terminal::{Activity, chain};

/// Longest wait without a look at whether the process ends.
const LOOK: Duration = Duration::from_millis(50);
/// A live source that was silent for this long is waited for.
const SILENCE: Duration = Duration::from_millis(500);
/// How often the last pose of a recording is repeated until the robot has it, ...
const CONFIRM_EVERY: Duration = Duration::from_millis(20);
/// ... and for how long.
const CONFIRM_FOR: Duration = Duration::from_secs(2);

/// Why the source thread gave up.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PipelineError {
    /// The source failed.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The thread panicked.
    #[error("the source thread panicked")]
    Panic,
}

/// How far the source thread is.
#[derive(Clone, Debug, Default)]
pub struct Progress {
    /// What it does.
    pub activity: Activity,
    /// How far a recording is, 0 to 1.
    pub fraction: Option<f64>,
    /// Fit residual of keypoints (root mean square), m.
    pub residual: Option<f64>,
    /// Poses made.
    pub poses: u64,
    /// Capture times of the first and the last of them.
    pub span: Option<(MonoTime, MonoTime)>,
    /// Frames that came too late to be sent.
    pub skipped: u64,
    /// Messages that were no hand.
    pub bad: u64,
    /// Why the hand cannot be followed.
    pub problem: Option<String>,
    /// Whether the source came to its end.
    pub ended: bool,
    /// Whether the robot confirmed the last pose of a source that has an end.
    pub confirmed: bool,
}

/// What the source thread works with.
pub struct Parts {
    /// Where frames come from.
    pub source: Source,
    /// Makes poses of them.
    pub finder: PoseFinder,
    /// Where poses go.
    pub sender: PoseSender,
    /// Where they are recorded.
    pub recorder: Option<RecordSender>,
    /// Where they are drawn.
    pub logger: Logger,
    /// The robot as last heard.
    pub feedback: Arc<Feedback>,
    /// Whether to wait for the robot before the first frame.
    pub wait_for_robot: bool,
    /// When to end.
    pub shutdown: Shutdown,
}

/// The running source thread.
pub struct Pipeline {
    progress: Arc<Mutex<Progress>>,
    thread: JoinHandle<Result<(), PipelineError>>,
}

impl Pipeline {
    /// Starts the source.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub fn start(parts: Parts) -> std::io::Result<Self> {
        let progress = Arc::new(Mutex::new(Progress::default()));
        let worker = Worker { progress: Arc::clone(&progress), last: None, seen: None, parts };
        let thread = std::thread::Builder::new().name("source".to_owned()).spawn(move || worker.run())?;
        Ok(Self { progress, thread })
    }

    /// How far it is.
    #[must_use]
    pub fn progress(&self) -> Progress {
        lock(&self.progress).clone()
    }

    /// Whether it ended by itself.
    #[must_use]
    pub fn is_finished(&self) -> bool {
        self.thread.is_finished()
    }

    /// Waits for its end, which somebody else must have asked for, and says how it went.
    ///
    /// # Errors
    /// [`PipelineError`]
    pub fn join(self) -> (Progress, Result<(), PipelineError>) {
        let result = self.thread.join().unwrap_or(Err(PipelineError::Panic));
        (lock(&self.progress).clone(), result)
    }
}

fn lock(progress: &Mutex<Progress>) -> MutexGuard<'_, Progress> {
    progress.lock().unwrap_or_else(PoisonError::into_inner)
}

struct Worker {
    parts: Parts,
    progress: Arc<Mutex<Progress>>,
    last: Option<Outgoing>,
    /// When the newest frame came.
    seen: Option<MonoTime>,
}

impl Worker {
    fn run(mut self) -> Result<(), PipelineError> {
        if self.parts.wait_for_robot {
            lock(&self.progress).activity = Activity::Waiting("the robot");
            while !self.parts.feedback.snapshot(now()).connected {
                if self.parts.shutdown.wait(LOOK) {
                    return Ok(());
                }
            }
            lock(&self.progress).activity = Activity::Streaming;
        }
        let start = now();
        while !self.parts.shutdown.requested() {
            match self.parts.source.poll(now().since(start))? {
                Poll::Frame(frame) => self.take(&frame),
                Poll::WaitUntil(due) => {
                    let left = (start + due).since(now());
                    if left > LOOK {
                        let _ended = self.parts.shutdown.wait(LOOK);
                    } else {
                        std::thread::sleep(left);
                    }
                }
                Poll::Idle => self.idle(),
                Poll::End => {
                    self.confirm();
                    break;
                }
            }
        }
        Ok(())
    }

    /// Waits for a live source.
    fn idle(&mut self) {
        let came = self.parts.source.wait(LOOK);
        let silent = self.seen.is_none_or(|seen| now().since(seen) > SILENCE);
        let mut progress = lock(&self.progress);
        progress.bad = self.parts.source.bad_input();
        if !came && silent {
            progress.activity = Activity::Waiting("hand data");
        }
    }

    fn take(&mut self, frame: &SourceFrame) {
        let captured = frame.captured.unwrap_or_else(now);
        self.seen = Some(captured);
        let posed = self.parts.finder.pose(frame.time, &frame.hand, frame.jump);
        if let Posed::Pose { pose, residual } = posed {
            let outgoing = Outgoing { captured, pose };
            self.parts.sender.send(outgoing);
            self.last = Some(outgoing);
            if let Some(recorder) = &self.parts.recorder {
                recorder.record(&outgoing);
            }
            self.draw(&outgoing, residual);
        }
        let mut progress = lock(&self.progress);
        progress.skipped += frame.skipped;
        progress.fraction = self.parts.source.fraction();
        progress.bad = self.parts.source.bad_input();
        match posed {
            Posed::Pose { residual, .. } => {
                progress.activity = Activity::Streaming;
                progress.residual = residual;
                progress.problem = None;
                progress.poses += 1;
                progress.span = Some((progress.span.map_or(captured, |(first, _)| first), captured));
            }
            Posed::Measuring { done } => progress.activity = Activity::Calibrating(done),
            Posed::Refused(refusal) => {
                progress.activity = Activity::Refused;
                let problem = chain(&refusal);
                // Told when it changes, not a hundred times a second.
                if progress.problem.as_ref() != Some(&problem) {
                    tracing::error!("{problem}");
                    progress.problem = Some(problem);
                }
            }
        }
    }

    fn draw(&self, outgoing: &Outgoing, residual: Option<f64>) {
        if !self.parts.logger.enabled() {
            return;
        }
        let snapshot = self.parts.feedback.snapshot(now());
        let defaults = MappingParams::default();
        let (r1, r2) = snapshot
            .mapping
            .as_ref()
            .map_or((defaults.r1, defaults.r2), |mapping| (f64::from(mapping.r1), f64::from(mapping.r2)));
        self.parts.logger.log_operator(OperatorFrame {
            time: picture_time(outgoing.captured, snapshot.picture_offset_ns),
            pose: outgoing.pose,
            r1,
            r2,
            residual,
            round_trip: snapshot.round_trip.map(|round_trip| round_trip.as_secs_f64()),
        });
    }

    /// Repeats the last pose until the robot has it.
    fn confirm(&mut self) {
        {
            let mut progress = lock(&self.progress);
            progress.activity = Activity::Finished;
            progress.ended = true;
        }
        let Some(last) = self.last else { return };
        let end = now() + CONFIRM_FOR;
        let first = now();
        while now() < end {
            // The hand is still in this pose, now.
            self.parts.sender.send(Outgoing { captured: now(), ..last });
            let stop = self.parts.shutdown.wait(CONFIRM_EVERY);
            if self.parts.feedback.has_received(first) {
                lock(&self.progress).confirmed = true;
                return;
            }
            if stop {
                return;
            }
        }
    }
}

/// A moment of the own monotonic clock on the picture's time line: UNIX time on the robot's clock, ns; on the own
/// clock as long as the robot's is not known.
pub(crate) fn picture_time(at: MonoTime, picture_offset_ns: Option<i64>) -> i64 {
    let offset = picture_offset_ns.unwrap_or_else(wall_offset_ns);
    i64::try_from(at.0).unwrap_or(i64::MAX).saturating_add(offset)
}
