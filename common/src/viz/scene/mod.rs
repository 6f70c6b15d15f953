//! Frames to Rerun's archetypes.

mod operator;
mod robot;
mod series;
pub(super) mod space;

use rerun::{RecordingStream, RecordingStreamResult, StateChange, TextLog};

use super::TIMELINE;
use super::frame::{Frame, Line};
use crate::hand::{Finger, HandModel, HandSide};

/// 3D: smooth enough for the eye; more only keeps browsers without a graphics card from following.
const SPACE_PERIOD: i64 = 1_000_000_000 / 25;
/// Plots.
const PLOT_PERIOD: i64 = 1_000_000_000 / 50;

/// What a process draws.
#[derive(Clone, Debug)]
pub enum Scene {
    /// The operator's side.
    Operator {
        /// The robot's name: processes of one name share one recording.
        name: String,
        /// Which hand the operator uses.
        side: HandSide,
        /// The fingers that oppose the thumb on the robot.
        opposing: Vec<Finger>,
    },
    /// The robot's side.
    Robot {
        /// The robot's name.
        name: String,
        /// The hand.
        hand: Box<HandModel>,
    },
}

impl Scene {
    /// The operator's scene for the robot `name`, whose fingers are those of an Allegro Hand.
    #[must_use]
    pub fn operator(name: &str, side: HandSide) -> Self {
        let opposing = vec![Finger::Index, Finger::Middle, Finger::Ring];
        Self::Operator { name: name.to_owned(), side, opposing }
    }

    /// The scene of the robot `name` with this hand.
    #[must_use]
    pub fn robot(name: &str, hand: &HandModel) -> Self {
        Self::Robot { name: name.to_owned(), hand: Box::new(hand.clone()) }
    }

    /// Id of the recording, the same in both processes.
    pub(super) fn recording(&self) -> &str {
        match self {
            Self::Operator { name, .. } | Self::Robot { name, .. } => name,
        }
    }

    const fn root(&self) -> &'static str {
        match self {
            Self::Operator { .. } => "operator",
            Self::Robot { .. } => "robot",
        }
    }
}

/// Writes a scene into one recording stream, which knows nothing of it yet.
pub(super) struct Writer<'a> {
    stream: &'a RecordingStream,
    root: &'static str,
    drawing: Drawing<'a>,
}

enum Drawing<'a> {
    Operator(operator::Drawing<'a>),
    Robot(robot::Drawing<'a>),
}

impl<'a> Writer<'a> {
    /// Sends all that does not change.
    pub(super) fn new(scene: &'a Scene, stream: &'a RecordingStream) -> RecordingStreamResult<Self> {
        stream.set_log_time_enabled(false);
        let drawing = match scene {
            Scene::Operator { side, opposing, .. } => {
                Drawing::Operator(operator::Drawing::new(*side, opposing, stream)?)
            }
            Scene::Robot { hand, .. } => Drawing::Robot(robot::Drawing::new(hand, stream)?),
        };
        Ok(Self { stream, root: scene.root(), drawing })
    }

    pub(super) fn frame(&mut self, frame: &Frame) -> RecordingStreamResult<()> {
        match (&mut self.drawing, frame) {
            (Drawing::Operator(drawing), Frame::Operator(frame)) => drawing.draw(frame, self.stream),
            (Drawing::Robot(drawing), Frame::Robot(frame)) => drawing.draw(frame, self.stream),
            // A process logs its own side only.
            _ => Ok(()),
        }
    }

    pub(super) fn line(&self, line: &Line) -> RecordingStreamResult<()> {
        self.stream.set_timestamp_nanos_since_epoch(TIMELINE, line.time);
        let text = TextLog::new(line.message.as_str()).with_level(line.level.name());
        self.stream.log(format!("{}/log", self.root), &text)
    }

    /// Sends what is still being collected.
    pub(super) fn finish(&mut self) -> RecordingStreamResult<()> {
        match &mut self.drawing {
            Drawing::Operator(drawing) => drawing.finish(self.stream),
            Drawing::Robot(drawing) => drawing.finish(self.stream),
        }
    }
}

/// Lets frames through at a steady rate of their own time stamps.
struct Pace {
    period: i64,
    last: Option<i64>,
}

impl Pace {
    const fn new(period: i64) -> Self {
        Self { period, last: None }
    }

    fn due(&mut self, time: i64) -> bool {
        // Half a control period of slack, or 100 Hz would give 20 Hz for 25 whenever a frame comes early.
        const SLACK: i64 = 1_500_000;
        let due = self.last.is_none_or(|last| {
            let elapsed = time.saturating_sub(last);
            elapsed < 0 || elapsed >= self.period - SLACK
        });
        if due {
            self.last = Some(time);
        }
        due
    }
}

/// A state lane, written when the state changes and every second, so that any window of time has it.
struct Lane {
    path: &'static str,
    state: Option<&'static str>,
    repeat: Pace,
}

impl Lane {
    const fn new(path: &'static str) -> Self {
        Self { path, state: None, repeat: Pace::new(1_000_000_000) }
    }

    fn set(&mut self, time: i64, state: &'static str, stream: &RecordingStream) -> RecordingStreamResult<()> {
        let due = self.repeat.due(time);
        if self.state == Some(state) && !due {
            return Ok(());
        }
        self.state = Some(state);
        stream.log(self.path, &StateChange::single(state))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pace_thins_out_and_survives_a_clock_that_jumps_back() {
        let mut pace = Pace::new(SPACE_PERIOD);
        let passed = (0..3330).filter(|tick| pace.due(tick * 3_003_003)).count();
        assert!((240..=270).contains(&passed), "{passed} in 10 s");
        assert!(pace.due(0));
        assert!(!pace.due(1));
    }
}
