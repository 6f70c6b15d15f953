use std::time::Duration;

use thiserror::Error;

use super::MonoTime;

/// How fast two monotonic clocks may part, as a fraction: NTP disciplines each by at most 500 ppm.
const MAX_DRIFT_PPM: i128 = 1000;
/// One best exchange is kept for each of the newest slots ...
const SLOTS: usize = 16;
/// ... of half a second.
const SLOT_NS: u64 = 500_000_000;
/// Longest believable round trip and longest believable hold of an echo by the peer.
const MAX_RTT_NS: i128 = 10_000_000_000;
const MAX_HOLD_NS: i128 = 1_000_000_000;
/// So many contradictions in a row mean that the estimate is wrong, not the exchanges.
const MAX_CONTRADICTIONS: u8 = 8;

/// Four stamps of one round trip (RFC 5905, section 8).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Exchange {
    /// t1: own message sent, own clock.
    pub sent: MonoTime,
    /// t2: it arrived at the peer, peer's clock.
    pub peer_received: MonoTime,
    /// t3: the peer's message that echoes it was sent, peer's clock.
    pub peer_sent: MonoTime,
    /// t4: that message arrived, own clock.
    pub received: MonoTime,
}

/// Why an exchange was not believed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum ClockError {
    /// Stamps of one clock run backwards.
    #[error("stamps of an exchange run backwards (own {own_ns} ns, peer {peer_ns} ns)")]
    Backwards {
        /// t4 - t1, ns, cut to 64 bits.
        own_ns: i64,
        /// t3 - t2, ns, cut to 64 bits.
        peer_ns: i64,
    },
    /// The peer claims to have held the message for longer than the round trip took, by more than clocks part.
    #[error("the peer claims to have held a message {peer_ns} ns of a round trip of {own_ns} ns")]
    NegativeRoundTrip {
        /// t4 - t1, ns.
        own_ns: i64,
        /// t3 - t2, ns.
        peer_ns: i64,
    },
    /// Round trip above 10 s, or the echo held for more than 1 s: too old to say anything about now.
    #[error("round trip of {rtt_ns} ns (echo held {hold_ns} ns) is too long to estimate a clock from")]
    TooLong {
        /// Round trip, ns, cut to 64 bits.
        rtt_ns: i64,
        /// t3 - t2, ns, cut to 64 bits.
        hold_ns: i64,
    },
    /// The clocks are more than 292 years apart.
    #[error("clock offset does not fit 64 bits of nanoseconds")]
    OutOfRange,
    /// The offset cannot be true together with what is known from before.
    #[error("clock offset {offset_ns} ns contradicts the estimate {estimate_ns} ns by more than both allow")]
    Contradiction {
        /// Offset of this exchange, ns.
        offset_ns: i64,
        /// Offset believed so far, ns.
        estimate_ns: i64,
    },
}

/// What is known of the peer's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OffsetEstimate {
    /// Peer's clock minus own clock, ns.
    pub offset_ns: i64,
    /// Round trip of the exchange the offset comes from, without the time the peer held it.
    pub rtt_min: Duration,
    /// Round trip of the newest accepted exchange.
    pub rtt_latest: Duration,
    /// The true offset is within this of `offset_ns`: half of `rtt_min`, and 1000 ppm of the time since that exchange
    /// began.
    pub uncertainty: Duration,
    /// Time since the exchange the offset comes from.
    pub age: Duration,
}

#[derive(Clone, Copy, Debug)]
struct Best {
    slot: u64,
    sent: MonoTime,
    at: MonoTime,
    offset_ns: i64,
    rtt_ns: i64,
}

impl Best {
    /// Bound of the error of this offset at `now`, ns. The clocks part during the exchange too.
    fn bound_ns(&self, now: MonoTime) -> i128 {
        let age = i128::from(now.0.saturating_sub(self.sent.0));
        i128::from(self.rtt_ns + 1) / 2 + drift_ns(age)
    }
}

/// Offset of a peer's monotonic clock, from the round trips that the messages themselves carry.
///
/// An exchange bounds the offset to half of its round trip, whatever the asymmetry of the two ways; the bound then
/// widens with age as clocks drift. The estimate is the exchange with the smallest bound: the minimum round trip of
/// the last seconds (8 s of exchanges are kept, in constant memory). An exchange whose interval does not overlap the
/// estimate's is impossible for honest clocks and is rejected; eight of them in a row start the estimate anew (a
/// suspended host). A new epoch of the peer does that at once.
///
/// A peer that lies consistently cannot be told from a true clock: what is derived from the offset must only ever
/// make the receiver more careful.
#[derive(Clone, Copy, Debug, Default)]
pub struct ClockOffset {
    peer_epoch: Option<u64>,
    slots: [Option<Best>; SLOTS],
    rtt_latest_ns: i64,
    contradictions: u8,
}

