#![doc = include_str!("WIRE.md")]

mod check;
mod codec;
mod header;
mod health;
mod joints;
mod mapping;
mod pose;

pub use codec::{Checked, MAX_MESSAGE, Message, WireError, decode, encode_into};
pub use header::{Echo, Header, Kind, MAGIC, PROTOCOL, Stamper};
pub use health::{HealthMessage, Quantiles, REJECTIONS, Rejection};
pub use joints::{JointStateMessage, pack_joints};
pub use mapping::{FingerMessage, MappingMessage};
pub use pose::{PoseMessage, TuningMessage};
