//! The relay does what its link says, between real sockets.
//!
//! The machine may be late, but never early: bounds from below are strict, those from above hold for the best of many.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::io::{Read as _, Write as _};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use teleop_link::relay::RelayError;
use teleop_link::{Blackouts, Impairment, Link, Profile, Relay, Stats};

const MS: Duration = Duration::from_millis(1);
const PATIENCE: Duration = Duration::from_secs(20);

fn bind() -> UdpSocket {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    socket
}

fn client_of(relay: &Relay) -> UdpSocket {
    let client = bind();
    client.connect(relay.address()).unwrap();
    client
}

fn udp_pair(seed: u64) -> (UdpSocket, UdpSocket, Relay) {
    let server = bind();
    let relay = Relay::udp(server.local_addr().unwrap(), seed).unwrap();
    (client_of(&relay), server, relay)
}

/// Answers everything with itself.
fn udp_echo() -> SocketAddr {
    let server = bind();
    let address = server.local_addr().unwrap();
    std::thread::spawn(move || {
        let mut buffer = vec![0; 65_536];
        while let Ok((len, from)) = server.recv_from(&mut buffer) {
            server.send_to(&buffer[..len], from).unwrap();
        }
    });
    address
}

#[track_caller]
fn eventually(what: &str, mut done: impl FnMut() -> bool) {
    let start = Instant::now();
    while !done() {
        assert!(start.elapsed() < PATIENCE, "waited in vain until {what}");
        std::thread::sleep(MS);
    }
}

/// Sends numbered datagrams, a few at a time, and gives the numbers that arrive, in order of arrival.
fn survivors(seed: u64, impairment: Impairment, count: u32) -> (Vec<u32>, Stats) {
    let (client, server, relay) = udp_pair(seed);
    relay.set(impairment);
    let receive = std::thread::spawn(move || {
        let mut got = Vec::new();
        let mut buffer = [0; 64];
        loop {
            let len = server.recv(&mut buffer).unwrap();
            if len == 1 {
                return got;
            }
            got.push(u32::from_le_bytes(buffer[..len].try_into().unwrap()));
        }
    });
    for number in 0..count {
        client.send(&number.to_le_bytes()).unwrap();
        // The system's buffers are small.
        if number % 20 == 19 {
            eventually("the relay has read", || relay.stats().up.received > u64::from(number));
        }
    }
    let settled = |stats: Stats| stats.up.received + stats.up.duplicated == stats.up.forwarded + stats.up.lost;
    eventually("all have arrived", || settled(relay.stats()));
    let stats = relay.stats();
    // The end goes round no link.
    relay.set(Impairment::default());
    client.send(b"!").unwrap();
    let got = receive.join().unwrap();
    assert_eq!(stats.up.received, u64::from(count), "the kernel lost some");
    (got, stats)
}

#[test]
fn udp_loses_what_it_should_and_the_same_again() {
    let impairment = Impairment { loss: 0.1, burst: Some(2.0), ..Impairment::default() };
    let (one, stats) = survivors(3, impairment, 5000);
    // Mean 500, deviation 39.
    assert!((300..700).contains(&stats.up.lost), "{stats:?}");
    assert_eq!(one.len() as u64, stats.up.forwarded);
    assert_eq!(one, survivors(3, impairment, 5000).0);
    assert_ne!(one, survivors(4, impairment, 5000).0);
}

#[test]
fn udp_reorders_and_duplicates() {
    let impairment = Impairment { delay: 20 * MS, reorder: 0.1, duplicate: 0.1, ..Impairment::default() };
    let (got, stats) = survivors(5, impairment, 1000);
    assert_eq!(got.len() as u64, 1000 + stats.up.duplicated);
    assert!((50..150).contains(&stats.up.duplicated), "{stats:?}");
    assert!(got.windows(2).filter(|pair| pair[1] < pair[0]).count() > 10, "nothing overtook anything");
    let mut unique = got;
    unique.sort_unstable();
    unique.dedup();
    assert!(unique.iter().copied().eq(0..1000));
}

#[test]
fn udp_keeps_the_order_otherwise() {
    let impairment = Impairment { delay: 5 * MS, jitter: 5 * MS, ..Impairment::default() };
    assert!(survivors(5, impairment, 2000).0.into_iter().eq(0..2000));
}

