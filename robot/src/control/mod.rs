//! The robot's control core: what happens in one tick, as a pure function of time, the newest pose and the hand's state.
//!
//! ```text
//! pose -> Lease (whose, how old) -> slot -> Controller::tick: Machine (mode) -> mapping + IK -> Conditioner -> PD -> HandDriver
//! ```
//!
//! Nothing here reads a clock, locks, logs, waits or allocates.

mod controller;

pub use controller::{ControlParams, Controller, Fault, PoseSample, Relax, StopAction, TickRecord};
pub use teleop_common::conditioner::{Conditioner, JointLimits};
