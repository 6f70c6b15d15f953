use std::cmp::Ordering as Order;
use std::collections::BinaryHeap;
use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr, UdpSocket};
use std::os::fd::AsFd as _;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::event::PollFlags;
use rustix::net::sockopt::set_socket_recv_buffer_size;

use super::{MAX_CLIENTS, POLL, Shared, wait};
use crate::{Cause, Direction, Fate};

/// Datagrams on their way at once, and their bytes; more are given up.
const MAX_IN_FLIGHT: usize = 50_000;
const MAX_BYTES_IN_FLIGHT: usize = 32 << 20;
/// A client that was silent both ways for so long is forgotten.
const EXPIRY: Duration = Duration::from_secs(60);
/// Datagrams read from a socket before those that are due are sent.
const BATCH: usize = 64;
/// What the system may keep for us, as far as it allows.
const SYSTEM_BUFFER: usize = 4 << 20;

pub(super) fn start(listen: SocketAddr, shared: Arc<Shared>) -> io::Result<(SocketAddr, JoinHandle<()>)> {
    let front = open(listen)?;
    let address = front.local_addr()?;
    Ok((address, std::thread::spawn(move || Hub::new(front, &shared).run())))
}

fn open(address: SocketAddr) -> io::Result<UdpSocket> {
    let socket = UdpSocket::bind(address)?;
    socket.set_nonblocking(true)?;
    set_socket_recv_buffer_size(&socket, SYSTEM_BUFFER)?;
    Ok(socket)
}

/// A socket towards the target.
fn connect(target: SocketAddr) -> io::Result<UdpSocket> {
    let any = if target.is_ipv4() { Ipv4Addr::UNSPECIFIED.into() } else { Ipv6Addr::UNSPECIFIED.into() };
    let socket = open(SocketAddr::new(any, 0))?;
    socket.connect(target)?;
    Ok(socket)
}

/// The one thread of a relay, with all its sockets and all datagrams on their way.
struct Hub<'a> {
    shared: &'a Shared,
    front: Rc<UdpSocket>,
    target: Option<SocketAddr>,
    clients: Vec<Client>,
    flight: BinaryHeap<Datagram>,
    bytes_in_flight: usize,
    number: u64,
}

struct Client {
    address: SocketAddr,
    /// Connected to the target, which answers to it.
    socket: Rc<UdpSocket>,
    /// Heard of, time since the start.
    seen: Duration,
}

struct Datagram {
    due: Duration,
    /// Those due at once keep their order.
    number: u64,
    direction: Direction,
    bytes: Rc<[u8]>,
    socket: Rc<UdpSocket>,
    /// Where to, unless the socket is connected.
    to: Option<SocketAddr>,
}

impl<'a> Hub<'a> {
    fn new(front: UdpSocket, shared: &'a Shared) -> Self {
        Self {
            shared,
            front: Rc::new(front),
            target: None,
            clients: Vec::new(),
            flight: BinaryHeap::new(),
            bytes_in_flight: 0,
            number: 0,
        }
    }

    fn run(mut self) {
        let mut buffer = vec![0; 65_536];
        while !self.shared.stopping() {
            self.shared.look();
            self.deliver();
            self.forget();
            let now = self.shared.now();
            let timeout = self.flight.peek().map_or(POLL, |next| next.due.saturating_sub(now)).min(POLL);
            let sockets: Vec<_> = std::iter::once(&self.front)
                .chain(self.clients.iter().map(|client| &client.socket))
                .map(|socket| (socket.as_fd(), PollFlags::IN))
                .collect();
            let ready = wait(&sockets, timeout);
            // From the last: reading the front adds clients.
            for (index, flags) in ready.iter().enumerate().rev() {
                // An error of a socket is read as well.
                if !flags.is_empty() {
                    match index.checked_sub(1) {
                        None => self.read_front(&mut buffer),
                        Some(client) => self.read_back(client, &mut buffer),
                    }
                }
            }
        }
    }

    fn read_front(&mut self, buffer: &mut [u8]) {
        for _ in 0..BATCH {
            match self.front.recv_from(buffer) {
                Ok((len, from)) => match self.client(from) {
                    Some(socket) => self.admit(&buffer[..len], Direction::Up, socket, None),
                    None => {
                        let mut way = self.shared.way(Direction::Up);
                        way.counts.received += 1;
                        way.counts.failed += 1;
                    }
                },
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                // The answer of a closed port to something sent before; nothing to do with the next datagram.
                Err(_refused) => {}
            }
        }
    }

