use serde::{Deserialize, Serialize};

use super::codec::sealed::Sealed;
use super::{Checked, Echo, Header, Kind, Message, WireError};
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

    fn to_pose(self) -> MasterPose {
        let double = |rows: [[f32; 3]; 5]| rows.map(|row| row.map(f64::from));
        MasterPose {
            q: self.q.map(f64::from),
            geometry: MasterGeometry { bases: double(self.bases), phalanges: double(self.phalanges) },
        }
    }
}

impl Checked<PoseMessage> {
    /// The pose; it passes [`MasterPose::validate`].
    #[must_use]
    pub fn pose(&self) -> MasterPose {
        self.to_pose()
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
        Ok(self.to_pose().validate()?)
    }
}
