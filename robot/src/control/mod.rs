//! The robot's control core: what happens in one tick, as a pure function of time, the newest pose and the hand's state.
//!
//! ```text
//! pose -> Gate (whose, how old) -> slot -> Controller::tick: watchdog -> mapping + IK -> Conditioner -> PD -> HandDriver
//! ```
//!
//! Nothing here reads a clock, locks, logs, waits or allocates.

mod controller;
mod gate;

pub use controller::{ControlParams, Controller, Fault, PoseSample, TickRecord};
pub use gate::{Gate, GateParams};
pub use teleop_common::conditioner::{Conditioner, JointLimits};
