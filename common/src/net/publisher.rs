use zenoh::Wait;
use zenoh::bytes::Encoding;
use zenoh::qos::{CongestionControl, Priority, Reliability};

use super::NetError;
use super::session::failed;
use crate::wire::{MAX_MESSAGE, Message, encode_into};

/// What kind of stream a publisher feeds. Each has a priority of its own, and all drop rather than wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stream {
    /// Poses: first in every queue, never batched, never resent.
    Command,
    /// Joint and mapping state: next in every queue, never batched, never resent.
    State,
    /// Health and other slow things: over reliable links where there are any.
    Slow,
}

/// Publishes on one key.
#[derive(Debug)]
pub struct Publisher {
    key: String,
    zenoh: zenoh::pubsub::Publisher<'static>,
}

impl Publisher {
    pub(super) fn declare(session: &zenoh::Session, key: &str, stream: Stream) -> Result<Self, NetError> {
        // Never `Block`: a full queue would stop the caller for 5 s, and then close the connection.
        let (priority, reliability, express) = match stream {
            Stream::Command => (Priority::RealTime, Reliability::BestEffort, true),
            Stream::State => (Priority::InteractiveHigh, Reliability::BestEffort, true),
            Stream::Slow => (Priority::Data, Reliability::Reliable, false),
        };
        let zenoh = session
            .declare_publisher(key.to_owned())
            .congestion_control(CongestionControl::Drop)
            .priority(priority)
            .reliability(reliability)
            .express(express)
            .encoding(Encoding::APPLICATION_OCTET_STREAM)
            .wait()
            .map_err(|error| failed("publish on", key, &error))?;
        Ok(Self { key: key.to_owned(), zenoh })
    }

    /// Encodes and sends one message.
    ///
    /// # Errors
    /// [`NetError::Message`] if a peer would reject it, [`NetError::Key`] if the session is closed. A message that
    /// the network drops is no error.
    pub fn send<M: Message>(&self, message: &M) -> Result<(), NetError> {
        let mut buffer = [0; MAX_MESSAGE];
        let len =
            encode_into(message, &mut buffer).map_err(|error| NetError::Message { key: self.key.clone(), error })?;
        self.put(&buffer[..len])
    }

    /// Sends bytes as they are.
    ///
    /// # Errors
    /// [`NetError::Key`] if the session is closed.
    pub fn put(&self, payload: &[u8]) -> Result<(), NetError> {
        self.zenoh.put(payload).wait().map_err(|error| failed("publish on", &self.key, &error))
    }

    /// Whether anybody subscribes to the key now.
    #[must_use]
    pub fn has_subscribers(&self) -> bool {
        self.zenoh.matching_status().wait().is_ok_and(|status| status.matching())
    }
}
