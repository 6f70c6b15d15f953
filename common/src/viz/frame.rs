use crate::hand::JointVector;
use crate::mapping::MappingOutput;
use crate::master::MasterPose;
use crate::mode::Mode;

/// A state of the operator's side.
#[derive(Clone, Copy, Debug)]
pub struct OperatorFrame {
    /// Time of the pose, ns since the UNIX epoch on the robot's clock.
    pub time: i64,
    /// The human hand.
    pub pose: MasterPose,
    /// r1, m.
    pub r1: f64,
    /// r2, m.
    pub r2: f64,
    /// How far the fitted hand is from the tracker's keypoints (root mean square), m; `None` without keypoints.
    pub residual: Option<f64>,
    /// Round trip to the robot, s; `None` while not connected.
    pub round_trip: Option<f64>,
}

/// A state of the robot.
#[derive(Clone, Copy, Debug)]
pub struct RobotFrame {
    /// Time of the measurement, ns since the UNIX epoch on the robot's clock.
    pub time: i64,
    /// Measured joint angles, rad, wire order.
    pub q: JointVector,
    /// Measured joint velocities, rad/s, wire order.
    pub dq: JointVector,
    /// Commanded joint angles, rad, wire order.
    pub q_command: JointVector,
    /// Signals of the mapping, if a pose has been mapped yet.
    pub mapping: Option<MappingOutput>,
    /// The robot's mode.
    pub mode: Mode,
    /// Age of the pose that the hand follows, with the delay of the playout, robot's clock, s; `None` before the first.
    pub pose_age: Option<f64>,
    /// Longest duration of a control tick since the last frame, s.
    pub tick: Option<f64>,
}

/// How serious a line is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Level {
    /// Good to know.
    Info,
    /// Should be looked at.
    Warn,
    /// Something failed.
    Error,
}

impl Level {
    /// Upper-case name, as log files have it.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Info => "INFO",
            Self::Warn => "WARN",
            Self::Error => "ERROR",
        }
    }
}

/// What waits in the queue.
#[derive(Clone, Copy, Debug)]
#[allow(clippy::large_enum_variant, reason = "a boxed frame would allocate and free where it is logged")]
pub(super) enum Frame {
    Operator(OperatorFrame),
    Robot(RobotFrame),
}

/// A line for people, of bounded length.
#[derive(Clone, Debug)]
pub(super) struct Line {
    pub(super) time: i64,
    pub(super) level: Level,
    pub(super) message: String,
}

impl Line {
    /// Longest message, bytes; longer ones are cut.
    const LIMIT: usize = 1024;

    pub(super) fn new(time: i64, level: Level, message: &str) -> Self {
        let end = message.floor_char_boundary(Self::LIMIT);
        Self { time, level, message: message[..end].to_owned() }
    }
}
