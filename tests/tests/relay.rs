//! The bad network does what it says.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use teleop_tests::relay::{Dice, Fate, Impairment, TcpRelay, UdpRelay};

const MS: Duration = Duration::from_millis(1);

fn udp_pair(seed: u64) -> (UdpSocket, UdpSocket, UdpRelay) {
    let server = UdpSocket::bind("127.0.0.1:0").unwrap();
    let relay = UdpRelay::start(server.local_addr().unwrap(), seed).unwrap();
    let client = UdpSocket::bind("127.0.0.1:0").unwrap();
    client.connect(relay.address()).unwrap();
    for socket in [&server, &client] {
        socket.set_read_timeout(Some(Duration::from_secs(2))).unwrap();
    }
    (client, server, relay)
}

/// Sends `count` numbered datagrams, a few at a time, and gives the numbers that arrive, in order of arrival.
fn survivors(seed: u64, impairment: Impairment, count: u32) -> Vec<u32> {
    let (client, server, relay) = udp_pair(seed);
    relay.set(impairment);
    server.set_read_timeout(Some(300 * MS)).unwrap();
    let receive = std::thread::spawn(move || {
        let mut got = Vec::new();
        let mut buffer = [0; 64];
        while let Ok(len) = server.recv(&mut buffer) {
            assert_eq!(len, 4);
            got.push(u32::from_le_bytes(buffer[..4].try_into().unwrap()));
        }
        got
    });
    for number in 0..count {
        client.send(&number.to_le_bytes()).unwrap();
        if number % 20 == 19 {
            std::thread::sleep(MS);
        }
    }
    let got = receive.join().unwrap();
    let stats = relay.stats();
    assert_eq!(stats.received, u64::from(count), "the kernel lost some");
    assert_eq!(stats.forwarded, got.len() as u64, "the kernel lost some");
    assert_eq!(stats.received + stats.duplicated, stats.forwarded + stats.lost);
    got
}

#[test]
fn same_seed_same_fate() {
    let impairment = Impairment { delay: 20 * MS, jitter: 5 * MS, loss: 0.1, reorder: 0.2, duplicate: 0.1, rate: None };
    let fates = |seed, direction| {
        let mut dice = Dice::new(seed, direction);
        std::iter::repeat_with(|| dice.fate(&impairment)).take(10_000).collect::<Vec<_>>()
    };
    let one = fates(7, 1);
    assert_eq!(one, fates(7, 1));
    assert_ne!(one, fates(8, 1));
    assert_ne!(one, fates(7, 2));
    let fraction = |test: &dyn Fn(&Fate) -> bool| one.iter().filter(|fate| test(fate)).count() as f64 / 10_000.0;
    assert!((fraction(&|fate| *fate == Fate::Lost) - 0.1).abs() < 0.012);
    assert!((fraction(&|fate| matches!(fate, Fate::Arrives(first, _) if first.is_zero())) - 0.18).abs() < 0.015);
    assert!((fraction(&|fate| matches!(fate, Fate::Arrives(_, Some(_)))) - 0.09).abs() < 0.012);
    for fate in one {
        if let Fate::Arrives(first, _) = fate {
            assert!(first.is_zero() || (15 * MS..=25 * MS).contains(&first), "{first:?}");
        }
    }
}

#[test]
fn loses_what_it_should_and_the_same_again() {
    let impairment = Impairment { loss: 0.1, ..Impairment::default() };
    let one = survivors(3, impairment, 5000);
    let lost = 5000 - one.len();
    // Binomial: mean 500, deviation 21.
    assert!((400..600).contains(&lost), "{lost} of 5000 lost");
    let sorted = |mut numbers: Vec<u32>| {
        numbers.sort_unstable();
        numbers
    };
    let (one, again, other) =
        (sorted(one), sorted(survivors(3, impairment, 5000)), sorted(survivors(4, impairment, 5000)));
    assert_eq!(one, again);
    assert_ne!(one, other);
}

#[test]
fn reorders_and_duplicates() {
    let impairment = Impairment { delay: 20 * MS, reorder: 0.1, duplicate: 0.1, ..Impairment::default() };
    let got = survivors(5, impairment, 1000);
    assert!((1050..1150).contains(&got.len()), "{} of 1000", got.len());
    assert!(got.windows(2).filter(|pair| pair[1] < pair[0]).count() > 20, "nothing overtook anything");
    let mut unique = got;
    unique.sort_unstable();
    unique.dedup();
    assert_eq!(unique, (0..1000).collect::<Vec<_>>());
}

