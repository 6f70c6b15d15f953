//! The combined joint-Cartesian mapping of Meattini, Chiaravalli, Palli and Melchiorri (IFAC 2020), Eq. 1-14.

use nalgebra::Vector3;

use crate::hand::{Finger, JointVector, MAX_FINGERS};
use crate::ik::IkReport;

/// Every intermediate signal of one slave finger. Positions are tip poles in the palm frame, m.
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
    /// Signals of the slave's fingers, thumb first.
    #[must_use]
    pub fn fingers(&self) -> &[FingerSignals] {
        &self.signals[..self.len]
    }
}
