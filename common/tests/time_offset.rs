//! The clock offset against simulated clocks and networks: the error is always within what it claims.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use std::time::Duration;

use proptest::prelude::*;
use teleop_common::time::{ClockError, ClockOffset, Exchange, Histogram, MonoTime};

/// A peer whose clock runs `1 + drift_ppm * 1e-6` as fast, `offset` ahead at own time 0.
#[derive(Clone, Copy)]
struct Peer {
    offset: i64,
    drift_ppm: i64,
}

impl Peer {
    fn clock(&self, own: u64) -> u64 {
        (own as i64 + self.offset + (i128::from(own) * i128::from(self.drift_ppm) / 1_000_000) as i64) as u64
    }

    fn exchange(&self, sent: u64, there: u64, held: u64, back: u64) -> Exchange {
        Exchange {
            sent: MonoTime(sent),
            peer_received: MonoTime(self.clock(sent + there)),
            peer_sent: MonoTime(self.clock(sent + there + held)),
            received: MonoTime(sent + there + held + back),
        }
    }

    /// Error of the estimate at `now`, ns.
    fn error(&self, clock: &ClockOffset, now: u64) -> u64 {
        let truth = self.clock(now) as i64 - now as i64;
        clock.estimate(MonoTime(now)).unwrap().offset_ns.abs_diff(truth)
    }
}

const MS: u64 = 1_000_000;
const S: u64 = 1000 * MS;
const START: u64 = 100 * S;

#[test]
fn symmetric_exchange_is_exact() {
    let peer = Peer { offset: -42 * S as i64, drift_ppm: 0 };
    let mut clock = ClockOffset::default();
    assert_eq!(clock.estimate(MonoTime(START)), None);
    assert_eq!(clock.age(MonoTime(START), MonoTime(0)), None);
    clock.update(1, peer.exchange(START, 10 * MS, 3 * MS, 10 * MS)).unwrap();
    let now = START + 23 * MS;
    let estimate = clock.estimate(MonoTime(now)).unwrap();
    assert_eq!(estimate.offset_ns, -42 * S as i64);
    assert_eq!((estimate.rtt_min, estimate.rtt_latest), (Duration::from_millis(20), Duration::from_millis(20)));
    // Half of the round trip, and what clocks part in the 23 ms that it took.
    assert_eq!((estimate.uncertainty, estimate.age), (Duration::from_micros(10_023), Duration::ZERO));
    // Something the peer stamped 5 ms ago, and something from 1 ms in the future.
    assert_eq!(clock.age(MonoTime(now), MonoTime(peer.clock(now - 5 * MS))), Some(5 * MS as i64));
    assert_eq!(clock.age(MonoTime(now), MonoTime(peer.clock(now + MS))), Some(-(MS as i64)));
    assert_eq!(clock.to_own(MonoTime(now), MonoTime(peer.clock(now - 5 * MS))), Some(MonoTime(now - 5 * MS)));
}

#[test]
fn the_fastest_round_trip_wins() {
    let peer = Peer { offset: 7 * S as i64, drift_ppm: 0 };
    let mut clock = ClockOffset::default();
    for (sent, there, back) in [(0, 30, 5), (20, 2, 2), (40, 5, 30), (60, 9, 40)] {
        clock.update(1, peer.exchange(START + sent * MS, there * MS, 0, back * MS)).unwrap();
    }
    let estimate = clock.estimate(MonoTime(START + 109 * MS)).unwrap();
    assert_eq!(estimate.offset_ns, 7 * S as i64);
    assert_eq!((estimate.rtt_min, estimate.rtt_latest), (Duration::from_millis(4), Duration::from_millis(49)));
}

