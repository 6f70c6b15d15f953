//! Which hand the keypoints are of, and whether they are in the frame the sender claims.
//!
//! Fingers bend towards the palm: the sense in which the PIP and DIP joints turn, against the normal of the
//! knuckles, tells a right hand from a left one (or from a mirror image) without trusting any label. One frame says
//! little when the fingers are straight, so evidence is gathered over frames and fades, so that a change of hands
//! is noticed.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::keypoints::{Keypoints, PalmFrame};
use crate::hand::{Finger, HandSide};

/// What remains of the evidence after one more frame; 1/(1-this) frames matter.
const MEMORY: f64 = 0.99;
/// Evidence needed for a verdict. A fist gives about 6 per frame, a relaxed hand about 1, noise of 3 mm below 1
/// either way.
const ENOUGH: f64 = 6.0;
/// Share of the evidence that must agree.
const AGREEMENT: f64 = 0.6;
/// Frames before a frame is judged.
const MIN_FRAMES: f64 = 10.0;
/// Turn that is more than the differing conventions of trackers, rad.
const MAX_TURN: f64 = 25.0 * std::f64::consts::PI / 180.0;

/// Which hand it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SideVerdict {
    /// The keypoints are those of this hand.
    Hand(HandSide),
    /// Not enough bending seen yet, or contradictory.
    Undecided,
}

/// What is wrong with a stream of keypoints.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Diagnosis {
    /// Fingers bend the wrong way for the expected hand.
    #[error(
        "keypoints are those of a {} hand (or of a mirrored image), expected a {} hand; fingers agree to {:.0} %",
        found.name(), expected.name(), agreement * 100.0
    )]
    OtherHand {
        /// The hand that was expected.
        expected: HandSide,
        /// The hand that was seen.
        found: HandSide,
        /// Share of the evidence that says so, 0.6 to 1.
        agreement: f64,
    },
    /// The keypoints are not in the palm frame.
    #[error(
        "keypoints are turned by {:.0} deg about {} against the palm frame (x palmar, y radial, z distal)",
        angle.to_degrees(), AxisName(*axis)
    )]
    Turned {
        /// How far, rad, right-hand rule about `axis`.
        angle: f64,
        /// Unit vector in the claimed palm frame: palmar, radial, distal.
        axis: [f64; 3],
    },
}

struct AxisName([f64; 3]);

impl std::fmt::Display for AxisName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names = ["palmar", "radial", "distal"];
        // Within 25 deg of an axis it is that axis.
        match self.0.iter().position(|x| x.abs() > 0.906) {
            Some(k) => write!(f, "the {} axis", names[k]),
            None => write!(f, "the axis palmar {:.2}, radial {:.2}, distal {:.2}", self.0[0], self.0[1], self.0[2]),
        }
    }
}

/// Gathers evidence about side and frame over the keypoints of a stream; constant size.
#[derive(Clone, Copy, Debug)]
pub struct Inspector {
    /// Faded sums: of the signed evidence (positive right), of its magnitude, of palm rotations, of frames.
    signed: f64,
    magnitude: f64,
    rotation: Matrix3<f64>,
    frames: f64,
}

impl Default for Inspector {
    fn default() -> Self {
        Self { signed: 0.0, magnitude: 0.0, rotation: Matrix3::zeros(), frames: 0.0 }
    }
}

impl Inspector {
    /// Takes one frame into account.
    pub fn push(&mut self, keypoints: &Keypoints) {
        let palm = PalmFrame::estimate(keypoints);
        let evidence = bending(keypoints, &palm.radial);
        self.signed = MEMORY * self.signed + evidence;
        self.magnitude = MEMORY * self.magnitude + evidence.abs();
        if let Some(rotation) = recorded_rotation(keypoints) {
            self.rotation = self.rotation * MEMORY + rotation;
            self.frames = MEMORY * self.frames + 1.0;
        }
    }

    /// Which hand it is, as far as known.
    #[must_use]
    pub fn side(&self) -> SideVerdict {
        if self.signed.abs() < ENOUGH || self.agreement() < AGREEMENT {
            return SideVerdict::Undecided;
        }
        SideVerdict::Hand(if self.signed > 0.0 { HandSide::Right } else { HandSide::Left })
    }

    /// How much of the evidence agrees with the verdict, 0 to 1.
    #[must_use]
    pub fn agreement(&self) -> f64 {
        if self.magnitude > 0.0 { self.signed.abs() / self.magnitude } else { 0.0 }
    }

    /// Checks the side against `expected`, then, if the sender says that the keypoints are in the palm frame of the
    /// recordings (x palmar, y radial, z distal), the frame. `None` if nothing is known to be wrong.
    #[must_use]
    pub fn diagnose(&self, expected: HandSide, claims_palm_frame: bool) -> Option<Diagnosis> {
        if let SideVerdict::Hand(found) = self.side()
            && found != expected
        {
            return Some(Diagnosis::OtherHand { expected, found, agreement: self.agreement() });
        }
        if !claims_palm_frame || self.frames < MIN_FRAMES.min(1.0 / (1.0 - MEMORY)) {
            return None;
        }
        let mean = Rotation3::from_matrix_eps(&self.rotation, 1e-9, 50, Rotation3::identity());
        let (axis, angle) = mean.axis_angle()?;
        (angle > MAX_TURN).then(|| signed_turn(axis.into_inner(), angle))
    }
}

/// The same turn about the axis whose largest component is positive.
fn signed_turn(axis: Vector3<f64>, angle: f64) -> Diagnosis {
    let sign = axis[axis.iamax()].signum();
    Diagnosis::Turned { angle: angle * sign, axis: (axis * sign).into() }
}

/// Columns palmar, radial, distal as the recordings define them: distal to the middle knuckle, the knuckle of the index
/// in the plane of radial and distal. It differs by some 15 deg about the distal axis from [`PalmFrame`], which
/// averages over the arch of the knuckles. `None` if the two knuckles and the wrist are in line.
fn recorded_rotation(keypoints: &Keypoints) -> Option<Matrix3<f64>> {
    let distal = (keypoints.base(Finger::Middle) - keypoints.wrist()).normalize();
    let palmar = (keypoints.base(Finger::Index) - keypoints.wrist()).cross(&distal).try_normalize(1e-6)?;
    Some(Matrix3::from_columns(&[palmar, distal.cross(&palmar), distal]))
}

/// Sum over index to little of the sines of PIP and DIP flexion about the radial axis: positive for a right hand.
/// The knuckles are left out, because they also bend backwards; the thumb, because it turns.
fn bending(keypoints: &Keypoints, radial: &Vector3<f64>) -> f64 {
    Finger::ALL[1..]
        .iter()
        .map(|&finger| {
            let [base, pip, dip, tip] = keypoints.finger(finger);
            let bones = [pip - base, dip - pip, tip - dip].map(|bone| bone.normalize());
            (bones[0].cross(&bones[1]) + bones[1].cross(&bones[2])).dot(radial)
        })
        .sum()
}
