use serde::{Deserialize, Serialize};

use crate::hand::{Finger, MAX_FINGERS};

/// Least width of the band between the two spheres, m.
pub(super) const MIN_BAND: f64 = 0.001;

/// What the mapping is told of an operator: how large the hand is for the robot's, and how far apart its keypoints are
/// when fingers touch. Travels with every pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tuning {
    /// c_s, robot lengths per human length: of the thumb's map (Eq. 10-12) and of each finger's vector from the thumb
    /// (Eq. 9); thumb, index, middle, ring, little.
    pub scale: [f64; MAX_FINGERS],
    /// r1, m of the human hand.
    pub r1: f64,
    /// r2, m of the human hand.
    pub r2: f64,
    /// Distance of the keypoints of thumb and finger below which they touch, m: a tracker's lie inside the fingertips.
    /// 0 for an exact model of the hand; the thumb's own is not used.
    pub contact: [f64; MAX_FINGERS],
}

/// A tuning that no operator can have.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("tuning: {name} of the {} is {value}; expected {rule}", finger.name())]
pub struct TuningError {
    /// The field.
    pub name: &'static str,
    /// Its finger; the thumb for r1 and r2.
    pub finger: Finger,
    /// The value.
    pub value: f64,
    /// What is allowed.
    pub rule: &'static str,
}

impl Tuning {
    /// Checks the ranges, as data from a file or the network must be.
    ///
    /// # Errors
    /// Names the first number that is not finite or out of its range.
    pub fn validate(&self) -> Result<(), TuningError> {
        let range = |name, finger, value: f64, ok: bool, rule| {
            // A comparison that holds, so that NaN fails too.
            if ok { Ok(()) } else { Err(TuningError { name, finger, value, rule }) }
        };
        let Self { scale, r1, r2, contact } = self;
        for finger in Finger::ALL {
            let value = scale[finger.index()];
            range("scale", finger, value, (0.1..=10.0).contains(&value), "0.1 to 10")?;
        }
        range("r1", Finger::Thumb, *r1, *r1 > 0.0 && *r1 < 0.3, "metres, above 0 and below 0.3")?;
        range("r2", Finger::Thumb, *r2, *r2 >= r1 + MIN_BAND && *r2 < 0.5, "at least r1 + 0.001 and below 0.5 m")?;
        for finger in Finger::ALL {
            let value = contact[finger.index()];
            range("contact", finger, value, (0.0..=*r1).contains(&value), "0 to r1, in metres")?;
        }
        Ok(())
    }
}
