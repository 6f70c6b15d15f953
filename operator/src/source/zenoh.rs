use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use teleop_common::key::Keys;
use teleop_common::net::{Arrival, MAX_PAYLOAD, NetError, Oversize, Session, Subscriber};
use teleop_common::recording::{FrameError, parse_hand_json};
use teleop_common::time::MonoTime;

use super::{Poll, SourceFrame};

/// Hand data in JSON from any other program: the newest message counts.
#[derive(Debug)]
pub struct ZenohSource {
    inbox: Arc<Inbox>,
    bytes: Vec<u8>,
    start: Option<MonoTime>,
    bad: u64,
    _subscriber: Option<Subscriber>,
}

/// One place for a message, between the network's thread and the source's.
#[derive(Debug, Default)]
struct Inbox {
    slot: Mutex<Slot>,
    arrived: Condvar,
    overtaken: AtomicU64,
}

#[derive(Debug, Default)]
struct Slot {
    message: Option<(Result<(), Oversize>, MonoTime)>,
    bytes: Vec<u8>,
}

impl Inbox {
    fn put(&self, arrival: Arrival<'_>) {
        let mut slot = self.lock();
        let whole = arrival.payload.map(|bytes| {
            slot.bytes.clear();
            slot.bytes.extend_from_slice(bytes);
        });
        if slot.message.replace((whole, arrival.at)).is_some() {
            self.overtaken.fetch_add(1, Ordering::Relaxed);
        }
        drop(slot);
        self.arrived.notify_one();
    }

    /// Takes the message, by swapping buffers: reading it must not hold the network up.
    fn take(&self, bytes: &mut Vec<u8>) -> Option<(Result<(), Oversize>, MonoTime)> {
        let mut slot = self.lock();
        let message = slot.message.take()?;
        std::mem::swap(bytes, &mut slot.bytes);
        Some(message)
    }

    fn lock(&self) -> MutexGuard<'_, Slot> {
        self.slot.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ZenohSource {
    /// Listens on the hand input key of this robot.
    ///
    /// # Errors
    /// The session is closed.
    pub fn subscribe(session: &Session, keys: &Keys) -> Result<Self, NetError> {
        let mut source = Self::detached();
        let inbox = Arc::clone(&source.inbox);
        source._subscriber = Some(session.subscribe(&keys.hand_input(), move |arrival| inbox.put(arrival))?);
        Ok(source)
    }

    fn detached() -> Self {
        let slot = Slot { message: None, bytes: Vec::with_capacity(MAX_PAYLOAD) };
        let inbox = Inbox { slot: Mutex::new(slot), ..Inbox::default() };
        Self { inbox: Arc::new(inbox), bytes: Vec::with_capacity(MAX_PAYLOAD), start: None, bad: 0, _subscriber: None }
    }

    pub(super) fn poll(&mut self) -> Poll {
        while let Some((whole, at)) = self.inbox.take(&mut self.bytes) {
            let hand = match whole {
                Ok(()) => parse_hand_json(&self.bytes),
                Err(Oversize(length)) => Err(FrameError::TooLong { length }),
            };
            match hand {
                Ok(hand) => {
                    let time = at.since(*self.start.get_or_insert(at));
                    let skipped = self.inbox.overtaken.swap(0, Ordering::Relaxed);
                    return Poll::Frame(SourceFrame { time, captured: Some(at), hand, skipped, jump: false });
                }
                Err(error) => {
                    if self.bad == 0 {
                        tracing::error!("hand data refused: {error} (more of them are counted, not told)");
                    }
                    self.bad += 1;
                }
            }
        }
        Poll::Idle
    }

    /// Waits for a message; true if there is one.
    pub(super) fn wait(&self, timeout: Duration) -> bool {
        let slot = self.inbox.lock();
        let wait = self.inbox.arrived.wait_timeout_while(slot, timeout, |slot| slot.message.is_none());
        wait.unwrap_or_else(PoisonError::into_inner).0.message.is_some()
    }

    pub(super) fn bad_input(&self) -> u64 {
        self.bad
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use teleop_common::recording::FrameData;

    fn put(source: &ZenohSource, payload: Result<&[u8], Oversize>, at: u64) {
        source.inbox.put(Arrival { payload, at: MonoTime(at) });
    }

    #[test]
    fn the_newest_message_counts_and_a_bad_one_is_not_the_end() {
        let mut source = ZenohSource::detached();
        assert!(!source.wait(Duration::from_millis(1)));
        assert_eq!(source.poll(), Poll::Idle);
        for bytes in [&b"hello"[..], b"{}", b"{\"q\": [1, 2]}", b"\xff\xff", b""] {
            put(&source, Ok(bytes), 1);
            assert_eq!(source.poll(), Poll::Idle);
        }
        put(&source, Err(Oversize(100_000)), 1);
        assert_eq!(source.poll(), Poll::Idle);
        assert_eq!(source.bad_input(), 6);

        let message = |angle: f64| format!("{{\"t\": 5, \"q\": {:?}}}", [angle; 20]);
        put(&source, Ok(message(0.1).as_bytes()), 1_000_000_000);
        put(&source, Ok(message(0.2).as_bytes()), 1_010_000_000);
        assert!(source.wait(Duration::from_secs(10)));
        let Poll::Frame(frame) = source.poll() else { panic!("no frame") };
        assert_eq!((frame.hand, frame.skipped), (FrameData::Joints([0.2; 20]), 1));
        assert_eq!((frame.captured, frame.time), (Some(MonoTime(1_010_000_000)), Duration::ZERO));
        put(&source, Ok(message(0.3).as_bytes()), 1_030_000_000);
        let Poll::Frame(frame) = source.poll() else { panic!("no frame") };
        assert_eq!((frame.skipped, frame.time), (0, Duration::from_millis(20)));
    }
}
