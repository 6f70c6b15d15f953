#![doc = include_str!("WIRE.md")]

mod check;
mod codec;
mod control;
mod header;
mod health;
mod joints;
mod mapping;
mod pose;

pub use codec::{Checked, MAX_MESSAGE, Message, WireError, decode, encode_into};
pub use control::{ControlMessage, Request};
pub use header::{Echo, Header, Kind, MAGIC, PROTOCOL, Stamper};
pub use health::{HealthMessage, Quantiles, REJECTIONS, Rejection, STAGES, Stage, latency_report};
pub use joints::{JointStateMessage, pack_joints};
pub use mapping::{FingerMessage, MappingMessage};
pub use pose::{PoseMessage, TuningMessage};
