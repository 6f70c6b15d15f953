use serde::{Deserialize, Serialize};

use super::codec::sealed::Sealed;
use super::{Echo, Header, Kind, Message, WireError, check};
use crate::hand::{JointVector, MAX_JOINTS};
use crate::mode::Mode;
use crate::time::MonoTime;

/// State of the robot hand's joints, in the hand's wire order.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct JointStateMessage {
    /// Header.
    pub header: Header,
    /// The newest pose received from the operator.
    pub echo: Echo,
    /// [`Mode::to_wire`]
    pub mode: u8,
    /// How many joints the hand has, 1 to 25.
    pub joints: u8,
    /// Control ticks since the start.
    pub tick: u64,
    /// UNIX time minus monotonic time of the robot, ns: labels recordings, nothing else.
    pub wall_offset_ns: i64,
    /// Epoch of the newest pose accepted, 0 if none; the hand follows it if the mode says so.
    pub pose_epoch: u64,
    /// Sequence number of the newest pose accepted.
    pub pose_seq: u64,
    /// Capture stamp of the newest pose accepted, operator's clock.
    pub pose_captured: MonoTime,
    /// Measured angles, rad; zero beyond `joints`, as in the next three.
    pub q: [f32; MAX_JOINTS],
    /// Measured velocities, rad/s.
    pub dq: [f32; MAX_JOINTS],
    /// Torques applied, N m.
    pub tau: [f32; MAX_JOINTS],
    /// Commanded angles after conditioning, rad.
    pub q_command: [f32; MAX_JOINTS],
    /// Number of the newest stop, 0 if there was none; it is in force in [`Mode::Stopped`].
    pub stop: u32,
    /// Epoch of the operator that has the robot, 0 if none.
    pub holder: u64,
}

impl JointStateMessage {
    /// Number of joints, never more than the arrays hold.
    #[must_use]
    pub fn joint_count(&self) -> usize {
        usize::from(self.joints).min(MAX_JOINTS)
    }

    /// The mode, if it is a known one, as it is in every decoded message.
    #[must_use]
    pub fn mode(&self) -> Option<Mode> {
        Mode::from_wire(self.mode)
    }

    /// Measured angles, rad.
    #[must_use]
    pub fn q(&self) -> JointVector {
        self.unpack(&self.q)
    }

    /// Measured velocities, rad/s.
    #[must_use]
    pub fn dq(&self) -> JointVector {
        self.unpack(&self.dq)
    }

    /// Torques, N m.
    #[must_use]
    pub fn tau(&self) -> JointVector {
        self.unpack(&self.tau)
    }

    /// Commanded angles, rad.
    #[must_use]
    pub fn q_command(&self) -> JointVector {
        self.unpack(&self.q_command)
    }

    fn unpack(&self, values: &[f32; MAX_JOINTS]) -> JointVector {
        JointVector::from_slice(&values.map(f64::from)[..self.joint_count()])
    }
}

/// One value per joint as messages carry it: `f32`, zero beyond the hand's joints.
#[must_use]
pub fn pack_joints(values: &[f64]) -> [f32; MAX_JOINTS] {
    let mut out = [0.0; MAX_JOINTS];
    for (slot, &value) in out.iter_mut().zip(values) {
        *slot = value as f32;
    }
    out
}

impl Sealed for JointStateMessage {}

impl Message for JointStateMessage {
    const KIND: Kind = Kind::JointState;
    const LEN: usize = 510;

    fn header(&self) -> &Header {
        &self.header
    }

    fn check(&self) -> Result<(), WireError> {
        check::count("mode", self.mode, 0, Mode::ALL.len() - 1, "0 to 7")?;
        let joints = check::count("joints", self.joints, 1, MAX_JOINTS, "1 to 25")?;
        check::angle("q", &self.q[..joints])?;
        check::within("dq", &self.dq[..joints], -1e4, 1e4, "-1e4 to 1e4 rad/s")?;
        check::within("tau", &self.tau[..joints], -1e4, 1e4, "-1e4 to 1e4 N m")?;
        check::angle("q_command", &self.q_command[..joints])?;
        check::zero("q", &self.q[joints..])?;
        check::zero("dq", &self.dq[joints..])?;
        check::zero("tau", &self.tau[joints..])?;
        check::zero("q_command", &self.q_command[joints..])
    }
}
