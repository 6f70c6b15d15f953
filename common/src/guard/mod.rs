//! Keeps the hand out of itself.
//!
//! [`TipGuard`] moves the posture that the mapping asks for to one whose fingertips touch instead of overlap.
//! [`MotionGuard`] watches the commands on the way there, of the tips and of all links and the palm
//! ([`Collision`](crate::hand::Collision)): whatever the targets do, no command brings two of them further into each
//! other than [`MAX_PENETRATION`].

mod motion;
mod tips;
mod world;

pub use motion::{Intervention, MAX_PENETRATION, MotionGuard};
pub use tips::TipGuard;

use nalgebra::Vector3;

/// From a to b; where they are in one place any direction is as good.
fn direction(between: Vector3<f64>) -> Vector3<f64> {
    between.try_normalize(1e-9).unwrap_or_else(Vector3::x)
}
