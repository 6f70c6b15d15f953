//! The combined joint-Cartesian mapping of Meattini, Chiaravalli, Palli and Melchiorri (IFAC 2020), Eq. 1-14.
//!
//! Far from the thumb a finger copies the master's joint angles (Eq. 7); near the thumb its tip follows the master's
//! tip relative to the thumb's (Eq. 9-12); in between the two targets are blended (Eq. 13) by a gain that falls from
//! 1 to 0 between two spheres of radius r1 and r2 around the master's thumb tip (Eq. 14). The printed equations have
//! errors; where this differs, the item says so.
//!
//! | module | one line |
//! |---|---|
//! | [`params`](MappingParams) | every parameter, the two presets, validation |
//! | [`gain`](Gain) | Eq. 14 |
//! | [`cartesian`](CartesianMap) | Eq. 9-12 |
//! | [`contact`](Contact) | a human touch is a robot touch, whatever distance the tracker reads |
//! | [`tuning`](Tuning) | what is known about one operator |
//! | [`tuner`](tune()) | scales and radii for one operator and one robot hand |
//! | [`baseline`](Baseline) | the objectives of AnyTeleop and DexPilot, to compare with |
//! | `thumb` | the thumb's joint mapping by directions |
//! | [`retargeter`](Retargeter) | the whole step: a [`crate::master::MasterPose`] in, a [`MappingOutput`] out |

mod baseline;
mod cartesian;
mod contact;
mod gain;
mod params;
mod retargeter;
mod thumb;
mod tuner;
mod tuning;

use nalgebra::Vector3;

pub use baseline::{Baseline, BaselineParams, Minimum, TipObjective};
pub use cartesian::CartesianMap;
pub use contact::Contact;
pub use gain::Gain;
pub use params::{Anchor, GainShape, MappingMode, MappingParams, ParamError, Pinned, ThumbGain, ThumbMap, TuningUse};
pub use retargeter::Retargeter;
pub use tuner::{Judge, Tuned, contacts, tune};
pub use tuning::{Tuning, TuningError};

use crate::hand::{Finger, JointVector, MAX_FINGERS};
use crate::ik::IkReport;

/// Every intermediate signal of one slave finger. Positions are tip poles in the palm frame, m.
///
/// In the modes `vector` and `dexpilot`, which blend nothing, `k` is 1 while `dexpilot` projects the finger onto the
/// thumb and otherwise 0, and `p_cartesian` and `p_input` both are the target of the tip: the thumb's tip for a
/// projected finger, otherwise the end of the scaled vector from the wrist.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FingerSignals {
    /// Which finger.
    pub finger: Finger,
    /// delta: distance of the master's fingertip from its thumb tip, m (for the thumb: of the closest finger).
    pub delta: f64,
    /// k: 0 joint mapping, 1 Cartesian mapping (Eq. 14).
    pub k: f64,
    /// p_Q: where the joint mapping puts the tip (Eq. 7).
    pub p_joint: Vector3<f64>,
    /// p_C: where the Cartesian mapping puts the tip (Eq. 9-12).
    pub p_cartesian: Vector3<f64>,
    /// p_input: the blend (Eq. 13).
    pub p_input: Vector3<f64>,
    /// The tip reached.
    pub p: Vector3<f64>,
    /// e_Q: distance from the clipped M_Q(q), rad (Eq. 4, per finger).
    pub e_q: f64,
    /// e_C: distance from p_C, m (Eq. 3, per finger).
    pub e_c: f64,
    /// How the inverse kinematics ended.
    pub ik: IkReport,
}

impl FingerSignals {
    /// All zero.
    #[must_use]
    pub fn zero(finger: Finger) -> Self {
        let origin = Vector3::zeros();
        Self {
            finger,
            delta: 0.0,
            k: 0.0,
            p_joint: origin,
            p_cartesian: origin,
            p_input: origin,
            p: origin,
            e_q: 0.0,
            e_c: 0.0,
            ik: IkReport::default(),
        }
    }
}

/// What the mapping makes of one master pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MappingOutput {
    /// Clipped M_Q(q), rad, wire order.
    pub q_joint: JointVector,
    /// The posture to command, rad, wire order.
    pub q: JointVector,
    signals: [FingerSignals; MAX_FINGERS],
    len: usize,
}

impl MappingOutput {
    /// An output with the given signals, thumb first; signals beyond [`MAX_FINGERS`] are left out.
    #[must_use]
    pub fn new(q_joint: JointVector, q: JointVector, signals: &[FingerSignals]) -> Self {
        let len = signals.len().min(MAX_FINGERS);
        let mut all = Finger::ALL.map(FingerSignals::zero);
        all[..len].copy_from_slice(&signals[..len]);
        Self { q_joint, q, signals: all, len }
    }

    /// Signals of the slave's fingers, thumb first.
    #[must_use]
    pub fn fingers(&self) -> &[FingerSignals] {
        &self.signals[..self.len]
    }

    /// Signals of one finger, if the slave has it.
    #[must_use]
    pub fn finger(&self, finger: Finger) -> Option<&FingerSignals> {
        self.fingers().iter().find(|signals| signals.finger == finger)
    }
}
