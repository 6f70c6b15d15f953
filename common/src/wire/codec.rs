use bincode::config::{Configuration, Fixint, Limit, LittleEndian};
use serde::Serialize;
use serde::de::DeserializeOwned;
use thiserror::Error;

use super::header::{Header, Kind, MAGIC, PROTOCOL};
use crate::master::MasterError;

/// No message is longer, bytes. Buffers of this size always suffice.
pub const MAX_MESSAGE: usize = 1024;

const CODEC: Configuration<LittleEndian, Fixint, Limit<MAX_MESSAGE>> =
    bincode::config::standard().with_little_endian().with_fixed_int_encoding().with_limit::<MAX_MESSAGE>();

/// Why bytes are not a message, or a message is not fit to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Error)]
pub enum WireError {
    /// Not even a header.
    #[error("{found} bytes are too short for a message header of {} bytes", Header::LEN)]
    TooShort {
        /// Length found, bytes.
        found: usize,
    },
    /// Not one of this protocol's messages.
    #[error("message begins with {found:02x?}, not with the magic \"ALGT\"")]
    Magic {
        /// The first four bytes.
        found: [u8; 4],
    },
    /// The peer speaks another version.
    #[error("peer speaks wire protocol {theirs}, this side speaks {ours}: run the same release on both ends")]
    Protocol {
        /// Version of this side.
        ours: u16,
        /// Version of the peer.
        theirs: u16,
    },
    /// Another kind of message than this key carries.
    #[error("message kind {found} where {expected:?} ({}) belongs", *.expected as u8)]
    Kind {
        /// The kind asked for.
        expected: Kind,
        /// The kind found.
        found: u8,
    },
    /// A message of wrong length.
    #[error("{kind:?} message is {found} bytes long instead of {expected}")]
    Length {
        /// The kind of message.
        kind: Kind,
        /// Its one right length, bytes.
        expected: usize,
        /// Length found, bytes.
        found: usize,
    },
    /// A number that is not finite or not in its range.
    #[error("{field}[{index}] is {value}, allowed: {allowed}")]
    Value {
        /// Name of the field.
        field: &'static str,
        /// Which element, flat, 0 for a single number.
        index: usize,
        /// What was found.
        value: f32,
        /// What would have been right.
        allowed: &'static str,
    },
    /// No pose of a human hand.
    #[error(transparent)]
    Pose(#[from] MasterError),
    /// A code or a count that does not exist.
    #[error("{field} is {value}, allowed: {allowed}")]
    Code {
        /// Name of the field.
        field: &'static str,
        /// What was found.
        value: u8,
        /// What would have been right.
        allowed: &'static str,
    },
    /// A name that is not printable.
    #[error("{field} is no name: printable ASCII, then zeros")]
    Name {
        /// Name of the field.
        field: &'static str,
    },
    /// The buffer given to [`encode_into`] cannot take the message.
    #[error("buffer of {found} bytes cannot take a message of {expected}")]
    Buffer {
        /// Length of the message, bytes.
        expected: usize,
        /// Length of the buffer, bytes.
        found: usize,
    },
    /// The codec failed in a way the checks before it exclude.
    #[error("codec failure in a {kind:?} message")]
    Codec {
        /// The kind of message.
        kind: Kind,
    },
}

pub(super) mod sealed {
    pub trait Sealed {}
}

/// A message of the protocol. Sealed: the set of messages is the protocol.
pub trait Message: sealed::Sealed + Copy + Serialize + DeserializeOwned {
    /// Its number in the header.
    const KIND: Kind;
    /// Its length, bytes, header included; always the same.
    const LEN: usize;

    /// Its header.
    fn header(&self) -> &Header;

    /// Whether every value is finite, in range and of a known code.
    ///
    /// # Errors
    /// [`WireError::Value`], [`WireError::Code`] or [`WireError::Pose`] naming the first one that is not.
    fn check(&self) -> Result<(), WireError>;
}

/// A message that came through [`decode`]: known version, right kind, exact length, all values valid.
///
/// There is no other way to make one, so nothing unchecked from the network can be mistaken for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Checked<M>(M);

impl<M> std::ops::Deref for Checked<M> {
    type Target = M;

    fn deref(&self) -> &M {
        &self.0
    }
}

/// Writes `message` to the beginning of `buffer` and gives its length. Does not allocate.
///
/// # Errors
/// [`WireError::Buffer`]; [`WireError::Kind`] if the header was made for another kind; and the errors of
/// [`Message::check`], since a peer would reject the message.
pub fn encode_into<M: Message>(message: &M, buffer: &mut [u8]) -> Result<usize, WireError> {
    let found = buffer.len();
    let buffer = buffer.get_mut(..M::LEN).ok_or(WireError::Buffer { expected: M::LEN, found })?;
    check_header(message.header(), M::KIND)?;
    message.check()?;
    match bincode::serde::encode_into_slice(message, buffer, CODEC) {
        Ok(written) if written == M::LEN => Ok(written),
        _ => Err(WireError::Codec { kind: M::KIND }),
    }
}

/// Reads one message that fills `bytes` exactly. Never panics, never allocates, whatever the bytes.
///
/// # Errors
/// [`WireError`], in this order: too short for a header, magic, protocol version, kind, length, values.
pub fn decode<M: Message>(bytes: &[u8]) -> Result<Checked<M>, WireError> {
    let found = bytes.len();
    let head = bytes.get(..Header::LEN).ok_or(WireError::TooShort { found })?;
    let (header, _) = bincode::serde::decode_from_slice::<Header, _>(head, CODEC)
        .map_err(|_failure| WireError::Codec { kind: M::KIND })?;
    check_header(&header, M::KIND)?;
    if found != M::LEN {
        return Err(WireError::Length { kind: M::KIND, expected: M::LEN, found });
    }
    match bincode::serde::decode_from_slice::<M, _>(bytes, CODEC) {
        Ok((message, read)) if read == found => {
            message.check()?;
            Ok(Checked(message))
        }
        _ => Err(WireError::Codec { kind: M::KIND }),
    }
}

fn check_header(header: &Header, kind: Kind) -> Result<(), WireError> {
    if header.magic() != MAGIC {
        return Err(WireError::Magic { found: header.magic() });
    }
    if header.protocol() != PROTOCOL {
        return Err(WireError::Protocol { ours: PROTOCOL, theirs: header.protocol() });
    }
    if header.kind() != kind as u8 {
        return Err(WireError::Kind { expected: kind, found: header.kind() });
    }
    Ok(())
}
