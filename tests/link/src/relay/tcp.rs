use std::collections::VecDeque;
use std::io::{self, Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::os::fd::AsFd as _;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::event::PollFlags;
use rustix::net::sockopt::set_socket_recv_buffer_size;

use super::{MAX_CLIENTS, POLL, Shared, wait};
use crate::Direction;

/// Payload of a full segment on Ethernet, with time stamps.
const SEGMENT: usize = 1448;
/// Bytes on their way at once, per connection and direction; then the sender has to wait, as TCP does.
const MAX_IN_FLIGHT: usize = 4 << 20;
/// What the system may take from a sender before we read it: the rest should wait where a sender notices.
const SYSTEM_BUFFER: usize = 64 << 10;
/// How long the target may take to accept.
const CONNECT: Duration = Duration::from_secs(1);

pub(super) fn start(listen: SocketAddr, shared: Arc<Shared>) -> io::Result<(SocketAddr, JoinHandle<()>)> {
    let listener = TcpListener::bind(listen)?;
    listener.set_nonblocking(true)?;
    // What it accepts inherits this.
    set_socket_recv_buffer_size(&listener, SYSTEM_BUFFER)?;
    let address = listener.local_addr()?;
    Ok((address, std::thread::spawn(move || accept(&listener, &shared))))
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    let mut connections: Vec<JoinHandle<()>> = Vec::new();
    while !shared.stopping() {
        shared.look();
        connections.retain(|thread| !thread.is_finished());
        shared.clients.store(connections.len(), Ordering::Relaxed);
        wait(&[(listener.as_fd(), PollFlags::IN)], POLL);
        let Ok((client, _from)) = listener.accept() else { continue };
        if connections.len() >= MAX_CLIENTS {
            shared.refused.fetch_add(1, Ordering::Relaxed);
            continue;
        }
        let shared = Arc::clone(shared);
        connections.push(std::thread::spawn(move || {
            match connect(&client, &shared) {
                Ok(server) => Connection::new(&client, &server, &shared).run(),
                // The client finds its connection closed, as that to the target would have been.
                Err(_unreachable) => {
                    shared.refused.fetch_add(1, Ordering::Relaxed);
                }
            }
        }));
    }
    for thread in connections {
        let _ended = thread.join();
    }
}

fn connect(client: &TcpStream, shared: &Shared) -> io::Result<TcpStream> {
    let target = shared.target.address().ok_or(io::ErrorKind::HostUnreachable)?;
    let server = TcpStream::connect_timeout(&target, CONNECT)?;
    set_socket_recv_buffer_size(&server, SYSTEM_BUFFER)?;
    for stream in [client, &server] {
        stream.set_nodelay(true)?;
        stream.set_nonblocking(true)?;
    }
    Ok(server)
}

/// A connection, both ways; one thread.
struct Connection<'a> {
    shared: &'a Shared,
    ways: [Stream<'a>; 2],
}

/// One way of a connection.
struct Stream<'a> {
    direction: Direction,
    from: &'a TcpStream,
    to: &'a TcpStream,
    queue: VecDeque<Piece>,
    bytes_in_flight: usize,
    /// When the last of the queue is due.
    last_due: Duration,
    /// Nothing more comes.
    ended: bool,
    /// All was written, the end too.
    closed: bool,
    /// The receiver has to read first.
    blocked: bool,
}

struct Piece {
    due: Duration,
    /// What is left of it; the end of the stream if there was never anything.
    bytes: Vec<u8>,
    written: usize,
}

/// The other side is gone.
struct Broken;

impl<'a> Connection<'a> {
    fn new(client: &'a TcpStream, server: &'a TcpStream, shared: &'a Shared) -> Self {
        let way = |direction, from, to| Stream {
            direction,
            from,
            to,
            queue: VecDeque::new(),
            bytes_in_flight: 0,
            last_due: Duration::ZERO,
            ended: false,
            closed: false,
            blocked: false,
        };
        Self { shared, ways: [way(Direction::Up, client, server), way(Direction::Down, server, client)] }
    }

    fn run(mut self) {
        let mut buffer = vec![0; 11 * SEGMENT];
        while !self.shared.stopping() && self.ways.iter().any(|way| !way.closed) {
            let mut timeout = POLL;
            let mut wanted = Vec::new();
            for (index, way) in self.ways.iter_mut().enumerate() {
                let Ok(next) = way.write(self.shared) else { return };
                let room = way.room(self.shared, buffer.len());
                timeout = timeout.min(next);
                if way.blocked {
                    wanted.push((index, way.to, PollFlags::OUT));
                }
                if room.is_zero() {
                    wanted.push((index, way.from, PollFlags::IN));
                } else {
                    timeout = timeout.min(room);
                }
            }
            let sockets: Vec<_> = wanted.iter().map(|(_, socket, flags)| (socket.as_fd(), *flags)).collect();
            let ready = wait(&sockets, timeout);
            for ((index, _, flags), ready) in wanted.iter().zip(ready) {
                if *flags == PollFlags::IN && !ready.is_empty() {
                    self.ways[*index].read(&mut buffer, self.shared);
                }
            }
        }
    }
}

impl Stream<'_> {
    /// How long it is no use to read.
    fn room(&self, shared: &Shared, bytes: usize) -> Duration {
        if self.ended || self.bytes_in_flight + bytes > MAX_IN_FLIGHT {
            return POLL;
        }
        shared.way(self.direction).model.room(shared.now(), bytes)
    }

    fn read(&mut self, buffer: &mut [u8], shared: &Shared) {
        let len = match self.from.read(buffer) {
            Ok(len) => len,
            Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => return,
            Err(_reset) => 0,
        };
        self.ended = len == 0;
        let mut way = shared.way(self.direction);
        let now = shared.now();
        // The end is a segment like any other.
        let segments = buffer[..len].chunks(SEGMENT).chain((len == 0).then_some([].as_slice()));
        for bytes in segments {
            let segment = way.model.send_segment(now, bytes.len());
            way.counts.received += 1;
            way.counts.lost += u64::from(segment.losses);
            self.last_due = self.last_due.max(segment.at);
            self.bytes_in_flight += bytes.len();
            self.queue.push_back(Piece { due: self.last_due, bytes: bytes.to_vec(), written: 0 });
        }
    }

    /// Writes what is due; how long nothing will be.
    fn write(&mut self, shared: &Shared) -> Result<Duration, Broken> {
        self.blocked = false;
        while let Some(piece) = self.queue.front_mut() {
            let now = shared.now();
            let mut way = shared.way(self.direction);
            if way.model.dark(now) {
                return Ok(POLL);
            }
            if piece.due > now {
                return Ok(piece.due - now);
            }
            if piece.bytes.is_empty() {
                self.closed = true;
                self.to.shutdown(Shutdown::Write).map_err(|_gone| Broken)?;
            } else {
                match self.to.write(&piece.bytes[piece.written..]) {
                    Ok(written) => piece.written += written,
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                        self.blocked = true;
                        return Ok(POLL);
                    }
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(_gone) => return Err(Broken),
                }
            }
            if piece.written == piece.bytes.len() {
                way.counts.forwarded += 1;
                way.counts.bytes += piece.written as u64;
                self.bytes_in_flight -= piece.written;
                self.queue.pop_front();
            }
        }
        Ok(POLL)
    }
}
