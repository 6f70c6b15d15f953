use std::cmp::Ordering as Order;
use std::collections::{BinaryHeap, HashMap};
use std::io;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Instant;

use super::{Dice, Fate, Impairment, POLL, Shared, Stats, count, timed_out};

/// Datagrams on their way at once; more are dropped and counted.
const MAX_IN_FLIGHT: usize = 10_000;
/// Peers that may connect through one relay.
const MAX_CLIENTS: usize = 16;

/// A UDP relay on 127.0.0.1.
#[derive(Debug)]
pub struct UdpRelay {
    address: SocketAddr,
    shared: Arc<Shared>,
    flight: Arc<Flight>,
    threads: Vec<JoinHandle<()>>,
}

impl UdpRelay {
    /// A perfect relay to `target`, listening on a port the system chooses.
    ///
    /// # Errors
    /// If no socket is to be had.
    pub fn start(target: SocketAddr, seed: u64) -> io::Result<Self> {
        let front = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
        front.set_read_timeout(Some(POLL))?;
        let address = front.local_addr()?;
        let front = Arc::new(front);
        let shared = Arc::new(Shared::default());
        let flight = Arc::new(Flight::default());
        let deliver = {
            let (shared, flight) = (Arc::clone(&shared), Arc::clone(&flight));
            std::thread::spawn(move || flight.deliver(&shared))
        };
        let accept = {
            let (shared, flight) = (Arc::clone(&shared), Arc::clone(&flight));
            std::thread::spawn(move || forwards(&front, target, seed, &shared, &flight))
        };
        Ok(Self { address, shared, flight, threads: vec![deliver, accept] })
    }

    /// Where to send to.
    #[must_use]
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Changes the link from the next datagram on.
    pub fn set(&self, impairment: Impairment) {
        self.shared.set(impairment);
    }

    /// Drops everything while `on`.
    pub fn blackout(&self, on: bool) {
        self.shared.blackout.store(on, Ordering::Relaxed);
    }

    /// What it has done so far.
    #[must_use]
    pub fn stats(&self) -> Stats {
        self.shared.stats()
    }
}

impl Drop for UdpRelay {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
        self.flight.wake.notify_all();
        for thread in self.threads.drain(..) {
            // A relay thread has nothing to tell when it ends.
            let _ended = thread.join();
        }
    }
}

/// From the clients to the target, and one more thread per client for the way back.
fn forwards(front: &Arc<UdpSocket>, target: SocketAddr, seed: u64, shared: &Arc<Shared>, flight: &Arc<Flight>) {
    let mut dice = Dice::new(seed, 1);
    let mut clients: HashMap<SocketAddr, Arc<UdpSocket>> = HashMap::new();
    let mut threads = Vec::new();
    let mut buffer = vec![0; 65_536];
    while !shared.stopping() {
        let (len, client) = match front.recv_from(&mut buffer) {
            Ok(found) => found,
            Err(error) if timed_out(&error) => continue,
            // The answer of a closed port to something sent before; nothing to do with the next datagram.
            Err(_refused) => continue,
        };
        if !clients.contains_key(&client) {
            let socket = (clients.len() < MAX_CLIENTS).then(|| connect(target)).and_then(Result::ok);
            let Some(socket) = socket.map(Arc::new) else {
                count(&shared.counters.failed);
                continue;
            };
            clients.insert(client, Arc::clone(&socket));
            let (front, shared, flight) = (Arc::clone(front), Arc::clone(shared), Arc::clone(flight));
            let dice = Dice::new(seed, 1 + clients.len() as u64);
            threads.push(std::thread::spawn(move || backwards(&socket, &front, client, dice, &shared, &flight)));
        }
        if let Some(socket) = clients.get(&client) {
            flight.admit(&buffer[..len], socket, None, &mut dice, shared);
        }
    }
    for thread in threads {
        let _ended = thread.join();
    }
}

fn connect(target: SocketAddr) -> io::Result<UdpSocket> {
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0))?;
    socket.set_read_timeout(Some(POLL))?;
    socket.connect(target)?;
    Ok(socket)
}

fn backwards(
    socket: &UdpSocket,
    front: &Arc<UdpSocket>,
    client: SocketAddr,
    mut dice: Dice,
    shared: &Shared,
    flight: &Flight,
) {
    let mut buffer = vec![0; 65_536];
    while !shared.stopping() {
        if let Ok(len) = socket.recv(&mut buffer) {
            flight.admit(&buffer[..len], front, Some(client), &mut dice, shared);
        }
    }
}

/// The datagrams on their way.
#[derive(Debug, Default)]
struct Flight {
    queue: Mutex<BinaryHeap<Datagram>>,
    wake: Condvar,
}

#[derive(Debug)]
struct Datagram {
    due: Instant,
    bytes: Vec<u8>,
    socket: Arc<UdpSocket>,
    /// Where to, unless the socket is connected.
    to: Option<SocketAddr>,
}

impl Flight {
    fn queue(&self) -> MutexGuard<'_, BinaryHeap<Datagram>> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn admit(&self, bytes: &[u8], socket: &Arc<UdpSocket>, to: Option<SocketAddr>, dice: &mut Dice, shared: &Shared) {
        let now = Instant::now();
        count(&shared.counters.received);
        let fate = dice.fate(&shared.impairment());
        if shared.dark() {
            return count(&shared.counters.blacked_out);
        }
        let Fate::Arrives(first, second) = fate else {
            return count(&shared.counters.lost);
        };
        let mut queue = self.queue();
        for delay in std::iter::once(first).chain(second) {
            if queue.len() >= MAX_IN_FLIGHT {
                count(&shared.counters.failed);
            } else {
                queue.push(Datagram { due: now + delay, bytes: bytes.to_vec(), socket: Arc::clone(socket), to });
            }
        }
        if second.is_some() {
            count(&shared.counters.duplicated);
        }
        drop(queue);
        self.wake.notify_one();
    }

    fn deliver(&self, shared: &Shared) {
        let mut queue = self.queue();
        while !shared.stopping() {
            let now = Instant::now();
            let wait = queue.peek().map_or(POLL, |next| next.due.saturating_duration_since(now)).min(POLL);
            if !wait.is_zero() {
                queue = self.wake.wait_timeout(queue, wait).unwrap_or_else(PoisonError::into_inner).0;
                continue;
            }
            let Some(datagram) = queue.pop() else { continue };
            drop(queue);
            let sent = match datagram.to {
                None => datagram.socket.send(&datagram.bytes),
                Some(to) => datagram.socket.send_to(&datagram.bytes, to),
            };
            count(if sent.is_ok() { &shared.counters.forwarded } else { &shared.counters.failed });
            queue = self.queue();
        }
    }
}

/// The earliest is the greatest, for the heap.
impl Ord for Datagram {
    fn cmp(&self, other: &Self) -> Order {
        other.due.cmp(&self.due)
    }
}

impl PartialOrd for Datagram {
    fn partial_cmp(&self, other: &Self) -> Option<Order> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Datagram {
    fn eq(&self, other: &Self) -> bool {
        self.due == other.due
    }
}

impl Eq for Datagram {}
