use serde::{Deserialize, Serialize};

use super::codec::sealed::Sealed;
use super::{Header, Kind, Message, WireError, check};

/// What is asked of the robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Request {
    /// Stop the hand and stay stopped. Anybody who may write to the key may ask this.
    Stop = 1,
    /// Reset the stop with this number. Only the operator that has the robot may ask this.
    Reset {
        /// Number of the stop, from the robot's joint state: a reset meant for an earlier one does nothing.
        stop: u32,
    } = 2,
}

/// Asks the robot to stop, or to reset a stop. Sent again and again until the joint state shows that it is done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ControlMessage {
    /// Header.
    pub header: Header,
    request: u8,
    /// Epoch of the robot process that is meant, 0 for any (a stop may not know it).
    pub robot: u64,
    stop: u32,
}

impl ControlMessage {
    /// The message of a request to the robot process `robot`.
    #[must_use]
    pub const fn new(header: Header, robot: u64, request: Request) -> Self {
        let (code, stop) = match request {
            Request::Stop => (1, 0),
            Request::Reset { stop } => (2, stop),
        };
        Self { header, request: code, robot, stop }
    }

    /// What is asked; `None` in a message that was not decoded and is not valid.
    #[must_use]
    pub const fn request(&self) -> Option<Request> {
        match self.request {
            1 => Some(Request::Stop),
            2 => Some(Request::Reset { stop: self.stop }),
            _ => None,
        }
    }
}

impl Sealed for ControlMessage {}

impl Message for ControlMessage {
    const KIND: Kind = Kind::Control;
    const LEN: usize = 45;

    fn header(&self) -> &Header {
        &self.header
    }

    fn check(&self) -> Result<(), WireError> {
        check::count("request", self.request, 1, 2, "1 or 2").map(|_| ())
    }
}