/// Round trips in ms, sorted; `echo` sends one and waits for it to come back.
fn round_trips(mut echo: impl FnMut(u32)) -> Vec<f64> {
    let mut trips: Vec<f64> = (0..21)
        .map(|number| {
            let start = Instant::now();
            echo(number);
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    trips.sort_by(f64::total_cmp);
    println!("round trips: min {:.2}, median {:.2}, max {:.2} ms", trips[0], trips[10], trips[20]);
    trips
}

#[test]
fn fifty_ms_each_way_are_a_hundred() {
    let relay = Relay::udp(udp_echo(), 1).unwrap();
    let client = client_of(&relay);
    let echo = |number: u32| {
        client.send(&number.to_le_bytes()).unwrap();
        let mut buffer = [0; 64];
        let len = client.recv(&mut buffer).unwrap();
        assert_eq!(buffer[..len], number.to_le_bytes());
    };
    assert!(round_trips(echo)[0] < 10.0, "a perfect link is slow");
    relay.set(Impairment { delay: 50 * MS, ..Impairment::default() });
    let trips = round_trips(echo);
    assert!(trips[0] >= 100.0 && trips[0] < 110.0 && trips[10] < 150.0, "{trips:?}");
    // Up and down apart.
    let up = Impairment { delay: 30 * MS, ..Impairment::default() };
    relay.set(Link { up, ..Link::default() });
    let trips = round_trips(echo);
    assert!(trips[0] >= 30.0 && trips[0] < 40.0, "{trips:?}");
}

#[test]
fn udp_passes_any_size_to_many_clients() {
    let relay = Relay::udp(udp_echo(), 1).unwrap();
    let clients: Vec<_> = (0..70).map(|_| client_of(&relay)).collect();
    let mut buffer = vec![0; 65_536];
    for (number, client) in clients.iter().enumerate().take(64) {
        let sent = vec![number as u8; [0, 1, 1200, 9000, 65_507][number % 5]];
        client.send(&sent).unwrap();
        let len = client.recv(&mut buffer).unwrap();
        assert!(buffer[..len] == sent, "{number}: {len} of {}", sent.len());
    }
    // No more at once than it is made for.
    for client in &clients[64..] {
        client.send(b"x").unwrap();
    }
    eventually("six were refused", || relay.stats().refused == 6);
    assert_eq!((relay.stats().clients, relay.stats().up.failed), (64, 6));
    clients[0].send(b"still").unwrap();
    assert_eq!(clients[0].recv(&mut buffer).unwrap(), 5);
}

#[test]
fn udp_blackout_drops() {
    let (client, server, relay) = udp_pair(1);
    let mut buffer = [0; 64];
    client.send(b"before").unwrap();
    assert_eq!(server.recv(&mut buffer).unwrap(), 6);
    relay.blackout(true);
    client.send(b"within").unwrap();
    eventually("it is lost", || relay.stats().up.blacked_out == 1);
    eventually("it is dark", || relay.stats().blackout_s >= 0.05);
    relay.blackout(false);
    client.send(b"later").unwrap();
    assert_eq!(server.recv(&mut buffer).unwrap(), 5);

    // By schedule.
    let schedule: Blackouts = "0..3600".parse().unwrap();
    relay.set(Link { blackouts: schedule, ..Link::default() });
    client.send(b"within").unwrap();
    eventually("it is lost", || relay.stats().up.blacked_out == 2);
    assert_eq!(relay.stats().up.forwarded, 2);
}

#[test]
fn udp_target_may_come_late_and_again() {
    let server = bind();
    let address = server.local_addr().unwrap();
    drop(server);
    // By name, which is looked up.
    let target = format!("udp/localhost:{}", address.port()).parse().unwrap();
    let relay = Relay::start(&"udp/127.0.0.1:0".parse().unwrap(), &target, &Link::default(), 1).unwrap();
    eventually("the name is known", || relay.target() == Some(address));
    let client = client_of(&relay);
    let mut buffer = [0; 64];
    for round in 0..3 {
        for _ in 0..5 {
            client.send(b"to nobody").unwrap();
        }
        eventually("they have gone", || {
            let up = relay.stats().up;
            up.forwarded + up.failed == up.received && up.received >= 5 * (round + 1)
        });
        let server = UdpSocket::bind(address).unwrap();
        server.set_read_timeout(Some(10 * MS)).unwrap();
        eventually("the new one is reached", || {
            client.send(b"hello").unwrap();
            server.recv_from(&mut buffer).is_ok_and(|(len, from)| len == 5 && server.send_to(b"welcome", from).is_ok())
        });
        assert_eq!(client.recv(&mut buffer).unwrap(), 7);
    }
}

#[test]
fn a_flood_fills_no_memory() {
    let (client, _server, relay) = udp_pair(1);
    relay.set(Impairment { delay: Duration::from_secs(60), ..Impairment::default() });
    let bytes = vec![0; 60_000];
    // 32 MiB are 559 of them.
    let mut sent = 0;
    eventually("it is full", || {
        client.send(&bytes).unwrap();
        sent += 1;
        relay.stats().up.failed > 50
    });
    let up = relay.stats().up;
    println!("{sent} sent, {up:?}");
    assert_eq!((up.received - up.failed, up.forwarded), ((32 << 20) / 60_000, 0));

    // A limited rate keeps its queue.
    let (client, _server, relay) = udp_pair(1);
    relay.set(Impairment { rate: Some(1e5), queue: 20_000, ..Impairment::default() });
    eventually("its queue is full", || {
        client.send(&bytes[..1000]).unwrap();
        relay.stats().up.dropped > 50
    });
    let up = relay.stats().up;
    assert!(up.received - up.dropped - up.forwarded <= 21, "{up:?}");
}

#[test]
fn a_relay_ends_when_dropped() {
    let (client, server, relay) = udp_pair(1);
    client.send(b"x").unwrap();
    server.recv(&mut [0; 8]).unwrap();
    let address = relay.address();
    drop(relay);
    assert!(UdpSocket::bind(address).is_ok(), "the socket is still held");

    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let relay = Relay::tcp(listener.local_addr().unwrap(), 1).unwrap();
    let mut client = TcpStream::connect(relay.address()).unwrap();
    let (_server, _) = listener.accept().unwrap();
    drop(relay);
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    assert_eq!(client.read(&mut [0; 8]).unwrap(), 0, "the connection is still open");
}

#[test]
fn what_does_not_fit_is_refused() {
    let start = |listen: &str, target: &str| {
        Relay::start(&listen.parse().unwrap(), &target.parse().unwrap(), &Link::default(), 1)
    };
    assert!(matches!(start("udp/127.0.0.1:0", "tcp/127.0.0.1:1"), Err(RelayError::Transport { .. })));
    assert!(matches!(start("tcp/127.0.0.1:0", "tcp/127.0.0.1:0"), Err(RelayError::Port(_))));
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let listen = format!("tcp/{}", taken.local_addr().unwrap());
    assert!(matches!(start(&listen, "tcp/127.0.0.1:1"), Err(RelayError::Listen { .. })));
    assert!(start("quic/127.0.0.1:0", "udp/127.0.0.1:1").is_ok());
}

/// A connection to a server that answers everything with itself, and then ends its answer too.
fn tcp_echo() -> (TcpStream, Relay) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let relay = Relay::tcp(listener.local_addr().unwrap(), 9).unwrap();
    std::thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            std::thread::spawn(move || {
                stream.set_nodelay(true).unwrap();
                let mut buffer = [0; 16_384];
                while let Ok(len @ 1..) = stream.read(&mut buffer) {
                    stream.write_all(&buffer[..len]).unwrap();
                }
            });
        }
    });
    (tcp_client(&relay), relay)
}

