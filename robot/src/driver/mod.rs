//! The joint interface of a hand: states out, torques in.

mod sim;

use std::time::Duration;

use teleop_common::hand::JointVector;

pub use sim::SimHand;

/// Measured state of the joints, wire order.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointState {
    /// Positions, rad.
    pub q: JointVector,
    /// Velocities, rad/s.
    pub dq: JointVector,
    /// Torques the hand applies, N m.
    pub tau: JointVector,
}

/// Command of one tick, wire order. A hand with its own position controller takes `q` and `dq`, any other `tau`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointCommand {
    /// Positions, rad.
    pub q: JointVector,
    /// Velocities, rad/s.
    pub dq: JointVector,
    /// Torques, N m.
    pub tau: JointVector,
}

impl JointCommand {
    /// No torque, at the measured posture.
    #[must_use]
    pub fn limp(state: &JointState) -> Self {
        let zero = JointVector::zeros(state.q.len());
        Self { q: state.q, dq: zero, tau: zero }
    }
}

/// Who sets the rhythm of the control loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pace {
    /// The loop: it ticks by its own clock and [`HandDriver::read`] returns at once.
    Loop,
    /// The hand: [`HandDriver::read`] waits for its next complete frame, and the loop ticks then.
    Hand,
}

/// Why a driver failed. `Copy`, because the control thread must not allocate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DriverError {
    /// No complete state within the time allowed.
    #[error("the hand sent no state within {0:?}: check its power and cable")]
    Silent(Duration),
    /// The connection is gone.
    #[error("the connection to the hand is gone")]
    Disconnected,
    /// The hand reported an error of its own.
    #[error("the hand reports error {0:#x}")]
    Device(u32),
    /// Called out of order.
    #[error("the driver is not started")]
    NotStarted,
}

/// A hand's joint interface.
///
/// Order of calls: `start`, then `read` and `write` in turn, then `stop`. A hand may keep its last torque for ever, so
/// whoever owns a driver calls [`HandDriver::stop`] on every way out; drivers do it on drop too.
pub trait HandDriver: Send {
    /// What it is, for logs.
    fn name(&self) -> &'static str;

    /// Who paces the loop.
    fn pace(&self) -> Pace;

    /// Activates the hand, without torque.
    ///
    /// # Errors
    /// The hand cannot be reached or is not the one configured.
    fn start(&mut self) -> Result<(), DriverError>;

    /// The newest state; waits at most `timeout` if the hand paces the loop.
    ///
    /// # Errors
    /// No state in time, or the hand failed.
    fn read(&mut self, timeout: Duration) -> Result<JointState, DriverError>;

    /// Sends a command; must not wait.
    ///
    /// # Errors
    /// The hand failed.
    fn write(&mut self, command: &JointCommand) -> Result<(), DriverError>;

    /// Takes the torque off. May be called at any time, more than once.
    fn stop(&mut self);
}
