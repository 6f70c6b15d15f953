use serde::{Deserialize, Serialize};

use super::Message;
use crate::time::{Exchange, MonoTime};

/// First four bytes of every message.
pub const MAGIC: [u8; 4] = *b"ALGT";
/// Version of the protocol. Any change of any layout or meaning raises it.
pub const PROTOCOL: u16 = 4;

/// The kinds of message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Kind {
    /// [`super::PoseMessage`]
    Pose = 1,
    /// [`super::JointStateMessage`]
    JointState = 2,
    /// [`super::MappingMessage`]
    Mapping = 3,
    /// [`super::HealthMessage`]
    Health = 4,
    /// [`super::ControlMessage`]
    Control = 5,
}

/// How every message begins; this layout is the same in all versions of the protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    magic: [u8; 4],
    protocol: u16,
    kind: u8,
    flags: u8,
    /// Random number of the sending process: another value means that the sender restarted.
    pub epoch: u64,
    /// Counts the messages of one stream (key) of one process, from 1.
    pub seq: u64,
    /// When it was sent, sender's clock.
    pub sent: MonoTime,
}

impl Header {
    /// Length on the wire, bytes.
    pub const LEN: usize = 32;

    /// The header of a message `M`.
    #[must_use]
    pub const fn new<M: Message>(epoch: u64, seq: u64, sent: MonoTime) -> Self {
        Self { magic: MAGIC, protocol: PROTOCOL, kind: M::KIND as u8, flags: 0, epoch, seq, sent }
    }

    /// The magic found.
    #[must_use]
    pub const fn magic(&self) -> [u8; 4] {
        self.magic
    }

    /// The protocol version found.
    #[must_use]
    pub const fn protocol(&self) -> u16 {
        self.protocol
    }

    /// The kind found, [`Kind`] as a number.
    #[must_use]
    pub const fn kind(&self) -> u8 {
        self.kind
    }
}

/// Makes the headers of one stream: the epoch of the process and a sequence number.
#[derive(Clone, Copy, Debug)]
pub struct Stamper {
    epoch: u64,
    seq: u64,
}

impl Stamper {
    /// Headers of the process `epoch`, from sequence number 1.
    #[must_use]
    pub const fn new(epoch: u64) -> Self {
        Self { epoch, seq: 0 }
    }

    /// The next header, of a message sent at `now`.
    #[must_use]
    pub const fn header<M: Message>(&mut self, now: MonoTime) -> Header {
        self.seq = self.seq.wrapping_add(1);
        Header::new::<M>(self.epoch, self.seq, now)
    }
}

/// The newest message received from the peer, told back to it so that it can measure the round trip.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Echo {
    /// Epoch of the peer, 0 if nothing was received yet.
    pub epoch: u64,
    /// Send stamp of the peer's message, peer's clock.
    pub sent: MonoTime,
    /// When it arrived, own clock of the sender of the echo.
    pub received: MonoTime,
}

impl Echo {
    /// Nothing received yet.
    pub const NONE: Self = Self { epoch: 0, sent: MonoTime(0), received: MonoTime(0) };

    /// The echo of a message with this header that arrived at `received`.
    #[must_use]
    pub const fn of(header: &Header, received: MonoTime) -> Self {
        Self { epoch: header.epoch, sent: header.sent, received }
    }

    /// The round trip this echo closes at its addressee, the process `own_epoch`, which got it at `received` in a
    /// message with `header`. `None` if it echoes another process, or nothing yet.
    #[must_use]
    pub fn exchange(&self, own_epoch: u64, header: &Header, received: MonoTime) -> Option<Exchange> {
        (*self != Self::NONE && self.epoch == own_epoch).then_some(Exchange {
            sent: self.sent,
            peer_received: self.received,
            peer_sent: header.sent,
            received,
        })
    }
}