impl ClockOffset {
    /// Takes in one exchange with the peer process `peer_epoch`.
    ///
    /// Believe the `sent` of an exchange only if it is a stamp this process really sent, see
    /// [`crate::wire::Echo::exchange`].
    ///
    /// # Errors
    /// [`ClockError`] if the exchange is impossible; the estimate is as before, unless contradictions started it anew.
    pub fn update(&mut self, peer_epoch: u64, exchange: Exchange) -> Result<(), ClockError> {
        let own = i128::from(exchange.received.0) - i128::from(exchange.sent.0);
        let hold = i128::from(exchange.peer_sent.0) - i128::from(exchange.peer_received.0);
        let rtt = own - hold;
        if own < 0 || hold < 0 {
            return Err(ClockError::Backwards { own_ns: cut(own), peer_ns: cut(hold) });
        }
        // The peer's clock may be the faster one.
        if rtt < -drift_ns(hold) - 1 {
            return Err(ClockError::NegativeRoundTrip { own_ns: cut(own), peer_ns: cut(hold) });
        }
        let rtt = rtt.max(0);
        if rtt > MAX_RTT_NS || hold > MAX_HOLD_NS {
            return Err(ClockError::TooLong { rtt_ns: cut(rtt), hold_ns: cut(hold) });
        }
        let offset = (i128::from(exchange.peer_received.0) - i128::from(exchange.sent.0)
            + i128::from(exchange.peer_sent.0)
            - i128::from(exchange.received.0))
            / 2;
        if i64::try_from(offset).is_err() {
            return Err(ClockError::OutOfRange);
        }
        let now = exchange.received;
        let new =
            Best { slot: now.0 / SLOT_NS, sent: exchange.sent, at: now, offset_ns: cut(offset), rtt_ns: cut(rtt) };

        if self.peer_epoch != Some(peer_epoch) {
            *self = Self { peer_epoch: Some(peer_epoch), ..Self::default() };
        }
        if let Some(best) = self.best(now).copied() {
            let gap = (offset - i128::from(best.offset_ns)).abs();
            if gap > best.bound_ns(now) + new.bound_ns(now) {
                self.contradictions += 1;
                if self.contradictions >= MAX_CONTRADICTIONS {
                    *self = Self { peer_epoch: Some(peer_epoch), ..Self::default() };
                }
                return Err(ClockError::Contradiction { offset_ns: new.offset_ns, estimate_ns: best.offset_ns });
            }
        }
        self.contradictions = 0;
        self.rtt_latest_ns = new.rtt_ns;
        let slot = &mut self.slots[(new.slot % SLOTS as u64) as usize];
        if slot.is_none_or(|kept| kept.slot != new.slot || new.rtt_ns <= kept.rtt_ns) {
            *slot = Some(new);
        }
        Ok(())
    }

    /// What is known at `now`, or `None` before the first exchange with the peer's present process.
    #[must_use]
    pub fn estimate(&self, now: MonoTime) -> Option<OffsetEstimate> {
        let best = self.best(now)?;
        Some(OffsetEstimate {
            offset_ns: best.offset_ns,
            rtt_min: duration(i128::from(best.rtt_ns)),
            rtt_latest: duration(i128::from(self.rtt_latest_ns)),
            uncertainty: duration(best.bound_ns(now)),
            age: now.since(best.at),
        })
    }

    /// The peer process the estimate belongs to.
    #[must_use]
    pub const fn peer_epoch(&self) -> Option<u64> {
        self.peer_epoch
    }

    /// Age at `now` (own clock) of something stamped `peer_time` by the peer's clock, ns; a small negative age is the
    /// uncertainty of the offset. `None` before the first exchange.
    #[must_use]
    pub fn age(&self, now: MonoTime, peer_time: MonoTime) -> Option<i64> {
        let best = self.best(now)?;
        Some(cut(i128::from(now.0) + i128::from(best.offset_ns) - i128::from(peer_time.0)))
    }

    /// `peer_time` (peer's clock) on the own clock. `None` before the first exchange.
    #[must_use]
    pub fn to_own(&self, now: MonoTime, peer_time: MonoTime) -> Option<MonoTime> {
        let best = self.best(now)?;
        let own = i128::from(peer_time.0) - i128::from(best.offset_ns);
        Some(MonoTime(u64::try_from(own.max(0)).unwrap_or(u64::MAX)))
    }

    /// Forgets the peer.
    pub fn reset(&mut self) {
        *self = Self::default();
    }

    fn best(&self, now: MonoTime) -> Option<&Best> {
        self.slots.iter().flatten().min_by_key(|best| best.bound_ns(now))
    }
}

/// The most that two clocks part in a time, ns.
const fn drift_ns(time: i128) -> i128 {
    time * MAX_DRIFT_PPM / 1_000_000
}

fn cut(ns: i128) -> i64 {
    i64::try_from(ns).unwrap_or(if ns < 0 { i64::MIN } else { i64::MAX })
}

fn duration(ns: i128) -> Duration {
    Duration::from_nanos(u64::try_from(ns.max(0)).unwrap_or(u64::MAX))
}
