//! The robot (slave) hand.
//!
//! A hand is a URDF plus a description (TOML beside it) that says what the URDF cannot: which joints make which
//! finger, where the fingertips are, how the hand is oriented anatomically, the joint order on the wire, and the
//! joint mapping M_Q. [`HandModel::load`] checks both and flattens them; after that no string is looked up again.
//!
//! Frames: `palm` is the URDF's root link. The anatomical frame O_SW has its axes radial (towards the thumb side),
//! distal and palmar, for either hand; for a left hand that makes it left-handed, which is what lets the mapping be
//! written once.

mod allegro;
mod capsule;
mod collision;
mod description;
mod error;
mod joint_map;
mod link;
mod load;
mod model;
mod urdf;
mod vector;
mod xml;

pub use allegro::{
    ALLEGRO_V4_LEFT_DESCRIPTION, ALLEGRO_V4_LEFT_URDF, ALLEGRO_V4_RIGHT_DESCRIPTION, ALLEGRO_V4_RIGHT_URDF,
    allegro_v4_texts,
};
pub use capsule::{Capsule, RoundedBox};
pub(crate) use capsule::{Nearest, between_segments};
pub use collision::{Body, BodyIndex, Collision, MAX_BODIES};
pub use error::HandError;
pub use link::{Link, Shape, Visual};
pub(crate) use model::Frame;
pub use model::{ChainJoint, FingerChain, HandModel, Joint, JointMap, JointMapTerm, TipFrame, TipJacobian};
pub use vector::JointVector;

/// Most fingers a hand may have.
pub const MAX_FINGERS: usize = 5;
/// Most joints one finger may have.
pub const MAX_FINGER_JOINTS: usize = 5;
/// Most joints a hand may have.
pub const MAX_JOINTS: usize = MAX_FINGERS * MAX_FINGER_JOINTS;

/// A finger, of either hand, in the master's order T, I, M, R, P.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Finger {
    /// T
    Thumb,
    /// I
    Index,
    /// M
    Middle,
    /// R
    Ring,
    /// P, the pinkie
    Little,
}

impl Finger {
    /// All five, in the master's order.
    pub const ALL: [Self; MAX_FINGERS] = [Self::Thumb, Self::Index, Self::Middle, Self::Ring, Self::Little];

    /// Position in the master's order, 0 (thumb) to 4 (little).
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }

    /// Lower-case English name, as in files and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Thumb => "thumb",
            Self::Index => "index",
            Self::Middle => "middle",
            Self::Ring => "ring",
            Self::Little => "little",
        }
    }
}

/// Which hand, of the robot or of the person.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum HandSide {
    /// Right hand.
    Right,
    /// Left hand.
    Left,
}

impl HandSide {
    /// `right` or `left`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Right => "right",
            Self::Left => "left",
        }
    }
}
