//! The human (master) hand: the paradigmatic hand of 20 joints.
//!
//! Frame O_W: origin at the wrist, x radial (towards the thumb side), y distal, z palmar, for either hand. Joint
//! order: thumb, index, middle, ring, little, four each: abduction, MCP flexion, PIP, DIP (thumb: CMC rotation, CMC
//! flexion, MCP, IP).

mod gesture;
mod model;

pub use gesture::{FINGER_TAPS, Gesture, OPEN, UnknownGesture, minimum_jerk};
pub use model::{FingerJacobian, JOINT_LIMITS, JointRange, MAX_ANGLE, MasterError, MasterGeometry, MasterPose};
