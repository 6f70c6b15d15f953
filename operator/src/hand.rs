//! From what a source gives to poses of the master hand.

use std::time::Duration;

use teleop_common::master::{MasterGeometry, MasterPose};

/// A hand at one moment, as a source gives it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Hand {
    /// Joint angles of the paradigmatic hand, rad.
    Angles([f64; 20]),
}

/// A hand that cannot be followed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum HandError {}

/// What became of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Posed {
    /// A pose.
    Pose {
        /// The pose.
        pose: MasterPose,
        /// Fit residual of keypoints (root mean square), m.
        residual: Option<f64>,
    },
    /// The hand is still being measured; how far, 0 to 1.
    Calibrating(f64),
}

/// Makes poses of what a source gives.
#[derive(Debug)]
pub struct PoseFinder {
    geometry: MasterGeometry,
}

impl PoseFinder {
    /// For joint angles of this hand.
    #[must_use]
    pub fn angles(geometry: MasterGeometry) -> Self {
        Self { geometry }
    }

    /// The pose of `hand`, seen `time` after the start.
    ///
    /// # Errors
    /// [`HandError`]
    pub fn pose(&mut self, _time: Duration, hand: &Hand) -> Result<Posed, HandError> {
        match hand {
            Hand::Angles(q) => Ok(Posed::Pose { pose: MasterPose { q: *q, geometry: self.geometry }, residual: None }),
        }
    }
}