fn tcp_client(relay: &Relay) -> TcpStream {
    let client = TcpStream::connect(relay.address()).unwrap();
    client.set_nodelay(true).unwrap();
    client.set_read_timeout(Some(PATIENCE)).unwrap();
    client
}

/// Sends `len` bytes, ends, and expects them all back, and the end.
fn whole(mut client: TcpStream, len: u32) {
    let sent: Vec<u8> = (0..len).map(|index| (index * 31 % 251) as u8).collect();
    let (mut writer, bytes) = (client.try_clone().unwrap(), sent.clone());
    let write = std::thread::spawn(move || {
        writer.write_all(&bytes).unwrap();
        writer.shutdown(Shutdown::Write).unwrap();
    });
    let mut got = Vec::new();
    client.read_to_end(&mut got).unwrap();
    write.join().unwrap();
    assert!(got == sent, "{} of {} bytes, or they changed places", got.len(), sent.len());
}

#[test]
fn tcp_delays() {
    let (mut client, relay) = tcp_echo();
    relay.set(Impairment { delay: 25 * MS, ..Impairment::default() });
    let trips = round_trips(|number| {
        client.write_all(&number.to_le_bytes()).unwrap();
        let mut buffer = [0; 4];
        client.read_exact(&mut buffer).unwrap();
        assert_eq!(buffer, number.to_le_bytes());
    });
    assert!(trips[0] >= 50.0 && trips[0] < 60.0, "{trips:?}");
}