#[test]
fn the_peers_garbage_is_refused() {
    let peer = Peer { offset: 0, drift_ppm: 0 };
    let mut clock = ClockOffset::default();
    clock.update(1, peer.exchange(START, MS, MS, MS)).unwrap();
    let before = clock.estimate(MonoTime(START + 3 * MS));
    let at = |sent, peer_received, peer_sent, received| Exchange {
        sent: MonoTime(sent),
        peer_received: MonoTime(peer_received),
        peer_sent: MonoTime(peer_sent),
        received: MonoTime(received),
    };
    let mut refuse = |exchange| clock.update(1, exchange).unwrap_err();
    assert!(matches!(refuse(at(START + 1, 5, 6, START)), ClockError::Backwards { .. }));
    assert!(matches!(refuse(at(START, 6, 5, START + MS)), ClockError::Backwards { .. }));
    assert!(matches!(refuse(at(START, 0, 2 * MS, START + MS)), ClockError::NegativeRoundTrip { .. }));
    assert!(matches!(refuse(at(START, 0, u64::MAX, START + MS)), ClockError::NegativeRoundTrip { .. }));
    assert!(matches!(refuse(at(START, START, START, START + 11 * S)), ClockError::TooLong { .. }));
    assert!(matches!(refuse(at(START, START, START + 2 * S, START + 3 * S)), ClockError::TooLong { .. }));
    assert!(matches!(refuse(at(START, u64::MAX, u64::MAX, START + MS)), ClockError::OutOfRange));
    assert!(matches!(refuse(at(START, START + S, START + S, START + MS)), ClockError::Contradiction { .. }));
    assert_eq!(clock.estimate(MonoTime(START + 3 * MS)), before);
}

#[test]
fn a_new_epoch_starts_anew_and_refused_ones_do_not() {
    let (old, new) = (Peer { offset: 5, drift_ppm: 0 }, Peer { offset: -(9 * S as i64), drift_ppm: 0 });
    let mut clock = ClockOffset::default();
    clock.update(1, old.exchange(START, MS, 0, MS)).unwrap();
    let mut bad = new.exchange(START + S, MS, MS, MS);
    bad.peer_sent = MonoTime(0);
    assert!(clock.update(2, bad).is_err());
    assert_eq!(clock.peer_epoch(), Some(1));
    clock.update(2, new.exchange(START + S, 30 * MS, 0, 30 * MS)).unwrap();
    assert_eq!(clock.peer_epoch(), Some(2));
    assert_eq!(clock.estimate(MonoTime(START + S)).unwrap().offset_ns, -(9 * S as i64));
}

#[test]
fn a_clock_that_really_jumped_is_found_again() {
    let mut peer = Peer { offset: 0, drift_ppm: 0 };
    let mut clock = ClockOffset::default();
    clock.update(1, peer.exchange(START, MS, 0, MS)).unwrap();
    peer.offset -= 60 * S as i64; // its host was suspended for a minute
    let mut refused = 0;
    for step in 1..20 {
        refused += u32::from(clock.update(1, peer.exchange(START + step * 10 * MS, MS, 0, MS)).is_err());
    }
    assert_eq!(refused, 8);
    assert_eq!(peer.error(&clock, START + 200 * MS), 0);
}

