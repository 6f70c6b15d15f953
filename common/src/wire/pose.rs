use std::f32::consts::TAU;

use serde::{Deserialize, Serialize};

use super::codec::sealed::Sealed;
use super::{Checked, Echo, Header, Kind, Message, WireError, check};
use crate::master::{MasterGeometry, MasterPose};
use crate::time::MonoTime;

/// A pose of the master hand, with the hand's geometry: a robot needs no other message to follow it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseMessage {
    /// Header.
    pub header: Header,
    /// The newest joint state received from the robot.
    pub echo: Echo,
    /// When the hand was in this pose, sender's clock; not after `header.sent`.
    pub captured: MonoTime,
    /// Joint angles of the paradigmatic hand, rad; thumb, index, middle, ring, little, four each.
    pub q: [f32; 20],
    /// Origins of the fingers' base frames in O_W, m.
    pub bases: [[f32; 3]; 5],
    /// Phalanx lengths, m, palm outwards.
    pub phalanges: [[f32; 3]; 5],
}

impl PoseMessage {
    /// The message of a pose.
    #[must_use]
    pub fn new(header: Header, echo: Echo, captured: MonoTime, pose: &MasterPose) -> Self {
        let single = |rows: [[f64; 3]; 5]| rows.map(|row| row.map(|value| value as f32));
        Self {
            header,
            echo,
            captured,
            q: pose.q.map(|angle| angle as f32),
            bases: single(pose.geometry.bases),
            phalanges: single(pose.geometry.phalanges),
        }
    }
}

impl Checked<PoseMessage> {
    /// The pose.
    #[must_use]
    pub fn pose(&self) -> MasterPose {
        let double = |rows: [[f32; 3]; 5]| rows.map(|row| row.map(f64::from));
        MasterPose {
            q: self.q.map(f64::from),
            geometry: MasterGeometry { bases: double(self.bases), phalanges: double(self.phalanges) },
        }
    }
}

impl Sealed for PoseMessage {}

impl Message for PoseMessage {
    const KIND: Kind = Kind::Pose;
    const LEN: usize = 264;

    fn header(&self) -> &Header {
        &self.header
    }

    fn check(&self) -> Result<(), WireError> {
        check::within("q", &self.q, -TAU, TAU, "-2 pi to 2 pi rad")?;
        let within_palm = "finite, within 0.25 m of the wrist";
        check::within("bases", self.bases.as_flattened(), -0.25, 0.25, within_palm)?;
        for (finger, &[x, y, z]) in self.bases.iter().enumerate() {
            if x * x + y * y + z * z > 0.25 * 0.25 {
                return Err(WireError::Value { field: "bases", index: 3 * finger, value: x, allowed: within_palm });
            }
        }
        // Index, middle, ring, little from the thumb side outwards; a mirrored hand would be mapped crosswise.
        for finger in 2..5 {
            let value = self.bases[finger][0];
            if value >= self.bases[finger - 1][0] {
                let allowed = "x falling from index to little";
                return Err(WireError::Value { field: "bases", index: 3 * finger, value, allowed });
            }
        }
        check::within("phalanges", self.phalanges.as_flattened(), 0.003, 0.15, "0.003 to 0.15 m")
    }
}
