//! The hand description as written in its TOML file.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::{Finger, HandSide};

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Description {
    pub(super) name: String,
    pub(super) side: HandSide,
    pub(super) anatomical: Anatomical,
    pub(super) joints: Joints,
    #[serde(default)]
    pub(super) finger: Vec<FingerEntry>,
    #[serde(default)]
    pub(super) joint_map: BTreeMap<String, JointMapEntry>,
}

/// Axes of O_SW as axes of the root link.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Anatomical {
    pub(super) radial: SignedAxis,
    pub(super) distal: SignedAxis,
    pub(super) palmar: SignedAxis,
    /// Where a human wrist would be, m, in the root link's frame.
    #[serde(default)]
    pub(super) wrist: [f64; 3],
}

#[derive(Clone, Copy, Debug, Deserialize)]
pub(super) enum SignedAxis {
    #[serde(rename = "+x")]
    PlusX,
    #[serde(rename = "-x")]
    MinusX,
    #[serde(rename = "+y")]
    PlusY,
    #[serde(rename = "-y")]
    MinusY,
    #[serde(rename = "+z")]
    PlusZ,
    #[serde(rename = "-z")]
    MinusZ,
}

impl SignedAxis {
    pub(super) const fn vector(self) -> [f64; 3] {
        match self {
            Self::PlusX => [1.0, 0.0, 0.0],
            Self::MinusX => [-1.0, 0.0, 0.0],
            Self::PlusY => [0.0, 1.0, 0.0],
            Self::MinusY => [0.0, -1.0, 0.0],
            Self::PlusZ => [0.0, 0.0, 1.0],
            Self::MinusZ => [0.0, 0.0, -1.0],
        }
    }
}

/// One value per joint, in wire order.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Joints {
    pub(super) order: Vec<String>,
    pub(super) home: Vec<f64>,
    pub(super) acceleration: Vec<f64>,
    pub(super) kp: Vec<f64>,
    pub(super) kd: Vec<f64>,
    pub(super) torque: Vec<f64>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct FingerEntry {
    pub(super) name: Finger,
    pub(super) joints: Vec<String>,
    pub(super) base: String,
    pub(super) center: String,
    pub(super) pole: String,
    pub(super) phalanges: [f64; 3],
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct JointMapEntry {
    /// Another map, whose rows hold for the joints that have none here.
    pub(super) extends: Option<String>,
    #[serde(default)]
    pub(super) rows: BTreeMap<String, RowEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RowEntry {
    #[serde(default)]
    pub(super) offset: f64,
    #[serde(default)]
    pub(super) terms: Vec<TermEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TermEntry {
    pub(super) from: String,
    #[serde(default = "one")]
    pub(super) gain: f64,
    pub(super) above: Option<f64>,
}

const fn one() -> f64 {
    1.0
}
