//! A relay that stands between two processes and passes their traffic on as a link would.
//!
//! It listens on an endpoint of its own and passes on, in both directions, what comes to it. It can begin as a perfect
//! link, so that sessions open through it, and be made worse with [`Relay::set`]. Chance comes from a seed, see
//! [`LinkModel`]; when a packet comes is up to the machine. All clients of a relay share one link. Threads, sockets and
//! queues are bounded and end on drop.
//!
//! A datagram waits in a heap for its time, up to 64 KiB large, so QUIC passes as well. A byte stream passes in segments
//! of at most 1448 bytes, in order; the two sides of a connection are closed one by one, as their owners do; a reset
//! arrives as an end. The handshake of TCP itself is not delayed.

mod tcp;
mod udp;

use std::io;
use std::net::SocketAddr;
use std::os::fd::BorrowedFd;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde::Serialize;

use crate::endpoint::{Target, Transport};
use crate::{Direction, Endpoint, Link, LinkModel};

/// How often threads look whether they should end, at least.
const POLL: Duration = Duration::from_millis(10);
/// Clients at once; one too many is not served.
const MAX_CLIENTS: usize = 64;

/// A relay, until it is dropped.
#[derive(Debug)]
pub struct Relay {
    address: SocketAddr,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

/// Why a relay does not start.
#[derive(Debug, thiserror::Error)]
pub enum RelayError {
    /// The two endpoints are carried differently.
    #[error("{listen} cannot be passed on to {target}: both must be udp or quic, or both tcp or tls")]
    Transport {
        /// Where it should listen.
        listen: Endpoint,
        /// Where it should pass on to.
        target: Endpoint,
    },
    /// The target has port 0.
    #[error("{0}: a target needs a port other than 0")]
    Port(Endpoint),
    /// It cannot listen.
    #[error("cannot listen on {listen}")]
    Listen {
        /// Where it should listen.
        listen: Endpoint,
        /// Why not.
        source: io::Error,
    },
}

impl Relay {
    /// A relay from `listen`, port 0 for one the system chooses, to `target`, whose name is looked up every two
    /// seconds.
    ///
    /// # Errors
    /// If the endpoints do not fit, or it cannot listen.
    pub fn start(listen: &Endpoint, target: &Endpoint, link: &Link, seed: u64) -> Result<Self, RelayError> {
        if listen.transport() != target.transport() {
            return Err(RelayError::Transport { listen: listen.clone(), target: target.clone() });
        }
        if target.port() == 0 {
            return Err(RelayError::Port(target.clone()));
        }
        let shared = Arc::new(Shared::new(target.clone(), link, seed));
        Self::run(listen, shared).map_err(|source| RelayError::Listen { listen: listen.clone(), source })
    }

    fn run(listen: &Endpoint, shared: Arc<Shared>) -> io::Result<Self> {
        let address = listen.address()?;
        let (address, thread) = match listen.transport() {
            Transport::Udp => udp::start(address, Arc::clone(&shared))?,
            Transport::Tcp => tcp::start(address, Arc::clone(&shared))?,
        };
        Ok(Self { address, shared, thread: Some(thread) })
    }

    /// A perfect UDP relay on a free port of 127.0.0.1.
    ///
    /// # Errors
    /// If no socket is to be had.
    pub fn udp(target: SocketAddr, seed: u64) -> Result<Self, RelayError> {
        Self::local("udp", target, seed)
    }

    /// A perfect TCP relay on a free port of 127.0.0.1.
    ///
    /// # Errors
    /// If no socket is to be had.
    pub fn tcp(target: SocketAddr, seed: u64) -> Result<Self, RelayError> {
        Self::local("tcp", target, seed)
    }

    fn local(protocol: &str, target: SocketAddr, seed: u64) -> Result<Self, RelayError> {
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        let [listen, target] = [listen, target].map(|address| Endpoint::of(protocol, address));
        Self::start(&listen, &target, &Link::default(), seed)
    }

    /// Where it listens.
    #[must_use]
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Where it passes on to, once its name is known.
    #[must_use]
    pub fn target(&self) -> Option<SocketAddr> {
        self.shared.target.address()
    }

    /// Changes the link from the next packet on.
    pub fn set(&self, link: impl Into<Link>) {
        let link = link.into();
        for direction in [Direction::Up, Direction::Down] {
            self.shared.way(direction).model.set(*link.way(direction), link.blackouts.clone());
        }
    }

    /// A blackout by command while `on`: datagrams are lost, streams are held up.
    pub fn blackout(&self, on: bool) {
        for direction in [Direction::Up, Direction::Down] {
            self.shared.way(direction).model.blackout(on);
        }
    }

