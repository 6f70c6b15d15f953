//! A scripted gesture through the mapping, sample by sample.

use crate::hand::HandModel;
use crate::mapping::{MappingOutput, MappingParams, ParamError, Retargeter};
use crate::master::{Gesture, MasterGeometry, MasterPose};

/// One sample of a motion.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Time from the start, s.
    pub t: f64,
    /// The paradigmatic hand's pose.
    pub pose: MasterPose,
    /// What the mapping makes of it.
    pub output: MappingOutput,
}

/// The paradigmatic hand's pose at time `t` (s) of a gesture.
#[must_use]
pub fn pose(gesture: Gesture, t: f64) -> MasterPose {
    MasterPose { q: gesture.sample(t), geometry: MasterGeometry::PARADIGMATIC, tuning: None }
}

/// One run of the gesture, `rate` samples per second, both ends included.
///
/// # Errors
/// A mapping parameter that cannot be used.
pub fn run(hand: &HandModel, params: &MappingParams, gesture: Gesture, rate: f64) -> Result<Vec<Sample>, ParamError> {
    let mut retargeter = Retargeter::new(hand.clone(), params.clone())?;
    let count = (gesture.duration() * rate).round() as usize;
    let sample = |tick: usize| {
        let t = tick as f64 / rate;
        let pose = pose(gesture, t);
        Sample { t, pose, output: retargeter.map(&pose) }
    };
    Ok((0..=count).map(sample).collect())
}
