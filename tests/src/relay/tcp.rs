use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::{Dice, Impairment, POLL, Shared, Stats, count, timed_out};

/// Pieces of a stream on their way at once; then the sender has to wait, as TCP does.
const MAX_IN_FLIGHT: usize = 256;
/// Connections at once.
const MAX_CLIENTS: usize = 16;

/// A TCP relay on 127.0.0.1: delay, jitter and rate; order is kept, nothing is lost, a blackout only holds it up.
#[derive(Debug)]
pub struct TcpRelay {
    address: SocketAddr,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl TcpRelay {
    /// A perfect relay to `target`, listening on a port the system chooses.
    ///
    /// # Errors
    /// If no socket is to be had.
    pub fn start(target: SocketAddr, seed: u64) -> io::Result<Self> {
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let shared = Arc::new(Shared::default());
        let thread = {
            let shared = Arc::clone(&shared);
            std::thread::spawn(move || accept(&listener, target, seed, &shared))
        };
        Ok(Self { address, shared, thread: Some(thread) })
    }

    /// Where to connect to.
    #[must_use]
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Changes the link from the next piece on.
    pub fn set(&self, impairment: Impairment) {
        self.shared.set(impairment);
    }

    /// Holds everything up while `on`; it flows on afterwards, late, as TCP's retransmissions would.
    pub fn blackout(&self, on: bool) {
        self.shared.blackout.store(on, Ordering::Relaxed);
    }

    /// What it has done so far.
    #[must_use]
    pub fn stats(&self) -> Stats {
        self.shared.stats()
    }
}

impl Drop for TcpRelay {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // A relay thread has nothing to tell when it ends.
            let _ended = thread.join();
        }
    }
}

fn accept(listener: &TcpListener, target: SocketAddr, seed: u64, shared: &Arc<Shared>) {
    let mut threads: Vec<JoinHandle<()>> = Vec::new();
    let mut connections = 0;
    while !shared.stopping() {
        let Ok((client, _from)) = listener.accept() else {
            std::thread::sleep(Duration::from_millis(1));
            continue;
        };
        threads.retain(|thread| !thread.is_finished());
        // Four threads a connection; a client too many finds the door closed.
        if threads.len() >= 4 * MAX_CLIENTS {
            count(&shared.counters.failed);
            continue;
        }
        connections += 1;
        if let Ok(pumps) = connection(client, target, seed, connections, shared) {
            threads.extend(pumps);
        } else {
            count(&shared.counters.failed);
        }
    }
    for thread in threads {
        let _ended = thread.join();
    }
}

fn connection(
    client: TcpStream,
    target: SocketAddr,
    seed: u64,
    number: u64,
    shared: &Arc<Shared>,
) -> io::Result<Vec<JoinHandle<()>>> {
    client.set_nonblocking(false)?;
    let server = TcpStream::connect_timeout(&target, Duration::from_secs(2))?;
    let mut threads = Vec::new();
    let ways = [(client.try_clone()?, server.try_clone()?, 0), (server, client, 1)];
    for (from, to, way) in ways {
        from.set_nodelay(true)?;
        from.set_read_timeout(Some(POLL))?;
        to.set_write_timeout(Some(Duration::from_secs(2)))?;
        let (sender, receiver) = sync_channel(MAX_IN_FLIGHT);
        let dice = Dice::new(seed, 2 * number + way);
        let reader = Arc::clone(shared);
        threads.push(std::thread::spawn(move || read(from, &sender, dice, &reader)));
        let writer = Arc::clone(shared);
        threads.push(std::thread::spawn(move || write(to, &receiver, &writer)));
    }
    Ok(threads)
}

type Piece = (Instant, Vec<u8>);

fn read(mut from: TcpStream, queue: &SyncSender<Piece>, mut dice: Dice, shared: &Shared) {
    let mut buffer = vec![0; 16_384];
    let mut last_due = Instant::now();
    let mut line_free = last_due;
    while !shared.stopping() {
        let len = match from.read(&mut buffer) {
            Ok(0) => return,
            Ok(len) => len,
            Err(error) if timed_out(&error) => continue,
            Err(_broken) => return,
        };
        count(&shared.counters.received);
        let now = Instant::now();
        let impairment = shared.impairment();
        let passing =
            impairment.rate.map_or(Duration::ZERO, |rate| Duration::from_secs_f64(len as f64 / rate.max(1.0)));
        line_free = line_free.max(now) + passing;
        last_due = last_due.max(line_free + impairment.delay_of(dice.roll()));
        let mut piece = (last_due, buffer[..len].to_vec());
        loop {
            match queue.try_send(piece) {
                Ok(()) => break,
                Err(TrySendError::Full(back)) if !shared.stopping() => piece = back,
                Err(_ended) => return,
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

fn write(mut to: TcpStream, queue: &Receiver<Piece>, shared: &Shared) {
    while !shared.stopping() {
        let (due, bytes) = match queue.recv_timeout(POLL) {
            Ok(piece) => piece,
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => break,
        };
        loop {
            let wait = due.saturating_duration_since(Instant::now());
            if shared.stopping() || (wait.is_zero() && !shared.dark()) {
                break;
            }
            std::thread::sleep(if shared.dark() { Duration::from_millis(1) } else { wait.min(POLL) });
        }
        if to.write_all(&bytes).is_err() {
            count(&shared.counters.failed);
            break;
        }
        count(&shared.counters.forwarded);
    }
    // Ends the reader of the other way too, where the peer is gone.
    let _closed = to.shutdown(Shutdown::Both);
}
