use serde::{Deserialize, Serialize};

use super::codec::sealed::Sealed;
use super::{Checked, Echo, Header, Kind, Message, WireError, check};
use crate::authority::{Clutch, Intent, OperatorName};
use crate::mapping::Tuning;
use crate::master::{MasterGeometry, MasterPose};
use crate::time::MonoTime;

/// A pose of the master hand, with the hand's geometry and tuning and what its owner wants: a robot needs no other
/// message to follow it.
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
    /// What the mapping should know about the operator, all zero if nothing is known.
    pub tuning: TuningMessage,
    /// [`Clutch`]
    pub clutch: u32,
    /// Bit 0: take over; bit 1: leave.
    pub request: u8,
    /// The operator's name.
    pub operator: OperatorName,
}

const TAKEOVER: u8 = 1;
const LEAVING: u8 = 2;

/// [`Tuning`] on the wire.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TuningMessage {
    /// c_s of thumb, index, middle, ring, little.
    pub scale: [f32; 5],
    /// r1, m.
    pub r1: f32,
    /// r2, m.
    pub r2: f32,
    /// Distances at which the keypoints of thumb and finger touch, m.
    pub contact: [f32; 5],
}

impl From<Tuning> for TuningMessage {
    fn from(tuning: Tuning) -> Self {
        let single = |values: [f64; 5]| values.map(|value| value as f32);
        Self {
            scale: single(tuning.scale),
            r1: tuning.r1 as f32,
            r2: tuning.r2 as f32,
            contact: single(tuning.contact),
        }
    }
}

impl TuningMessage {
    fn to_tuning(self) -> Option<Tuning> {
        (self != Self::default()).then(|| Tuning {
            scale: self.scale.map(f64::from),
            r1: self.r1.into(),
            r2: self.r2.into(),
            contact: self.contact.map(f64::from),
        })
    }
}

impl PoseMessage {
    /// The message of a pose.
    #[must_use]
    pub fn new(header: Header, echo: Echo, captured: MonoTime, pose: &MasterPose, intent: Intent) -> Self {
        let single = |rows: [[f64; 3]; 5]| rows.map(|row| row.map(|value| value as f32));
        Self {
            header,
            echo,
            captured,
            q: pose.q.map(|angle| angle as f32),
            bases: single(pose.geometry.bases),
            phalanges: single(pose.geometry.phalanges),
            tuning: pose.tuning.map_or_else(TuningMessage::default, Into::into),
            clutch: intent.clutch.0,
            request: (u8::from(intent.takeover) * TAKEOVER) | (u8::from(intent.leaving) * LEAVING),
            operator: intent.operator,
        }
    }

    /// What the operator wants.
    #[must_use]
    pub const fn intent(&self) -> Intent {
        Intent {
            clutch: Clutch(self.clutch),
            takeover: self.request & TAKEOVER != 0,
            leaving: self.request & LEAVING != 0,
            operator: self.operator,
        }
    }

    fn to_pose(self) -> MasterPose {
        let double = |rows: [[f32; 3]; 5]| rows.map(|row| row.map(f64::from));
        MasterPose {
            q: self.q.map(f64::from),
            geometry: MasterGeometry { bases: double(self.bases), phalanges: double(self.phalanges) },
            tuning: self.tuning.to_tuning(),
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
    const LEN: usize = 333;

    fn header(&self) -> &Header {
        &self.header
    }

    fn check(&self) -> Result<(), WireError> {
        check::count("request", self.request, 0, 3, "0 to 3")?;
        check::name("operator", &self.operator)?;
        Ok(self.to_pose().validate()?)
    }
}
