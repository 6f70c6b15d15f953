//! A bad network on localhost: UDP and TCP relays with seeded delay, jitter, loss, reordering and duplication.
//!
//! A relay stands between two processes: it listens on a port of its own and passes on, in both directions, what
//! comes to it. It begins as a perfect link, so that sessions can open through it, and is made worse with `set`.
//! Decisions come from a seed, one stream per direction, so the n-th datagram of a direction meets the same fate in
//! every run; *when* it comes is up to the machine. Threads, sockets and queues are bounded and end on drop.

mod tcp;
mod udp;

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

pub use tcp::TcpRelay;
pub use udp::UdpRelay;

/// How often threads look whether they should end.
const POLL: Duration = Duration::from_millis(20);

/// What a relay does to each direction of its traffic.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Impairment {
    /// One-way delay.
    pub delay: Duration,
    /// The delay varies evenly within plus and minus this.
    pub jitter: Duration,
    /// Fraction of datagrams lost (UDP only).
    pub loss: f64,
    /// Fraction of datagrams that skip the delay and so overtake those before them (UDP only).
    pub reorder: f64,
    /// Fraction of datagrams that come twice, each copy with a delay of its own (UDP only).
    pub duplicate: f64,
    /// Bytes per second that pass (TCP only).
    pub rate: Option<f64>,
}

/// What happens to one datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// It is lost.
    Lost,
    /// It arrives after this time, and a copy of it too if there is a second one.
    Arrives(Duration, Option<Duration>),
}

/// A seeded stream of decisions.
#[derive(Clone, Debug)]
pub struct Dice(u64);

impl Dice {
    /// The stream of one direction of a relay.
    #[must_use]
    pub const fn new(seed: u64, direction: u64) -> Self {
        Self(seed ^ direction.wrapping_mul(0xa076_1d64_78bd_642f))
    }

    /// Even in 0..1 (splitmix64).
    pub fn roll(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = self.0;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((bits ^ (bits >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Decides about the next datagram. Always five rolls, so that changing one probability leaves the others' be.
    pub fn fate(&mut self, impairment: &Impairment) -> Fate {
        let [loss, reorder, duplicate, first, second] = std::array::from_fn(|_| self.roll());
        if loss < impairment.loss {
            return Fate::Lost;
        }
        let first = if reorder < impairment.reorder { Duration::ZERO } else { impairment.delay_of(first) };
        Fate::Arrives(first, (duplicate < impairment.duplicate).then(|| impairment.delay_of(second)))
    }
}

impl Impairment {
    /// A delay with jitter; `roll` in 0..1.
    fn delay_of(&self, roll: f64) -> Duration {
        Duration::from_secs_f64((self.delay.as_secs_f64() + self.jitter.as_secs_f64() * (2.0 * roll - 1.0)).max(0.0))
    }
}

/// What a relay has done, both directions together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Stats {
    /// Datagrams (UDP) or pieces of a stream (TCP) that came in.
    pub received: u64,
    /// Those passed on, copies included.
    pub forwarded: u64,
    /// Those lost by chance.
    pub lost: u64,
    /// Those lost in a blackout.
    pub blacked_out: u64,
    /// Copies made.
    pub duplicated: u64,
    /// Those lost because a queue was full, or could not be sent.
    pub failed: u64,
}

#[derive(Debug, Default)]
struct Counters {
    received: AtomicU64,
    forwarded: AtomicU64,
    lost: AtomicU64,
    blacked_out: AtomicU64,
    duplicated: AtomicU64,
    failed: AtomicU64,
}

/// What the threads of a relay share.
#[derive(Debug, Default)]
struct Shared {
    impairment: Mutex<Impairment>,
    blackout: AtomicBool,
    stop: AtomicBool,
    counters: Counters,
}

impl Shared {
    fn impairment(&self) -> Impairment {
        *self.impairment.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn set(&self, impairment: Impairment) {
        *self.impairment.lock().unwrap_or_else(PoisonError::into_inner) = impairment;
    }

    fn stopping(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn dark(&self) -> bool {
        self.blackout.load(Ordering::Relaxed)
    }

    fn stats(&self) -> Stats {
        let get = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let counters = &self.counters;
        Stats {
            received: get(&counters.received),
            forwarded: get(&counters.forwarded),
            lost: get(&counters.lost),
            blacked_out: get(&counters.blacked_out),
            duplicated: get(&counters.duplicated),
            failed: get(&counters.failed),
        }
    }
}

fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

/// True for the errors of a read that only timed out.
fn timed_out(error: &std::io::Error) -> bool {
    matches!(error.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut)
}
