use std::sync::{Mutex, PoisonError};

use thiserror::Error;
use zenoh::Wait;
use zenoh::sample::{Sample, SampleKind};

use super::NetError;
use super::clock;
use super::session::failed;
use crate::time::MonoTime;
use crate::wire::{Checked, Message, WireError, decode};

/// Longest payload that reaches a callback, bytes.
pub const MAX_PAYLOAD: usize = 8192;

/// A payload that is too long to look at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error("payload of {0} bytes is longer than {MAX_PAYLOAD}")]
pub struct Oversize(pub usize);

/// What arrived on a key.
#[derive(Clone, Copy, Debug)]
pub struct Arrival<'a> {
    /// The payload.
    pub payload: Result<&'a [u8], Oversize>,
    /// When it arrived, own clock.
    pub at: MonoTime,
}

impl Arrival<'_> {
    /// Decodes the payload as a message `M`.
    ///
    /// # Errors
    /// See [`decode`]; an oversize payload has the wrong length.
    pub fn decode<M: Message>(&self) -> Result<Checked<M>, WireError> {
        match self.payload {
            Ok(bytes) => decode(bytes),
            Err(Oversize(found)) => Err(WireError::Length { kind: M::KIND, expected: M::LEN, found }),
        }
    }
}

/// A subscription; dropping it ends it.
#[derive(Debug)]
pub struct Subscriber {
    _zenoh: zenoh::pubsub::Subscriber<()>,
}

impl Subscriber {
    pub(super) fn declare<F>(session: &zenoh::Session, key: &str, callback: F) -> Result<Self, NetError>
    where
        F: FnMut(Arrival<'_>) + Send + 'static,
    {
        let callback = Mutex::new(callback);
        let zenoh = session
            .declare_subscriber(key.to_owned())
            .callback(move |sample| {
                let at = clock::now();
                let mut callback = callback.lock().unwrap_or_else(PoisonError::into_inner);
                deliver(&sample, |payload| callback(Arrival { payload, at }));
            })
            .wait()
            .map_err(|error| failed("subscribe to", key, &error))?;
        Ok(Self { _zenoh: zenoh })
    }
}

/// Hands over the payload as one slice, without allocating.
fn deliver(sample: &Sample, callback: impl FnOnce(Result<&[u8], Oversize>)) {
    if sample.kind() != SampleKind::Put {
        return;
    }
    let payload = sample.payload();
    let len = payload.len();
    if len > MAX_PAYLOAD {
        return callback(Err(Oversize(len)));
    }
    let mut slices = payload.slices();
    match slices.next() {
        None => callback(Ok(&[])),
        Some(slice) if slice.len() == len => callback(Ok(slice)),
        // It came in fragments.
        Some(first) => {
            let mut buffer = [0; MAX_PAYLOAD];
            let mut filled = 0;
            for slice in std::iter::once(first).chain(slices) {
                let Some(room) = buffer.get_mut(filled..filled + slice.len()) else {
                    return callback(Err(Oversize(len)));
                };
                room.copy_from_slice(slice);
                filled += slice.len();
            }
            callback(Ok(&buffer[..filled]));
        }
    }
}