    /// What it has done so far.
    #[must_use]
    pub fn stats(&self) -> Stats {
        let blackout = *self.shared.darkness.lock().unwrap_or_else(PoisonError::into_inner);
        Stats {
            up: self.shared.way(Direction::Up).counts,
            down: self.shared.way(Direction::Down).counts,
            clients: self.shared.clients.load(Ordering::Relaxed),
            refused: self.shared.refused.load(Ordering::Relaxed),
            blackout_s: blackout.total.as_secs_f64(),
        }
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A relay thread has nothing to tell when it ends.
            let _ended = thread.join();
        }
    }
}

/// What a relay has done in one direction. A packet is a datagram, or a segment of a byte stream.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// Packets that came in.
    pub received: u64,
    /// Those passed on, copies included.
    pub forwarded: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Losses by chance; those of segments come late instead.
    pub lost: u64,
    /// Lost in a blackout.
    pub blacked_out: u64,
    /// Dropped because the queue of the link was full.
    pub dropped: u64,
    /// Copies made.
    pub duplicated: u64,
    /// Given up by the relay itself: too many on their way, no address of the target yet, or the socket refused.
    pub failed: u64,
}

/// What a relay has done.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Stats {
    /// To the target.
    pub up: Counts,
    /// Back.
    pub down: Counts,
    /// Clients now.
    pub clients: usize,
    /// Clients turned away: too many, or the target did not accept a connection.
    pub refused: usize,
    /// How long it was dark, s; to within 10 ms per blackout.
    pub blackout_s: f64,
}

impl Stats {
    /// Both directions together.
    #[must_use]
    pub const fn total(&self) -> Counts {
        let (up, down) = (self.up, self.down);
        Counts {
            received: up.received + down.received,
            forwarded: up.forwarded + down.forwarded,
            bytes: up.bytes + down.bytes,
            lost: up.lost + down.lost,
            blacked_out: up.blacked_out + down.blacked_out,
            dropped: up.dropped + down.dropped,
            duplicated: up.duplicated + down.duplicated,
            failed: up.failed + down.failed,
        }
    }
}

/// What the threads of a relay share.
#[derive(Debug)]
struct Shared {
    start: Instant,
    target: Arc<Target>,
    ways: [Mutex<Way>; 2],
    clients: AtomicUsize,
    refused: AtomicUsize,
    darkness: Mutex<Darkness>,
    stop: AtomicBool,
}

/// One direction.
#[derive(Debug)]
struct Way {
    model: LinkModel,
    counts: Counts,
}

/// How long it was dark.
#[derive(Clone, Copy, Debug, Default)]
struct Darkness {
    total: Duration,
    looked: Duration,
}

impl Shared {
    fn new(target: Endpoint, link: &Link, seed: u64) -> Self {
        Self {
            start: Instant::now(),
            target: Target::new(target),
            ways: link.models(seed).map(|model| Mutex::new(Way { model, counts: Counts::default() })),
            clients: AtomicUsize::new(0),
            refused: AtomicUsize::new(0),
            darkness: Mutex::default(),
            stop: AtomicBool::new(false),
        }
    }

    /// Time since the start.
    fn now(&self) -> Duration {
        self.start.elapsed()
    }

    fn way(&self, direction: Direction) -> MutexGuard<'_, Way> {
        self.ways[direction as usize].lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn stopping(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// To be called every now and then by one thread: adds up how long it was dark.
    fn look(&self) {
        let now = self.now();
        let dark = self.way(Direction::Up).model.dark(now);
        let mut darkness = self.darkness.lock().unwrap_or_else(PoisonError::into_inner);
        let since = now.saturating_sub(std::mem::replace(&mut darkness.looked, now));
        if dark {
            darkness.total += since;
        }
    }
}

/// Waits until one of the sockets is ready, for `timeout` at most. Which are ready is in the answer.
fn wait(sockets: &[(BorrowedFd<'_>, PollFlags)], timeout: Duration) -> Vec<PollFlags> {
    let mut fds: Vec<_> = sockets.iter().map(|(fd, flags)| PollFd::from_borrowed_fd(*fd, *flags)).collect();
    let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: i64::from(timeout.subsec_nanos()) };
    // Fails only if a signal comes, or the system is out of memory; the next look finds out.
    match poll(&mut fds, Some(&timeout)) {
        Ok(_ready) => fds.iter().map(PollFd::revents).collect(),
        Err(_interrupted) => vec![PollFlags::empty(); sockets.len()],
    }
}
