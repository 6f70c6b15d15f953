use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::codec::sealed::Sealed;
use super::joints::pack_joints;
use super::{Header, Kind, Message, WireError, check};
use crate::hand::{Finger, JointVector, MAX_FINGERS, MAX_JOINTS};
use crate::ik::{IkReport, IkStatus};
use crate::mapping::{FingerSignals, MappingOutput};

/// The mapping's signals of one finger, see [`FingerSignals`]. Positions are tip poles in the palm frame, m.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FingerMessage {
    /// [`Finger::index`]
    pub finger: u8,
    /// Distance of the master's fingertip from its thumb tip, m.
    pub delta: f32,
    /// 0 joint mapping, 1 Cartesian mapping.
    pub k: f32,
    /// p_Q
    pub p_joint: [f32; 3],
    /// p_C
    pub p_cartesian: [f32; 3],
    /// The blend.
    pub p_input: [f32; 3],
    /// The tip reached.
    pub p: [f32; 3],
    /// e_Q, rad.
    pub e_q: f32,
    /// e_C, m.
    pub e_c: f32,
    /// How the inverse kinematics ended: 0 skipped, 1 reached, 2 unreachable, 3 out of budget.
    pub ik: u8,
    /// Distance from the reached tip to its target, m.
    pub residual: f32,
}

/// What the mapping made of the newest pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MappingMessage {
    /// Header.
    pub header: Header,
    /// The control tick these signals belong to.
    pub tick: u64,
    /// Radius within which the mapping is Cartesian, m.
    pub r1: f32,
    /// Radius beyond which the mapping is of joints, m.
    pub r2: f32,
    /// How many fingers the hand has, 1 to 5.
    pub fingers: u8,
    /// How many joints the hand has, 1 to 25.
    pub joints: u8,
    /// Clipped M_Q(q), rad; zero beyond `joints`.
    pub q_joint: [f32; MAX_JOINTS],
    /// The fingers, thumb first; zero beyond `fingers`.
    pub signals: [FingerMessage; MAX_FINGERS],
}

impl FingerMessage {
    fn new(signals: &FingerSignals) -> Self {
        let point = |p: &Vector3<f64>| [p.x as f32, p.y as f32, p.z as f32];
        Self {
            finger: signals.finger.index() as u8,
            delta: signals.delta as f32,
            k: signals.k as f32,
            p_joint: point(&signals.p_joint),
            p_cartesian: point(&signals.p_cartesian),
            p_input: point(&signals.p_input),
            p: point(&signals.p),
            e_q: signals.e_q as f32,
            e_c: signals.e_c as f32,
            ik: match signals.ik.status {
                IkStatus::Skipped => 0,
                IkStatus::Reached => 1,
                IkStatus::Unreachable => 2,
                IkStatus::Budget => 3,
            },
            residual: signals.ik.residual as f32,
        }
    }

    /// Back to the mapping's own type; `None` for an unknown finger or ending, which no decoded message has.
    ///
    /// The number of iterations is not on the wire and is zero.
    #[must_use]
    pub fn signals(&self) -> Option<FingerSignals> {
        let point = |p: [f32; 3]| Vector3::from(p.map(f64::from));
        let status = match self.ik {
            0 => IkStatus::Skipped,
            1 => IkStatus::Reached,
            2 => IkStatus::Unreachable,
            3 => IkStatus::Budget,
            _ => return None,
        };
        Some(FingerSignals {
            finger: *Finger::ALL.get(usize::from(self.finger))?,
            delta: self.delta.into(),
            k: self.k.into(),
            p_joint: point(self.p_joint),
            p_cartesian: point(self.p_cartesian),
            p_input: point(self.p_input),
            p: point(self.p),
            e_q: self.e_q.into(),
            e_c: self.e_c.into(),
            ik: IkReport { status, residual: self.residual.into(), ..IkReport::default() },
        })
    }

    fn check(&self) -> Result<(), WireError> {
        let length = "0 to 10 m";
        check::count("ik", self.ik, 0, 3, "0 to 3")?;
        check::within("delta", &[self.delta], 0.0, 10.0, length)?;
        check::within("k", &[self.k], 0.0, 1.0, "0 to 1")?;
        check::position("p_joint", &self.p_joint)?;
        check::position("p_cartesian", &self.p_cartesian)?;
        check::position("p_input", &self.p_input)?;
        check::position("p", &self.p)?;
        check::within("e_q", &[self.e_q], 0.0, 1000.0, "0 to 1000 rad")?;
        check::within("e_c", &[self.e_c], 0.0, 10.0, length)?;
        check::within("residual", &[self.residual], 0.0, 10.0, length)
    }
}

impl MappingMessage {
    /// The message of a mapping's output; `r1` and `r2` in m.
    #[must_use]
    pub fn new(header: Header, tick: u64, r1: f64, r2: f64, output: &MappingOutput) -> Self {
        let mut signals = [FingerMessage::default(); MAX_FINGERS];
        for (slot, finger) in signals.iter_mut().zip(output.fingers()) {
            *slot = FingerMessage::new(finger);
        }
        Self {
            header,
            tick,
            r1: r1 as f32,
            r2: r2 as f32,
            fingers: output.fingers().len().min(MAX_FINGERS) as u8,
            joints: output.q_joint.len() as u8,
            q_joint: pack_joints(&output.q_joint),
            signals,
        }
    }

    /// The fingers, thumb first.
    #[must_use]
    pub fn fingers(&self) -> &[FingerMessage] {
        &self.signals[..usize::from(self.fingers).min(MAX_FINGERS)]
    }

    /// Clipped M_Q(q), rad.
    #[must_use]
    pub fn q_joint(&self) -> JointVector {
        JointVector::from_slice(&self.q_joint.map(f64::from)[..usize::from(self.joints).min(MAX_JOINTS)])
    }
}

impl Sealed for MappingMessage {}

impl Message for MappingMessage {
    const KIND: Kind = Kind::Mapping;
    const LEN: usize = 500;

    fn header(&self) -> &Header {
        &self.header
    }

    fn check(&self) -> Result<(), WireError> {
        let fingers = check::count("fingers", self.fingers, 1, MAX_FINGERS, "1 to 5")?;
        let joints = check::count("joints", self.joints, 1, MAX_JOINTS, "1 to 25")?;
        check::within("r1", &[self.r1], 0.0, 10.0, "0 to 10 m")?;
        check::within("r2", &[self.r2], self.r1, 10.0, "r1 to 10 m")?;
        check::angle("q_joint", &self.q_joint[..joints])?;
        check::zero("q_joint", &self.q_joint[joints..])?;
        let mut least = 0;
        for finger in &self.signals[..fingers] {
            let allowed = "0 to 4, rising from finger to finger";
            least = check::count("finger", finger.finger, least, MAX_FINGERS - 1, allowed)? + 1;
            finger.check()?;
        }
        if let Some(finger) = self.signals[fingers..].iter().find(|finger| **finger != FingerMessage::default()) {
            return Err(WireError::Code {
                field: "finger",
                value: finger.finger,
                allowed: "0 in all fields (padding)",
            });
        }
        Ok(())
    }
}