#[test]
fn single_lies_do_not_unseat_it() {
    let peer = Peer { offset: 3 * S as i64, drift_ppm: 0 };
    let lie = Peer { offset: 4 * S as i64, drift_ppm: 0 };
    let mut clock = ClockOffset::default();
    for step in 0..1000 {
        let (who, honest) = if step % 5 == 0 || step == 0 { (peer, true) } else { (lie, false) };
        assert_eq!(clock.update(1, who.exchange(START + step * 10 * MS, MS, 0, MS)).is_ok(), honest);
    }
    assert_eq!(peer.error(&clock, START + 10 * S), 0);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Any jitter, as asymmetric as it likes, any drift within +-100 ppm: the error stays within the bound it claims,
    /// and the bound within half the fastest recent round trip and what the drift can do in 8 s.
    #[test]
    fn the_error_is_within_the_claim(
        offset in -1_000_000_000_000_i64..1_000_000_000_000,
        drift_ppm in -100_i64..=100,
        base in 0..50 * MS,
        trips in prop::collection::vec((0..40 * MS, 0..40 * MS, 0..20 * MS, 1..200 * MS), 1..400),
    ) {
        let peer = Peer { offset: offset + 2_000_000_000_000, drift_ppm };
        let mut clock = ClockOffset::default();
        let mut sent = START;
        let mut recent: Vec<(u64, u64)> = Vec::new();
        for (there, back, held, pause) in trips {
            let exchange = peer.exchange(sent, base + there, held, base + back);
            clock.update(1, exchange).unwrap();
            let now = exchange.received.0;
            recent.push((now, 2 * base + there + back));
            let estimate = clock.estimate(MonoTime(now)).unwrap();
            // 2 ns for the integer divisions of this model and of the estimate.
            prop_assert!(peer.error(&clock, now) <= estimate.uncertainty.as_nanos() as u64 + 2);
            let fastest = recent.iter().filter(|(at, _)| now - at < 7 * S).map(|(_, rtt)| *rtt).min().unwrap();
            prop_assert!(estimate.uncertainty.as_nanos() as u64 <= fastest / 2 + 2 + 9 * S / 1000);
            sent = now.max(sent) + pause;
        }
    }

    /// The peer may send any numbers whatever.
    #[test]
    fn nothing_panics(exchanges in prop::collection::vec(prop::array::uniform5(any::<u64>()), 0..100)) {
        let mut clock = ClockOffset::default();
        for [epoch, a, b, c, d] in exchanges {
            let exchange = Exchange {
                sent: MonoTime(a), peer_received: MonoTime(b), peer_sent: MonoTime(c), received: MonoTime(d),
            };
            let _refused = clock.update(epoch % 2, exchange);
            let _any = (clock.estimate(MonoTime(a)), clock.age(MonoTime(b), MonoTime(c)));
            let _any = clock.to_own(MonoTime(c), MonoTime(d));
        }
    }

    #[test]
    fn quantiles_bound_the_truth(values in prop::collection::vec(0..10 * S, 1..500), p in 0.0..=1.0_f64) {
        let mut histogram = Histogram::default();
        for value in &values {
            histogram.record(Duration::from_nanos(*value));
        }
        let mut sorted = values;
        sorted.sort_unstable();
        let rank = ((p * sorted.len() as f64).ceil() as usize).clamp(1, sorted.len());
        let truth = sorted[rank - 1];
        let found = histogram.quantile(p).as_nanos() as u64;
        prop_assert!(found >= truth && found <= truth + truth / 16 + 1, "{truth} {found}");
        prop_assert_eq!(histogram.max().as_nanos() as u64, sorted[sorted.len() - 1]);
        prop_assert_eq!(histogram.count(), sorted.len() as u64);
    }
}

/// Found by fuzzing: a clock that is faster made a message seem to be held for longer than the round trip took, and an
/// exchange's own length was left out of what clocks may part by.
#[test]
fn a_fast_clock_and_a_long_hold_are_within_the_claim() {
    for drift_ppm in [-500, 500] {
        let peer = Peer { offset: 0, drift_ppm };
        let mut clock = ClockOffset::default();
        // On one host: nothing on the way, half a second in the peer's hands.
        let exchange = peer.exchange(START, 0, 500 * MS, 0);
        clock.update(1, exchange).unwrap();
        let now = exchange.received.0;
        let claimed = clock.estimate(MonoTime(now)).unwrap().uncertainty.as_nanos() as u64;
        assert!(peer.error(&clock, now) <= claimed + 2, "{} ns off, {claimed} claimed", peer.error(&clock, now));
        let lie = peer.exchange(now, 0, 500 * MS, 0);
        let lie = Exchange { received: MonoTime(lie.received.0 - 2 * MS), ..lie };
        assert!(matches!(clock.update(1, lie), Err(ClockError::NegativeRoundTrip { .. })), "more than clocks part");
    }
}

/// An hour at 100 ppm: the estimate follows, though the fastest trip of all was the first.
#[test]
fn drift_of_an_hour() {
    let peer = Peer { offset: 1_000_000, drift_ppm: 100 };
    let mut clock = ClockOffset::default();
    clock.update(1, peer.exchange(START, 1000, 0, 1000)).unwrap();
    let mut worst = 0;
    for step in 1..36_000_u64 {
        let sent = START + step * 100 * MS;
        let jitter = step * 7919 % 10 * MS / 10;
        let exchange = peer.exchange(sent, 2 * MS + jitter, MS, 2 * MS);
        clock.update(1, exchange).unwrap();
        worst = worst.max(peer.error(&clock, exchange.received.0));
    }
    // Half of a 4 to 5 ms round trip bounds it; the drift over the hour would be 360 ms.
    assert!(worst <= 2_500_000, "{worst} ns");
}

#[test]
fn empty_histogram_and_clear() {
    let mut histogram = Histogram::default();
    assert_eq!((histogram.p50(), histogram.p99(), histogram.max()), Default::default());
    histogram.record(Duration::MAX);
    assert_eq!(histogram.max(), Duration::from_nanos(u64::MAX));
    histogram.clear();
    assert_eq!(histogram.count(), 0);
}