/// Round trips in ms, sorted; `echo` sends one and waits for it to come back.
fn round_trips(mut echo: impl FnMut(u32)) -> Vec<f64> {
    let mut trips: Vec<f64> = (0..20)
        .map(|number| {
            let start = Instant::now();
            echo(number);
            start.elapsed().as_secs_f64() * 1e3
        })
        .collect();
    trips.sort_by(f64::total_cmp);
    trips
}

#[test]
fn udp_delay_is_what_was_asked_for() {
    let (client, server, relay) = udp_pair(1);
    std::thread::spawn(move || {
        let mut buffer = [0; 64];
        while let Ok((len, from)) = server.recv_from(&mut buffer) {
            server.send_to(&buffer[..len], from).unwrap();
        }
    });
    relay.set(Impairment { delay: 50 * MS, ..Impairment::default() });
    let trips = round_trips(|number| {
        client.send(&number.to_le_bytes()).unwrap();
        let mut buffer = [0; 64];
        let len = client.recv(&mut buffer).unwrap();
        assert_eq!(buffer[..len], number.to_le_bytes());
    });
    // Never early; late only as far as the machine is, which the fastest of twenty shows least.
    assert!(trips[0] >= 100.0 && trips[0] < 110.0, "{trips:?}");
}

#[test]
fn udp_blackout_drops() {
    let (client, server, relay) = udp_pair(1);
    let mut buffer = [0; 64];
    client.send(b"before").unwrap();
    assert_eq!(server.recv(&mut buffer).unwrap(), 6);
    relay.blackout(true);
    client.send(b"within").unwrap();
    let start = Instant::now();
    while relay.stats().blacked_out == 0 && start.elapsed() < Duration::from_secs(5) {
        std::thread::sleep(MS);
    }
    relay.blackout(false);
    client.send(b"later").unwrap();
    assert_eq!(server.recv(&mut buffer).unwrap(), 5);
    assert_eq!(relay.stats().blacked_out, 1);
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
    let relay = TcpRelay::start(listener.local_addr().unwrap(), 1).unwrap();
    let mut client = TcpStream::connect(relay.address()).unwrap();
    let (_server, _) = listener.accept().unwrap();
    drop(relay);
    client.set_read_timeout(Some(Duration::from_secs(2))).unwrap();
    assert_eq!(client.read(&mut [0; 8]).unwrap(), 0, "the connection is still open");
}

fn tcp_echo() -> (TcpStream, TcpRelay) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let relay = TcpRelay::start(listener.local_addr().unwrap(), 9).unwrap();
    std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.set_nodelay(true).unwrap();
        let mut buffer = [0; 16_384];
        while let Ok(len @ 1..) = stream.read(&mut buffer) {
            stream.write_all(&buffer[..len]).unwrap();
        }
    });
    let client = TcpStream::connect(relay.address()).unwrap();
    client.set_nodelay(true).unwrap();
    client.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    (client, relay)
}

#[test]
fn tcp_delays_and_keeps_order() {
    let (mut client, relay) = tcp_echo();
    relay.set(Impairment { delay: 25 * MS, jitter: 5 * MS, loss: 1.0, ..Impairment::default() });
    let trips = round_trips(|number| {
        client.write_all(&number.to_le_bytes()).unwrap();
        let mut buffer = [0; 4];
        client.read_exact(&mut buffer).unwrap();
        assert_eq!(buffer, number.to_le_bytes());
    });
    assert!(trips[0] >= 40.0 && trips[0] < 65.0, "{trips:?}");

    let sent: Vec<u8> = (0..200_000_u32).map(|index| (index * 31 % 251) as u8).collect();
    let mut writer = client.try_clone().unwrap();
    let bytes = sent.clone();
    let write = std::thread::spawn(move || writer.write_all(&bytes).unwrap());
    let mut got = vec![0; sent.len()];
    client.read_exact(&mut got).unwrap();
    write.join().unwrap();
    assert!(got == sent, "bytes changed or changed places");
}

#[test]
fn tcp_rate_and_blackout() {
    let (mut client, relay) = tcp_echo();
    relay.set(Impairment { rate: Some(200_000.0), ..Impairment::default() });
    let start = Instant::now();
    client.write_all(&[1; 40_000]).unwrap();
    client.read_exact(&mut [0; 40_000]).unwrap();
    assert!(start.elapsed() >= 200 * MS, "{:?}", start.elapsed());

    relay.set(Impairment::default());
    relay.blackout(true);
    client.write_all(b"held").unwrap();
    client.set_read_timeout(Some(100 * MS)).unwrap();
    assert!(client.read(&mut [0; 4]).is_err(), "passed through a blackout");
    relay.blackout(false);
    client.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    let mut buffer = [0; 4];
    client.read_exact(&mut buffer).unwrap();
    assert_eq!(&buffer, b"held");
}
