//! The human (master) hand: the paradigmatic hand of 20 joints.
//!
//! Frame O_W: origin at the wrist, x radial (towards the thumb side), y distal, z palmar, for either hand. Joint
//! order: thumb, index, middle, ring, little, four each: abduction, MCP flexion, PIP, DIP (thumb: CMC rotation, CMC
//! flexion, MCP, IP). Joint angles come from a [`Gesture`], from a glove, or from 21 [`Keypoints`] by a [`Fitter`]
//! with the geometry of a [`Calibration`], and a [`Filter`] takes the tracker's noise out of them.

mod calibration;
mod filter;
mod fit;
mod gesture;
mod keypoints;
mod model;
mod side;

pub use calibration::{
    Calibration, CalibrationError, CalibrationTextError, Calibrator, HandTuning, MAX_FRAMES, MIN_FRAMES, Spread, Touch,
};
pub use filter::{Filter, FilterSettings};
pub use fit::{FIT_LIMITS, FingerFit, Fit, FitSettings, FitStatus, Fitter};
pub use gesture::{FINGER_TAPS, Gesture, OPEN, UnknownGesture, minimum_jerk};
pub use keypoints::{KEYPOINT_NAMES, Keypoints, KeypointsError, PalmFrame};

pub use model::{FingerJacobian, JOINT_LIMITS, JointRange, MAX_ANGLE, MasterError, MasterGeometry, MasterPose};
pub use side::{Diagnosis, Inspector, SideVerdict};
