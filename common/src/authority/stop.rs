use std::sync::atomic::{AtomicU64, Ordering};

/// A stop and its reset, as numbers: stop `asked` is in force until it, and no other, is reset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Latch {
    /// Number of the newest stop, 0 if there was none.
    pub asked: u32,
    /// Number of the newest stop that was reset.
    pub reset: u32,
}

impl Latch {
    /// Whether a stop is in force.
    #[must_use]
    pub const fn is_stopped(self) -> bool {
        self.asked != self.reset
    }

    /// After a stop; one in force stays as it is.
    #[must_use]
    pub const fn stop(self) -> Self {
        if self.is_stopped() { self } else { Self { asked: self.asked.wrapping_add(1), ..self } }
    }

    /// After the reset of the stop `number`. A reset that was meant for another stop, or comes twice, changes nothing.
    #[must_use]
    pub const fn reset(self, number: u32) -> Self {
        if self.asked == number { Self { reset: number, ..self } } else { self }
    }
}

/// A [`Latch`] that many threads share: whoever sees a reason stops the hand, the control thread reads it in every tick.
#[derive(Debug, Default)]
pub struct StopLatch(AtomicU64);

impl StopLatch {
    /// As it is now.
    #[must_use]
    pub fn get(&self) -> Latch {
        unpack(self.0.load(Ordering::Acquire))
    }

    /// Stops the hand. True if it was not stopped before.
    pub fn stop(&self) -> bool {
        self.change(Latch::stop)
    }

    /// Resets the stop `number`. True if it was in force.
    pub fn reset(&self, number: u32) -> bool {
        self.change(|latch| latch.reset(number))
    }

    /// Resets the stop in force, for somebody who stands beside the hand. True if there was one.
    pub fn reset_any(&self) -> bool {
        self.change(|latch| latch.reset(latch.asked))
    }

    fn change(&self, next: impl Fn(Latch) -> Latch) -> bool {
        let update = |packed| {
            let (before, after) = (unpack(packed), next(unpack(packed)));
            (before != after).then(|| pack(after))
        };
        self.0.fetch_update(Ordering::AcqRel, Ordering::Acquire, update).is_ok()
    }
}

fn pack(latch: Latch) -> u64 {
    u64::from(latch.asked) << 32 | u64::from(latch.reset)
}

const fn unpack(packed: u64) -> Latch {
    Latch { asked: (packed >> 32) as u32, reset: packed as u32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_right_reset_ends_a_stop() {
        let stop = StopLatch::default();
        assert!(!stop.get().is_stopped() && !stop.reset_any());
        assert!(stop.stop());
        assert!(!stop.stop(), "already stopped");
        assert_eq!(stop.get(), Latch { asked: 1, reset: 0 });
        assert!(!stop.reset(0) && !stop.reset(2) && stop.get().is_stopped());
        assert!(stop.reset(1) && !stop.get().is_stopped());
        assert!(stop.stop() && !stop.reset(1), "a reset that comes again, meant for the first stop");
        assert!(stop.get().is_stopped() && stop.reset_any() && !stop.get().is_stopped());
    }
}