#[test]
fn tcp_keeps_every_byte_and_both_ends() {
    let (client, relay) = tcp_echo();
    let bad = Impairment { delay: MS, jitter: MS, loss: 0.005, reorder: 0.01, duplicate: 0.1, ..Impairment::default() };
    relay.set(bad);
    let clients: Vec<_> = [client, tcp_client(&relay), tcp_client(&relay)]
        .into_iter()
        .map(|client| std::thread::spawn(move || whole(client, 500_000)))
        .collect();
    for client in clients {
        client.join().unwrap();
    }
    let stats = relay.stats();
    assert!(stats.up.lost > 0 && stats.down.lost > 0, "{stats:?}");
    assert_eq!((stats.up.bytes, stats.down.bytes), (1_500_000, 1_500_000));
    eventually("all connections have ended", || relay.stats().clients == 0);

    // The target ends first.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let relay = Relay::tcp(listener.local_addr().unwrap(), 9).unwrap();
    let mut client = tcp_client(&relay);
    let (mut server, _) = listener.accept().unwrap();
    server.write_all(b"goodbye").unwrap();
    server.shutdown(Shutdown::Write).unwrap();
    let mut got = String::new();
    client.read_to_string(&mut got).unwrap();
    assert_eq!(got, "goodbye");
    client.write_all(b"thanks").unwrap();
    drop(client);
    got.clear();
    server.read_to_string(&mut got).unwrap();
    assert_eq!(got, "thanks");
}

#[test]
fn tcp_rate_and_backpressure() {
    let (client, relay) = tcp_echo();
    let up = Impairment { rate: Some(1.6e6), queue: 20_000, ..Impairment::default() };
    relay.set(Link { up, ..Link::default() });
    let start = Instant::now();
    whole(client, 100_000);
    assert!(start.elapsed() >= 490 * MS, "{:?}", start.elapsed());
    let stats = relay.stats();
    assert_eq!((stats.up.dropped, stats.up.bytes), (0, 100_000));

    // A sender that nobody reads from has to wait.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let relay = Relay::tcp(listener.local_addr().unwrap(), 9).unwrap();
    relay.blackout(true);
    let mut client = tcp_client(&relay);
    client.set_write_timeout(Some(200 * MS)).unwrap();
    let chunk = vec![0; 1 << 20];
    let taken = (0..64).take_while(|_| client.write_all(&chunk).is_ok()).count();
    println!("{taken} MiB taken");
    assert!(taken < 32, "{taken} MiB taken");
}

#[test]
fn tcp_blackout_holds_up() {
    let (mut client, relay) = tcp_echo();
    let mut buffer = [0; 4];
    let mut echo = |text: &[u8; 4]| {
        client.write_all(text).unwrap();
        client.read_exact(&mut buffer).unwrap();
        assert_eq!(&buffer, text);
    };
    echo(b"here");
    relay.blackout(true);
    let start = Instant::now();
    let (release, lit) = (
        300 * MS,
        std::thread::scope(|scope| {
            let lit = scope.spawn(|| {
                std::thread::sleep(300 * MS);
                relay.blackout(false);
            });
            echo(b"held");
            lit.join().unwrap();
            start.elapsed()
        }),
    );
    assert!(lit >= release, "passed through a blackout after {lit:?}");
    // By schedule, from now on for a while.
    let from = Duration::ZERO;
    let to = start.elapsed() + 3000 * MS;
    relay.set(Link { blackouts: Blackouts::windows(vec![(from, to)]).unwrap(), ..Link::default() });
    let start = Instant::now();
    echo(b"held");
    // The relay began a little earlier than this test's clock, by the time that the first echo took.
    assert!(start.elapsed() >= 1000 * MS, "{:?}", start.elapsed());
    assert!(relay.stats().blackout_s >= 1.0);
}

#[test]
fn tcp_target_may_come_late_and_again() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    drop(listener);
    let relay = Relay::tcp(address, 1).unwrap();
    let mut buffer = [0; 8];
    assert_eq!(tcp_client(&relay).read(&mut buffer).unwrap_or(0), 0, "nobody is there");
    for _ in 0..2 {
        let listener = TcpListener::bind(address).unwrap();
        let mut client = tcp_client(&relay);
        let (mut server, _) = listener.accept().unwrap();
        client.write_all(b"hello").unwrap();
        server.read_exact(&mut buffer[..5]).unwrap();
        assert_eq!(&buffer[..5], b"hello");
        // It goes without a word, with something unread: the client learns of it.
        client.write_all(b"more").unwrap();
        drop((server, listener));
        eventually("the connection is closed", || matches!(client.read(&mut buffer), Ok(0) | Err(_)));
    }
}

#[test]
fn every_profile_passes_an_echo() {
    for profile in Profile::ALL {
        let (mut client, relay) = tcp_echo();
        relay.set(profile.link());
        client.write_all(b"echo").unwrap();
        let mut buffer = [0; 4];
        client.read_exact(&mut buffer).unwrap();
        assert_eq!(&buffer, b"echo", "{}", profile.name);

        let relay = Relay::udp(udp_echo(), 1).unwrap();
        relay.set(profile.link());
        let client = client_of(&relay);
        client.set_read_timeout(Some(700 * MS)).unwrap();
        eventually(profile.name, || {
            client.send(b"echo").unwrap();
            client.recv(&mut buffer).is_ok()
        });
    }
}
