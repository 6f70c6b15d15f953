//! The clock offset: with an honest peer the truth is within what is claimed, whatever the delays and the drift; and no
//! stamps that a liar can make up overflow anything.
#![no_main]

use arbitrary::Arbitrary;
use libfuzzer_sys::fuzz_target;
use teleop_common::time::{ClockOffset, Exchange, MonoTime};
use teleop_fuzz::without_allocating;

const US: i128 = 1000;

#[derive(Arbitrary, Debug)]
struct Input {
    /// The peer's clock when the own one is at the beginning, ns.
    offset: i64,
    /// What the peer's clock gains, ppm, within 500.
    drift: i16,
    honest: Vec<Honest>,
    lies: Vec<Lie>,
}

/// A round trip; all in us.
#[derive(Arbitrary, Clone, Copy, Debug)]
struct Honest {
    wait: u32,
    there: u32,
    held: u32,
    back: u32,
}

#[derive(Arbitrary, Clone, Copy, Debug)]
struct Lie {
    epoch: u8,
    stamps: [u64; 4],
    asked: u64,
}

fuzz_target!(|input: Input| {
    // Half an hour in; the peer's clock began some time before, as those of machines do.
    let begin = 1_800_000_000_000_i128;
    let ppm = i128::from(input.drift.clamp(-500, 500));
    let offset = i128::from(input.offset).rem_euclid(1_000_000_000_000_000);
    let peer = |own: i128| MonoTime((own + offset + (own - begin) * ppm / 1_000_000) as u64);
    let own = |at: i128| MonoTime(at as u64);
    let mut clock = ClockOffset::default();
    let mut now = begin;
    for trip in input.honest.into_iter().take(500) {
        // Up to 4 s between, 2 s each way, 0.5 s in the peer's hands.
        let sent = now + i128::from(trip.wait % 4_000_000) * US;
        let at_peer = sent + i128::from(trip.there % 2_000_000) * US;
        let from_peer = at_peer + i128::from(trip.held % 500_000) * US;
        let received = from_peer + i128::from(trip.back % 2_000_000) * US;
        let exchange = Exchange {
            sent: own(sent),
            peer_received: peer(at_peer),
            peer_sent: peer(from_peer),
            received: own(received),
        };
        without_allocating(|| clock.update(7, exchange)).expect("an honest exchange is believed");
        now = received;
        let estimate = clock.estimate(own(now)).expect("something is known");
        let truth = i128::from(peer(now).0) - now;
        let error = (i128::from(estimate.offset_ns) - truth).unsigned_abs();
        // A microsecond is rounding: of the peer's stamps, and of halves.
        assert!(error <= estimate.uncertainty.as_nanos() + 1000, "{error} ns off, {:?} claimed", estimate.uncertainty);
        let age = clock.age(own(now), exchange.peer_sent).expect("something is known");
        let error = (i128::from(age) - (now - from_peer)).unsigned_abs();
        // While the message was on its way back the clocks parted.
        let parted = (now - from_peer).unsigned_abs() / 2000;
        assert!(error <= estimate.uncertainty.as_nanos() + parted + 1000, "an age {error} ns off");
    }
    for lie in input.lies.into_iter().take(500) {
        let [sent, peer_received, peer_sent, received] = lie.stamps.map(MonoTime);
        let _believed_or_not = without_allocating(|| {
            clock.update(lie.epoch.into(), Exchange { sent, peer_received, peer_sent, received })
        });
        let asked = MonoTime(lie.asked);
        if let Some(estimate) = clock.estimate(asked) {
            assert!(clock.age(asked, sent).is_some() && clock.to_own(asked, sent).is_some());
            assert!(estimate.rtt_min.as_secs() <= 10);
        }
    }
});