    fn read_back(&mut self, client: usize, buffer: &mut [u8]) {
        let Client { address, socket, .. } = &self.clients[client];
        let (address, socket) = (*address, Rc::clone(socket));
        for _ in 0..BATCH {
            match socket.recv(buffer) {
                Ok(len) => {
                    self.clients[client].seen = self.shared.now();
                    self.admit(&buffer[..len], Direction::Down, Rc::clone(&self.front), Some(address));
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return,
                Err(_refused) => {}
            }
        }
    }

    /// The socket by which a client reaches the target.
    fn client(&mut self, address: SocketAddr) -> Option<Rc<UdpSocket>> {
        let now = self.shared.now();
        if let Some(client) = self.clients.iter_mut().find(|client| client.address == address) {
            client.seen = now;
            return Some(Rc::clone(&client.socket));
        }
        let socket = (self.clients.len() < MAX_CLIENTS)
            .then_some(self.target)
            .flatten()
            .and_then(|target| connect(target).ok())
            .map(Rc::new);
        let Some(socket) = socket else {
            self.shared.refused.fetch_add(1, Ordering::Relaxed);
            return None;
        };
        self.clients.push(Client { address, socket: Rc::clone(&socket), seen: now });
        Some(socket)
    }

    /// Forgets who is silent, and everybody if the target has moved: their next datagram goes there.
    fn forget(&mut self) {
        let target = self.shared.target.address();
        if self.target != target {
            self.clients.clear();
            self.target = target;
        }
        let now = self.shared.now();
        self.clients.retain(|client| now.saturating_sub(client.seen) < EXPIRY);
        self.shared.clients.store(self.clients.len(), Ordering::Relaxed);
    }

    fn admit(&mut self, bytes: &[u8], direction: Direction, socket: Rc<UdpSocket>, to: Option<SocketAddr>) {
        let mut way = self.shared.way(direction);
        way.counts.received += 1;
        let (at, copy) = match way.model.send(self.shared.now(), bytes.len()) {
            Fate::Arrives { at, copy } => (at, copy),
            Fate::Lost(cause) => {
                match cause {
                    Cause::Chance => way.counts.lost += 1,
                    Cause::Queue => way.counts.dropped += 1,
                    Cause::Blackout => way.counts.blacked_out += 1,
                }
                return;
            }
        };
        way.counts.duplicated += u64::from(copy.is_some());
        let bytes: Rc<[u8]> = bytes.into();
        for due in std::iter::once(at).chain(copy) {
            let full = self.bytes_in_flight + bytes.len() > MAX_BYTES_IN_FLIGHT;
            if full || self.flight.len() >= MAX_IN_FLIGHT {
                way.counts.failed += 1;
                continue;
            }
            self.number += 1;
            self.bytes_in_flight += bytes.len();
            let (bytes, socket) = (Rc::clone(&bytes), Rc::clone(&socket));
            self.flight.push(Datagram { due, number: self.number, direction, bytes, socket, to });
        }
    }

    fn deliver(&mut self) {
        let now = self.shared.now();
        while let Some(datagram) = self.flight.peek().filter(|next| next.due <= now) {
            let sent = datagram.send();
            let mut way = self.shared.way(datagram.direction);
            if sent {
                way.counts.forwarded += 1;
                way.counts.bytes += datagram.bytes.len() as u64;
            } else {
                way.counts.failed += 1;
            }
            drop(way);
            self.bytes_in_flight -= datagram.bytes.len();
            self.flight.pop();
        }
    }
}

impl Datagram {
    fn send(&self) -> bool {
        let send = || match self.to {
            None => self.socket.send(&self.bytes),
            Some(to) => self.socket.send_to(&self.bytes, to),
        };
        // The answer of a closed port to the datagram before is an error of this one, which may well arrive.
        match send() {
            Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => send().is_ok(),
            sent => sent.is_ok(),
        }
    }
}

/// The earliest is the greatest, for the heap.
impl Ord for Datagram {
    fn cmp(&self, other: &Self) -> Order {
        (other.due, other.number).cmp(&(self.due, self.number))
    }
}

impl PartialOrd for Datagram {
    fn partial_cmp(&self, other: &Self) -> Option<Order> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Datagram {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Datagram {}
